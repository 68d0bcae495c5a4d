# SPDX-License-Identifier: MIT
"""Slow float64 references and small scenes of known solution, for tests and benchmarks."""
