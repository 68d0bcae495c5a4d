# SPDX-License-Identifier: MIT
"""Slow float64 reference implementations and small scenes with known solutions, for tests and benchmarks."""

import os

VARIANT = os.environ.get("SCENE_MATERIALS_VARIANT", "llvm_ad_rgb")
"""Mitsuba variant of the tests: LLVM (CPU), unless ``SCENE_MATERIALS_VARIANT`` names another."""
