# SPDX-License-Identifier: MIT
"""How much the light is trusted: the confidence of D, S and R, and the level of the network's D where it
stays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import LUMINANCE_WEIGHTS
from model.reconstruction.light.surfels import weighted_medians

GAIN_SURFELS = 20.0
"""Confident surfels that weigh as much as what is known of the surroundings."""
MIN_RATIO_ALBEDO = 0.02
"""Albedo below which a ratio says nothing."""
IMPOSSIBLE = (0.1, 0.25)
"""Impossible share up to which the light counts fully, and from which it does not count."""
D_EVIDENCE, S_EVIDENCE = (0.5, 0.8), (0.2, 0.5)
"""Share of a surfel's hemisphere that photographs show: below the first number the network's map stays, above
the second the light's replaces it."""


def surfel_confidence(photographed: NDArray) -> NDArray[np.float32]:
    """Confidence (N, 3) of D, S and R of surfels from the share of their hemisphere that photographs show:
    D scales with the irradiance, while S and R hold a prior already that grows where evidence lacks."""
    of_d = _ramp(photographed, D_EVIDENCE)
    of_s = _ramp(photographed, S_EVIDENCE)
    return np.stack([of_d, of_s, of_s], axis=1).astype(np.float32)


def impossible_share(radiance: NDArray, diffuse: NDArray, confidence: NDArray) -> float:
    """Share of the surfels, by ``confidence`` (N,), that reflect more than arrives: ``radiance`` (N, 3) above
    ``diffuse`` (N, 3). Lamps that no photograph shows make it large."""
    excess = (radiance - diffuse) @ LUMINANCE_WEIGHTS > 0
    return float((confidence * excess).sum() / max(float(confidence.sum()), 1e-9))


def trust_of(share: float) -> float:
    """Factor of all confidences, out of :func:`impossible_share`."""
    return 1.0 - float(_ramp(np.array(share), IMPOSSIBLE))


def propagated_gain(
    albedo: NDArray, predicted: NDArray, confidence: NDArray, segment: NDArray, region: NDArray
) -> NDArray[np.float32]:
    """Factor (N, 3) that brings the network's D to the level of its surroundings: the weighted median of
    ``albedo`` / ``predicted`` (N, 3) over the confident surfels of the segment, drawn to that of the smooth
    region, and this to the room's, where few are confident."""
    ratio = np.log(np.maximum(albedo, MIN_RATIO_ALBEDO) / np.maximum(predicted, MIN_RATIO_ALBEDO))
    room = np.array([_weighted_median(ratio[:, c], confidence) for c in range(3)])
    of_region = _shrunk_medians(ratio, confidence, region, np.broadcast_to(room, ratio.shape))
    return np.exp(_shrunk_medians(ratio, confidence, segment, of_region)).astype(np.float32)


def _shrunk_medians(values: NDArray, weight: NDArray, group: NDArray, toward: NDArray) -> NDArray:
    """Of each row (N, 3), its group's weighted median, drawn to ``toward`` (N, 3) as :data:`GAIN_SURFELS`
    more values would."""
    order = np.argsort(group, kind="stable")
    keys, first = np.unique(group[order], return_index=True)
    start = np.append(first, len(order)).astype(np.int64)
    medians = weighted_medians(
        start, values[order].astype(np.float32), np.maximum(weight[order], 1e-9).astype(np.float32)
    )
    index = np.searchsorted(keys, group)
    total = np.bincount(index, weight, len(keys))[index][:, None]
    return (total * medians[index] + GAIN_SURFELS * toward) / (total + GAIN_SURFELS)


def _weighted_median(values: NDArray, weight: NDArray) -> float:
    if weight.sum() <= 0:
        return 0.0
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def _ramp(value: NDArray, ends: tuple[float, float]) -> NDArray:
    """0 below the first of ``ends``, 1 above the second, smooth between."""
    t = np.clip((value - ends[0]) / (ends[1] - ends[0]), 0, 1)
    return t * t * (3 - 2 * t)
