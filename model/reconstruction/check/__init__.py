# SPDX-License-Identifier: MIT
"""Checks whether the mesh fits the photographs, before longer work on a capture."""
