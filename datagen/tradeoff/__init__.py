# SPDX-License-Identifier: MIT
"""Measures error against time for all settings that affect time, and recommends a setting for an error."""
