# SPDX-License-Identifier: MIT
"""Names of the pixel weights of the merge (:class:`~model.reconstruction.merge.merger.MergeOptions`)."""

from typing import Literal

Weights = Literal["none", "borders", "resolution", "confidence"]
