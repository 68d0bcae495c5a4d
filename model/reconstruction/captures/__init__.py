# SPDX-License-Identifier: MIT
"""Readers of all supported capture formats; ``read.py`` recognises the format and calls its module."""
