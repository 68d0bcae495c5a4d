# SPDX-License-Identifier: MIT
"""Checks whether the mesh projects onto the photographs, before minutes are spent on a capture."""
