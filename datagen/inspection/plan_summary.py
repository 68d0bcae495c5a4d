# SPDX-License-Identifier: MIT
"""Summary of a plan's views in a few words, before anything is rendered."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from datagen.formats.configuration import Configuration


def plan_summary(configurations: Iterable[Configuration]) -> str:
    """Coverage over all configurations, "" where none states any."""
    found = [(c.coverage, len(c.cameras)) for c in configurations if c.coverage is not None]
    if not found:
        return ""
    views = np.array([count for _, count in found], dtype=np.float64)

    def mean(field: str) -> float:
        return float(np.average([getattr(coverage, field) for coverage, _ in found], weights=views))

    medians = [coverage.median_observations for coverage, _ in found]
    return (
        f"the median surface pixel is seen by {np.median(medians):g} views "
        f"(least {min(medians):g}, most {max(medians):g}), {mean('thin_share'):.0%} of them by at most two\n"
        f"{mean('room_share'):.0%} of the views show two walls, or a wall and the ceiling\n"
        f"{mean('metal_share'):.1%} of the surface pixels have S > 0.3, {mean('gloss_share'):.1%} R < 0.3"
    )
