# SPDX-License-Identifier: MIT
"""An atlas as images, asset package, GLB and Mitsuba scene."""
