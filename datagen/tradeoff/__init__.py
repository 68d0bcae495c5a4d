# SPDX-License-Identifier: MIT
"""Measures error against time over everything that costs time, and recommends a setting for an error."""
