# SPDX-License-Identifier: MIT
"""Mending of reconstructed meshes: ``holes`` fills holes, ``smoothing`` removes noise."""
