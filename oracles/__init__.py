# SPDX-License-Identifier: MIT
"""What is right, computed slowly in float64, and small scenes that are known analytically: for tests and
benchmarks alike."""
