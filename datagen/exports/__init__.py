# SPDX-License-Identifier: MIT
"""Datasets in the layouts of other tools: one module a format, each a function from rooms to files."""
