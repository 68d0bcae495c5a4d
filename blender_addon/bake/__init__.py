# SPDX-License-Identifier: GPL-3.0-or-later
"""From Blender's shader graphs to the three channels of the project's BSDF."""
