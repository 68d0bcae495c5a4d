# SPDX-License-Identifier: MIT
"""What each view sees of a capture's mesh, and the normals of meshes that come without."""
