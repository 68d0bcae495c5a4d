# SPDX-License-Identifier: MIT
"""Checks whether a mesh fits the photographs, before longer work on a capture."""
