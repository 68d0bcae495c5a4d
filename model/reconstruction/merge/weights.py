# SPDX-License-Identifier: MIT
"""Names of the pixel weights of the merge.

``none``: equal weights; ``borders``: weights that decrease towards image borders and silhouettes;
``resolution``: border weights times (pixels per metre)^(2 confidence); ``confidence``: border weights times
confidence.
"""

from typing import Literal

Weights = Literal["none", "borders", "resolution", "confidence"]
