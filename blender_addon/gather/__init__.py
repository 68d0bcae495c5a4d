# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads Blender's data into plain dataclasses. Nothing here changes the file."""
