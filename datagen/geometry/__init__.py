# SPDX-License-Identifier: MIT
"""Visibility of a capture's mesh by view, and normals for meshes without."""
