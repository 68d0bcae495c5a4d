# SPDX-License-Identifier: MIT
"""Visibility of a capture's mesh in each view, and normals for meshes that have none."""
