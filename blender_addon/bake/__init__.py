# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts Blender's shader graphs to the channels of the project's BSDF: constants and textures."""
