# SPDX-License-Identifier: MIT
"""Checks whether the mesh projects onto the photographs, before longer work on a capture."""
