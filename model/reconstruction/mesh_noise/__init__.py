# SPDX-License-Identifier: MIT
"""Removal of noise from meshes: ``smoothing`` moves vertices, ``stage`` applies it to a capture."""
