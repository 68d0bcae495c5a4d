# SPDX-License-Identifier: MIT
"""Names of the transfer functions between radiance and the stored values of photographs."""

from __future__ import annotations

from typing import Literal

Encoding = Literal["auto", "linear", "srgb", "gamma22"]
