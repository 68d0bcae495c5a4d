# SPDX-License-Identifier: MIT
"""Exports of an atlas: images, asset package, GLB, USDZ and Mitsuba scene."""
