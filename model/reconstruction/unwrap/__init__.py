# SPDX-License-Identifier: MIT
"""Unwraps meshes: UVs for an atlas."""
