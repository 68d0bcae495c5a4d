# SPDX-License-Identifier: MIT
"""Slow float64 references, and small scenes with known solutions, for tests and benchmarks."""
