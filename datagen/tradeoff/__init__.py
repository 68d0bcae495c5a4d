# SPDX-License-Identifier: MIT
"""Measures the error and time of render settings, and recommends the fastest within error limits."""
