# SPDX-License-Identifier: MIT
"""Errors of maps, in total and by kind of surface, scale errors, and measures of other publications.

All squared errors are of linear values over surface pixels and channels. ``diffuse gain``: the factor for the
whole scene that minimises the squared error of D; ``region gain``: one such factor for each region of the
scene, which leaves the error within regions. ``level error``: |ln(mean estimate / mean truth)| of the
luminance of D in a region, as the median over surface pixels.

``kd``, ``a'`` and ``roughness`` follow the public evaluation of IRIS (``utils/metric_brdf.py``), the source
of FIPT's figures: PSNR of whole views in 8-bit values, with emitters (and, for kd, all pixels of roughness
below 1) set to zero in both images; the views' decibels are averaged. Our kd is D, and our a' is (1 - S) D +
S; IRIS uses the diffuse colour and the integrated reflectance of Disney's lobe. An emitter's pixels are those
of emitting surfaces without a material.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.color import luminance
from model.evaluation.rendering import JudgedView
from model.evaluation.surface_kinds import ViewSurfaces

D, S, R = MATERIAL_MAPS
_FLOOR = 1e-4  # keeps the logarithm of a black region finite
_MIN_MSE = 1e-10  # 100 dB in place of infinity, as in the published code
_MIN_ROUGHNESS = 0.2
QUARTERS = 4


@dataclass
class MapMeasures:
    """Errors accumulated over views.

    ``squared``: sums of squared errors by kind of surface and map; ``pixels``: numbers of pixels by kind;
    ``views``: mean squared errors by view and map, and each view's number of ``pixels``; ``num_surface``:
    number of true surface pixels.
    """

    squared: dict[str, dict[str, float]] = field(default_factory=dict)
    pixels: dict[str, int] = field(default_factory=dict)
    views: dict[str, dict[str, float]] = field(default_factory=dict)
    num_surface: int = 0
    _pairs: list[tuple[NDArray, NDArray, NDArray]] = field(default_factory=list)
    _others: list[dict[str, float]] = field(default_factory=list)
    _sure: list[tuple[NDArray, NDArray]] = field(default_factory=list)

    def add(
        self,
        view: str,
        maps: Mapping[str, NDArray],
        truth: JudgedView,
        surfaces: ViewSurfaces,
        *,
        rendered: JudgedView | None = None,
        confidence: NDArray | None = None,
    ) -> None:
        """Add errors of a view's ``maps`` (H, W, C), split by the kinds in ``surfaces``.

        ``rendered`` is the view of the recovered scene if the maps are rendered from it: pixels where it has
        no surface are excluded, and its emission is compared. ``confidence`` (H, W, 3): of D, S and R.
        """
        mask = truth.surface_mask if rendered is None else truth.surface_mask & rendered.surface_mask
        errors = {n: ((maps[n].astype(np.float64) - truth.maps[n]) ** 2).mean(axis=2) for n in MATERIAL_MAPS}
        for kind, where in {"all": mask, **surfaces.kinds}.items():
            chosen = where & mask
            sums = self.squared.setdefault(kind, dict.fromkeys(MATERIAL_MAPS, 0.0))
            self.pixels[kind] = self.pixels.get(kind, 0) + int(chosen.sum())
            for name in MATERIAL_MAPS:
                sums[name] += float(errors[name][chosen].sum())
        self.num_surface += int(truth.surface_mask.sum())
        seen = max(int(mask.sum()), 1)
        self.views[view] = {name: float(errors[name][mask].sum()) / seen for name in MATERIAL_MAPS}
        self.views[view]["pixels"] = float(mask.sum())
        diffuse = [maps[D][mask].astype(np.float64), truth.maps[D][mask].astype(np.float64)]
        self._pairs.append((diffuse[0], diffuse[1], surfaces.region[mask]))
        self._others.append(measures_of_others(maps, truth, rendered))
        if confidence is not None:
            stacked = np.stack([np.sqrt(errors[n][mask]) for n in MATERIAL_MAPS], axis=1)
            self._sure.append((confidence[mask].astype(np.float64), stacked))

    def figures(self) -> dict[str, float]:
        """Figures by name: PSNR of maps (dB), errors of D after gains, level error, and measures of FIPT."""
        found = {f"{name}_psnr_db": psnr_of_mse(mse) for name, mse in self.mse().items()}
        estimate, truth, region = (np.concatenate(part) for part in zip(*self._pairs, strict=True))
        found |= level_figures(estimate, truth, region)
        for key in dict.fromkeys(key for row in self._others for key in row):
            found[key] = float(np.mean([row[key] for row in self._others if key in row]))
        return found

    def mse(self) -> dict[str, float]:
        """Mean squared error over all compared pixels, by map."""
        count = max(self.pixels.get("all", 0), 1)
        return {name: self.squared["all"][name] / count for name in MATERIAL_MAPS}

    @property
    def covered_share(self) -> float:
        """Share of the true surface pixels that were compared."""
        return self.pixels.get("all", 0) / max(self.num_surface, 1)

    def by_kind(self) -> dict[str, dict[str, float]]:
        """Mean squared errors by kind of surface and map, and each kind's ``share`` of compared pixels."""
        return {
            kind: {
                "share": self.pixels[kind] / max(self.pixels["all"], 1),
                **{name: self.squared[kind][name] / self.pixels[kind] for name in MATERIAL_MAPS},
            }
            for kind in self.squared
            if self.pixels[kind]
        }

    def calibration(self) -> dict[str, list[float]]:
        """Calibration of the confidence, by map; empty without confidence.

        Each list contains the rank correlation of confidence and negative error, then the root mean square
        errors of the quartiles of the pixels in order of increasing confidence.
        """
        if not self._sure:
            return {}
        from scipy.stats import spearmanr

        confidence, errors = (np.concatenate(part) for part in zip(*self._sure, strict=True))
        found = {}
        for k, name in enumerate(MATERIAL_MAPS):
            order = np.argsort(confidence[:, k], kind="stable")
            is_constant = min(np.ptp(confidence[:, k]), np.ptp(errors[:, k])) == 0
            correlation = 0.0 if is_constant else float(spearmanr(confidence[:, k], -errors[:, k]).statistic)
            quarters = np.array_split(errors[order, k], QUARTERS)
            roots = [float(np.sqrt((quarter**2).mean())) for quarter in quarters]
            found[name] = [correlation, *roots]
        return found


def level_figures(estimate: NDArray, truth: NDArray, region: NDArray) -> dict[str, float]:
    """Scale errors of ``estimate`` against ``truth``, D of N pixels (N, 3): the best gain, the mean squared
    error after it and after one gain per ``region`` (N,), and the level error (see the module's docstring).
    """
    square = (estimate**2).sum()
    gain = float((estimate * truth).sum() / square) if square > 0 else 1.0
    index = np.unique(region, return_inverse=True)[1]

    def summed(values: NDArray) -> NDArray[np.float64]:
        return np.bincount(index, values).astype(np.float64)

    products, squares = summed((estimate * truth).sum(axis=1)), summed((estimate**2).sum(axis=1))
    gains = np.where(squares > 0, products / np.maximum(squares, 1e-30), 1.0)
    counts = np.maximum(summed(np.ones(len(index))), 1)
    means = [np.maximum(summed(luminance(values)) / counts, _FLOOR) for values in (estimate, truth)]
    level = np.abs(np.log(means[0] / means[1]))
    return {
        "diffuse_gain": gain,
        "diffuse_mse_gain": float(((gain * estimate - truth) ** 2).mean()),
        "diffuse_mse_region_gain": float(((gains[index][:, None] * estimate - truth) ** 2).mean()),
        "level_error": float(np.median(level[index])),
    }


def psnr_of_mse(mse: float) -> float:
    """PSNR in dB of values with a range of 1; at most 100 dB."""
    return float(-10.0 * np.log10(max(mse, _MIN_MSE)))


def _eight_bits(values: NDArray) -> NDArray[np.float64]:
    return np.floor(np.clip(values.astype(np.float64), 0, 1) * 255) / 255


def measures_of_others(
    maps: Mapping[str, NDArray], truth: JudgedView, rendered: JudgedView | None = None
) -> dict[str, float]:
    """PSNR of ``kd``, ``a_prime`` and ``roughness`` of one view in dB, by name.

    For a rendered view whose truth contains an emitter, also the IoU of the emitters' pixels and the mean
    squared difference of ln(1 + emission).
    """
    lit = truth.emission_mask
    seen = truth.surface_mask & ~lit  # all other pixels are zero in both images
    rough = np.clip(_eight_bits(truth.maps[R]), _MIN_ROUGHNESS, 1.0)
    matt = rough[..., 0] >= 1.0
    pairs: dict[str, tuple[NDArray, NDArray, NDArray]] = {
        "kd": (maps[D], truth.maps[D], seen & matt),
        "a_prime": (_reflectance(maps), _reflectance(truth.maps), seen),
        "roughness": (np.clip(maps[R], _MIN_ROUGHNESS, 1.0), rough, seen),
    }
    found = {}
    for name, (estimate, true, mask) in pairs.items():
        error = np.where(mask[..., None], _eight_bits(estimate) - _eight_bits(true), 0.0)
        found[f"{name}_db"] = psnr_of_mse(float((error**2).mean()))
    if rendered is not None and lit.any():
        other = rendered.emission_mask
        found["emission_iou"] = float((lit & other).sum() / (lit | other).sum())
        logs = [np.log1p(np.where(v.emission_mask[..., None], v.color, 0.0)) for v in (rendered, truth)]
        found["emission_log_l2"] = float(((logs[0] - logs[1]) ** 2).mean())
    return found


def _reflectance(maps: Mapping[str, NDArray]) -> NDArray[np.float64]:
    specular = maps[S].astype(np.float64)
    return (1 - specular) * maps[D] + specular
