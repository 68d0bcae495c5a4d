# SPDX-License-Identifier: MIT
"""Measures error and time of all settings that affect time, and recommends a setting for a given error."""
