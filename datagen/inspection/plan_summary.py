# SPDX-License-Identifier: MIT
"""Summarises the coverage of a plan's views, before anything is rendered."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from datagen.formats.configuration import MIN_GLOSS_SHARE, MIN_METAL_SHARE, Configuration


def plan_summary(configurations: Iterable[Configuration]) -> str:
    """Describe in a few lines the surfaces that planned views show; '' if no configuration records them.

    The last line warns if the views of the training split lack metal or gloss.
    """
    found = [
        (c.coverage, len(c.cameras), c.split == "train") for c in configurations if c.coverage is not None
    ]
    if not found:
        return ""
    views = np.array([count for _, count, _ in found], dtype=np.float64)
    training = views * [is_training for *_, is_training in found]

    def mean(field: str, weights: NDArray[np.float64] = views) -> float:
        return float(np.average([getattr(coverage, field) for coverage, *_ in found], weights=weights))

    medians = [coverage.median_observations for coverage, *_ in found]
    lines = [
        f"the median surface pixel is seen by {np.median(medians):g} views ({min(medians):g} to "
        f"{max(medians):g} by configuration), {mean('thin_share'):.0%} of the pixels by at most two",
        f"{mean('room_share'):.0%} of the views show two walls, or a wall and the ceiling",
        f"{mean('metal_share'):.1%} of the surface pixels have S > 0.3, {mean('gloss_share'):.1%} R < 0.3",
    ]
    if training.any():
        lack = lack_for_training(mean("metal_share", training), mean("gloss_share", training))
        lines += [f"note: {lack}"] if lack else []
    return "\n".join(lines)


def lack_for_training(metal_share: float, gloss_share: float) -> str:
    """Describe shares of metal and glossy pixels that are too small for training; '' if both suffice."""
    shares = (("S > 0.3", metal_share, MIN_METAL_SHARE), ("R < 0.3", gloss_share, MIN_GLOSS_SHARE))
    short = [
        f"{name} in {share:.1%} of them (at least {least:.0%})"
        for name, share, least in shares
        if share < least
    ]
    if not short:
        return ""
    remedy = "raise metal and glazed in materials.class_weights"
    return f"the training views have too few surface pixels of metal or gloss: {', '.join(short)}; {remedy}"
