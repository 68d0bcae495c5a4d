# SPDX-License-Identifier: MIT
"""Measures error and time of all settings that affect time; recommends the fastest within error limits."""
