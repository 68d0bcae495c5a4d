# SPDX-License-Identifier: MIT
"""Unwraps meshes to UVs for an atlas."""
