# SPDX-License-Identifier: MIT
"""Radiometric calibration of cameras from overlapping photographs."""
