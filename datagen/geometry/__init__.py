# SPDX-License-Identifier: MIT
"""Ray tracing of a capture's mesh from its views, normals for meshes without any, and texture lookup."""
