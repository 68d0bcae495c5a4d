# SPDX-License-Identifier: MIT
"""Triangle meshes, and their file formats: PLY, OBJ and glTF."""
