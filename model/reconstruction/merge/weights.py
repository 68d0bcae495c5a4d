# SPDX-License-Identifier: MIT
"""By what the views are weighted in the medians of the merge."""

from __future__ import annotations

from typing import Literal

Weights = Literal["none", "angle", "distance", "confidence", "all"]
