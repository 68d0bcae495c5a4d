# SPDX-License-Identifier: MIT
"""Mitsuba 3 scene files: what importers and captures both read of them."""
