# SPDX-License-Identifier: MIT
"""Merges the maps of all views into one atlas and fills unseen texels."""
