# SPDX-License-Identifier: MIT
"""Names of the weights of views in the merge."""

from typing import Literal

Weights = Literal["none", "borders", "angle", "distance", "confidence", "all"]
