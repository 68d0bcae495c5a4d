# SPDX-License-Identifier: MIT
"""Datasets in the layouts of other tools: one module per format, each a function from rooms to files."""
