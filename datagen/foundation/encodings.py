# SPDX-License-Identifier: MIT
"""Transfer functions between stored values of photographs and radiance."""

from __future__ import annotations

from typing import Literal

Encoding = Literal["auto", "linear", "srgb", "gamma22"]
