# SPDX-License-Identifier: MIT
"""Triangle meshes, and the file formats that hold them: PLY, OBJ and glTF."""
