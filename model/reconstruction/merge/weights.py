# SPDX-License-Identifier: MIT
"""Weights of views in the medians of the merge."""

from __future__ import annotations

from typing import Literal

Weights = Literal["none", "angle", "distance", "confidence", "all"]
