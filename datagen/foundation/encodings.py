# SPDX-License-Identifier: MIT
"""How the values of a photograph stand for light."""

from __future__ import annotations

from typing import Literal

Encoding = Literal["auto", "linear", "srgb", "gamma22"]
