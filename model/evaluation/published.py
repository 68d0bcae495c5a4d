# SPDX-License-Identifier: MIT
"""Figures of the paper (Prakash, Rainer, Bousseau, Drettakis 2022) for scenes that our suites also use.

Its tables do not state the views, the light and the exposure of its re-renderings; its DSSIM is assumed to be
1 - SSIM. *Ours Im.* and *No RP* are errors of maps per view, *Ours* of merged maps.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedMaps:
    """Published mean squared errors of a method's maps, in the order D, S, R."""

    method: str
    is_merged: bool
    mse: tuple[float, float, float]


@dataclass(frozen=True)
class PublishedScene:
    """Published figures of a scene.

    ``images``: (PSNR in dB, DSSIM) by method; ``minutes``: times for statistics, for prediction, and for
    texturing one of the three maps, on a Xeon 5218 with a Quadro RTX 5000.
    """

    num_views: int
    maps: tuple[PublishedMaps, ...]
    images: dict[str, tuple[float, float]]
    minutes: tuple[float, float, float]


PUBLISHED = {
    "veach-ajar": PublishedScene(
        160,
        (
            PublishedMaps("Ours", True, (0.022135, 0.016522, 0.055563)),
            PublishedMaps("Ours Im.", False, (0.030718, 0.049969, 0.064362)),
            PublishedMaps("No RP", False, (0.141682, 0.055459, 0.372725)),
        ),
        {"Ours": (21.53, 0.27), "LiEtAl": (12.97, 0.37), "Texture": (18.70, 0.30)},
        (7.56, 3.93, 3.12),
    ),
    "dining-room": PublishedScene(
        105,
        (
            PublishedMaps("Ours", True, (0.026491, 0.028250, 0.071609)),
            PublishedMaps("Ours Im.", False, (0.026642, 0.024123, 0.077578)),
            PublishedMaps("No RP", False, (0.053104, 0.032385, 0.048222)),
        ),
        {"Ours": (21.77, 0.34), "LiEtAl": (21.33, 0.36), "Texture": (15.12, 0.62)},
        (4.56, 3.26, 1.32),
    ),
}
"""Published figures by scene name."""
