# SPDX-License-Identifier: MIT
"""Counts pixels of a dataset in histograms with fixed bins, so the counts of shards can be added.

Values beyond a histogram's ends are counted in its outermost bins. Only surface pixels are counted: pixels
hit by a ray and at least half covered by reflecting surface. Luminance is Rec.709 of linear colour. The
chroma of a colour is max(R, G, B) - min(R, G, B); hue is as in HSV, in degrees.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.formats.configuration import GLOSSY_ROUGHNESS, METAL_SPECULAR
from datagen.foundation.buffers import surface_pixels
from datagen.foundation.color import luminance

_MIN_CHROMA = 0.02  # the hue of a grey is noise
NUM_COVERAGE_BINS = 32


@dataclass(frozen=True)
class Axis:
    """Axis of a histogram: increasing ``edges`` of the bins, and their spacing ``scale``."""

    title: str
    unit: str
    edges: tuple[float, ...]
    scale: Literal["linear", "log", "whole"] = "linear"

    @classmethod
    def linear(cls, title: str, unit: str, low: float, high: float, num: int) -> Axis:
        return cls(title, unit, tuple(np.linspace(low, high, num + 1).tolist()))

    @classmethod
    def whole(cls, title: str, unit: str, low: int, high: int) -> Axis:
        """An axis with one bin for each integer from ``low`` to ``high``."""
        return cls(title, unit, tuple(np.arange(low - 0.5, high + 1).tolist()), "whole")

    @classmethod
    def log(cls, title: str, unit: str, low: float, high: float, num: int) -> Axis:
        return cls(title, unit, tuple(np.geomspace(low, high, num + 1).tolist()), "log")

    def count(self, values: NDArray | Sequence[float]) -> NDArray[np.int64]:
        """Number of ``values`` in each bin, of shape (len(edges) - 1,); NaN is ignored."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        flat = flat[~np.isnan(flat)]
        return np.histogram(np.clip(flat, self.edges[0], self.edges[-1]), self.edges)[0]


PIXEL_AXES: dict[str, Axis] = {
    "diffuse_luminance": Axis.linear("Luminance of D", "1", 0, 1, 64),
    "diffuse_chroma": Axis.linear("Chroma of D", "1", 0, 1, 64),
    "diffuse_hue": Axis.linear("Hue of D", "degrees", 0, 360, 36),
    "specular_luminance": Axis.log("Luminance of S (F0)", "1", 0.01, 1, 50),
    "roughness": Axis.linear("Roughness R", "1", 0, 1, 64),
    "depth": Axis.log("Depth", "m", 0.1, 100, 60),
    "observation_count": Axis.whole("Views in a pixel's statistics", "views", 0, 24),
}
"""Axes of the histograms over surface pixels."""


def hue_deg(colors: NDArray) -> NDArray:
    """Hue (N,) of linear colours (N, 3) in degrees, [0, 360); NaN if the chroma is at most 0.02."""
    largest, chroma = colors.max(axis=-1), np.ptp(colors, axis=-1)
    red, green, blue = np.moveaxis(colors, -1, 0)
    safe = np.where(chroma > _MIN_CHROMA, chroma, 1)
    sextant = np.select(
        [largest == red, largest == green],
        [((green - blue) / safe) % 6, (blue - red) / safe + 2],
        (red - green) / safe + 4,
    )
    return np.where(chroma > _MIN_CHROMA, (60 * sextant) % 360, np.nan)


def count_view(view: Mapping[str, NDArray]) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.int64]]:
    """Histograms of a view's surface pixels, by name in :data:`PIXEL_AXES`, and a joint histogram of R and D.

    The joint histogram has :data:`NUM_COVERAGE_BINS` bins per side over [0, 1]: R by row, luminance of D by
    column. A buffer that the view lacks has no histogram.
    """
    mask = surface_pixels(view)
    values: dict[str, NDArray] = {}
    if "diffuse_albedo" in view:
        diffuse = view["diffuse_albedo"][mask].astype(np.float64)
        values["diffuse_luminance"] = luminance(diffuse)
        values["diffuse_chroma"] = np.ptp(diffuse, axis=-1)
        values["diffuse_hue"] = hue_deg(diffuse)
    if "specular_albedo" in view:
        values["specular_luminance"] = luminance(view["specular_albedo"][mask].astype(np.float64))
    for name in ("roughness", "depth", "observation_count"):
        buffer = "depth_z_m" if name == "depth" else name
        if buffer in view:
            values[name] = view[buffer][..., 0][mask].astype(np.float64)
    coverage = np.zeros((NUM_COVERAGE_BINS, NUM_COVERAGE_BINS), dtype=np.int64)
    if "roughness" in values and "diffuse_luminance" in values:
        pairs = np.stack([values["roughness"], values["diffuse_luminance"]])
        is_finite = np.isfinite(pairs).all(axis=0)
        cells = np.clip((pairs[:, is_finite] * NUM_COVERAGE_BINS).astype(int), 0, NUM_COVERAGE_BINS - 1)
        np.add.at(coverage, tuple(cells), 1)
    return {name: PIXEL_AXES[name].count(found) for name, found in values.items()}, coverage


def count_metal_and_gloss(view: Mapping[str, NDArray]) -> dict[str, int]:
    """Count a view's surface pixels in total, on metal and on glossy materials."""
    mask = surface_pixels(view)
    return {
        "surface_pixels": int(mask.sum()),
        "metal_pixels": int((view["specular_albedo"].max(axis=-1)[mask] > METAL_SPECULAR).sum()),
        "gloss_pixels": int((view["roughness"][..., 0][mask] < GLOSSY_ROUGHNESS).sum()),
    }


def nice_axis(title: str, unit: str, values: Sequence[float], num: int = 24, log: bool = False) -> Axis:
    """An axis of ``num`` bins over the finite ``values``; logarithmic between powers of 10 if ``log``."""
    finite = [v for v in values if np.isfinite(v) and (v > 0 or not log)]
    low, high = (min(finite), max(finite)) if finite else (0.1, 1.0)
    if log:
        low, high = 10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high * 1.0001))
        return Axis.log(title, unit, float(low), float(high), num)
    if high - low < 1e-9:
        low, high = low - 0.5, high + 0.5
    return Axis.linear(title, unit, low, high, num)
