# SPDX-License-Identifier: MIT
"""Writes datasets in the layouts of other tools: one module per format."""
