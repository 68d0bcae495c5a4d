# SPDX-License-Identifier: MIT
"""Figures of merit, each with its convention.

Maps: mean squared error of linear values over the surface pixels of all views and the map's channels.
Images: both are multiplied by one exposure, clipped to [0, 1] and sRGB-encoded; PSNR with data range 1; SSIM
with an 11 x 11 Gaussian window of sigma 1.5 (Wang et al. 2004), mean over channels; DSSIM = 1 - SSIM;
LPIPS-VGG version 0.1. Each is computed view by view and averaged. With a gain: the rendered images are first
multiplied by one factor for all views, the median of the ratios of luminance over surface pixels, as a light
would be turned up or down by hand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import exposure_for, luminance, srgb_from_linear
from datagen.foundation.errors import InputError
from model.evaluation.rendering import JudgedView
from model.reconstruction.atlas.atlas import MAP_NAMES

MAX_PSNR_DB = 99.0  # of equal images, where the formula gives infinity
_SSIM_SIGMA = 1.5
_DARK = 1e-6  # keeps the ratio of two black pixels at 1


@dataclass
class MapSums:
    """Squared errors of maps added up over views, and how much of the true surface had a counterpart."""

    squared: dict[str, float] = field(default_factory=lambda: dict.fromkeys(MAP_NAMES, 0.0))
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(MAP_NAMES, 0))
    num_surface: int = 0
    num_covered: int = 0

    def add(
        self, maps: Mapping[str, NDArray], truth: JudgedView, has_surface: NDArray[np.bool_] | None = None
    ) -> None:
        """Count a view; pixels outside ``has_surface`` (H, W) are not compared and not covered."""
        mask = truth.surface_mask if has_surface is None else truth.surface_mask & has_surface
        self.num_surface += int(truth.surface_mask.sum())
        self.num_covered += int(mask.sum())
        for name in MAP_NAMES:
            error = maps[name][mask].astype(np.float64) - truth.maps[name][mask]
            self.squared[name] += float((error**2).sum())
            self.counts[name] += error.size

    def mse(self) -> dict[str, float]:
        """Mean squared error by map."""
        return {name: self.squared[name] / max(self.counts[name], 1) for name in MAP_NAMES}

    @property
    def covered_share(self) -> float:
        """Share of the true surface's pixels that were compared."""
        return self.num_covered / max(self.num_surface, 1)


def common_exposure(views: Sequence[JudgedView]) -> float:
    """One exposure for all: the 95th percentile of the luminance of their surface pixels goes to 0.9."""
    return exposure_for(np.concatenate([view.color[view.surface_mask] for view in views]))


def shown(color: NDArray, exposure: float) -> NDArray[np.float64]:
    """Exposed, clipped and sRGB-encoded, in [0, 1]."""
    return np.asarray(srgb_from_linear(np.clip(color.astype(np.float64) * exposure, 0.0, 1.0)))


def psnr_db(image: NDArray, truth: NDArray) -> float:
    """Peak signal-to-noise ratio of images in [0, 1]."""
    mse = float(((image - truth) ** 2).mean())
    return MAX_PSNR_DB if mse == 0 else min(MAX_PSNR_DB, float(-10.0 * np.log10(mse)))


def ssim(image: NDArray, truth: NDArray) -> float:
    """Structural similarity of (H, W, 3) images in [0, 1]."""
    from skimage.metrics import structural_similarity

    value = structural_similarity(
        image,
        truth,
        gaussian_weights=True,  # 11 pixels wide at this sigma
        sigma=_SSIM_SIGMA,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
    )
    return float(value)


class Lpips:
    """LPIPS-VGG where its weights are at hand; ``absence`` says why not."""

    def __init__(self) -> None:
        from model.training.weights import find_vgg

        self.absence = ""
        try:
            self._layers = find_vgg()
        except InputError as error:
            self.absence = str(error)

    def __call__(self, image: NDArray, truth: NDArray) -> float | None:
        """Distance of two (H, W, 3) sRGB-encoded images in [0, 1]; None without weights."""
        if self.absence:
            return None
        import torch

        from model.training.perceptual import lpips_vgg

        pair = [
            torch.from_numpy(np.ascontiguousarray(x.transpose(2, 0, 1), np.float32))[None] * 2 - 1
            for x in (image, truth)
        ]
        with torch.no_grad():
            return float(lpips_vgg(self._layers, pair[0], pair[1]))


def fitted_gain(rendered: Mapping[str, JudgedView], truth: Mapping[str, JudgedView]) -> float:
    """The factor that brings most of the rendered surfaces to the true luminance."""
    ratios = []
    for name, view in truth.items():
        mask = view.surface_mask & rendered[name].surface_mask
        bright = np.maximum(luminance(rendered[name].color[mask]), _DARK)
        ratios.append(np.maximum(luminance(view.color[mask]), _DARK) / bright)
    joined = np.concatenate(ratios) if ratios else np.zeros(0)
    return float(np.median(joined)) if joined.size else 1.0


def image_figures(
    rendered: Mapping[str, JudgedView], truth: Mapping[str, JudgedView], exposure: float, lpips: Lpips
) -> dict[str, float | None]:
    """Means over the views of ``truth``."""
    rows: list[dict[str, float | None]] = []
    gain = fitted_gain(rendered, truth)
    for name, true_view in truth.items():
        brought = shown(rendered[name].color, exposure * gain)
        a, b = (shown(view.color, exposure) for view in (rendered[name], true_view))
        linear = [np.clip(v.color.astype(np.float64) * exposure, 0, 1) for v in (rendered[name], true_view)]
        similarity = ssim(a, b)
        rows.append(
            {
                "psnr_srgb_db": psnr_db(a, b),
                "psnr_linear_db": psnr_db(linear[0], linear[1]),
                "ssim": similarity,
                "dssim": 1.0 - similarity,
                "lpips_vgg": lpips(a, b),
                "gain": gain,
                "psnr_gain_db": psnr_db(brought, b),
                "dssim_gain": 1.0 - ssim(brought, b),
            }
        )
    if not rows:
        return {}
    return {
        key: None if (values := [row[key] for row in rows])[0] is None else float(np.mean(values))  # type: ignore[arg-type]
        for key in rows[0]
    }
