# SPDX-License-Identifier: MIT
"""Mitsuba 3 scene files: the part of their syntax that importers and captures share."""
