# SPDX-License-Identifier: MIT
"""Exports an atlas as images, asset package, GLB, USDZ and Mitsuba scene."""
