# SPDX-License-Identifier: MIT
"""Slow float64 reference implementations and small scenes with known solutions, for tests and benchmarks."""
