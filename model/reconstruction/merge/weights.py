# SPDX-License-Identifier: MIT
"""Names of the pixel weights of the merge.

``none``: equal weights; the others decrease towards borders of the views. ``resolution``: times the square
of the pixels per metre, to the power of confidence; ``confidence``: times confidence.
"""

from typing import Literal

Weights = Literal["none", "borders", "resolution", "confidence"]
