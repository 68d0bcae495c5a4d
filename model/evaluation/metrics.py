# SPDX-License-Identifier: MIT
"""Image metrics and their conventions; metrics of maps are in ``map_measures``.

Both images are multiplied by one exposure, clipped to [0, 1] and sRGB-encoded. PSNR has data range 1,
SSIM an 11 x 11 Gaussian window of sigma 1.5 (Wang et al. 2004), averaged over channels; DSSIM is 1 - SSIM;
LPIPS is LPIPS-VGG 0.1. Each is computed per view and averaged. Metrics *with a gain* are computed after
multiplying all rendered images by the median ratio of true to rendered luminance over surface pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import exposure_for, luminance, srgb_from_linear
from model.evaluation.lpips import Lpips
from model.evaluation.rendering import JudgedView

MAX_PSNR_DB = 99.0  # for equal images, whose PSNR is infinite
_SSIM_SIGMA = 1.5
_DARK = 1e-6  # keeps the ratio of two black pixels at 1


def common_exposure(views: Sequence[JudgedView]) -> float:
    """Factor that scales the 95th percentile of the luminance of all views' surface pixels to 0.9."""
    return exposure_for(np.concatenate([view.color[view.surface_mask] for view in views]))


def shown(color: NDArray, exposure: float) -> NDArray[np.float64]:
    """Multiply linear ``color`` (H, W, 3) by ``exposure``, clip it to [0, 1] and encode it as sRGB."""
    return np.asarray(srgb_from_linear(np.clip(color.astype(np.float64) * exposure, 0.0, 1.0)))


def psnr_db(image: NDArray, truth: NDArray) -> float:
    """Peak signal-to-noise ratio in dB of images of equal shape in [0, 1], at most ``MAX_PSNR_DB``."""
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


def fitted_gain(rendered: Mapping[str, JudgedView], truth: Mapping[str, JudgedView]) -> float:
    """Median ratio of true to rendered luminance over surface pixels of all views; 1 without such pixels."""
    ratios = []
    for name, view in truth.items():
        mask = view.surface_mask & rendered[name].surface_mask
        bright = np.maximum(luminance(rendered[name].color[mask]), _DARK)
        ratios.append(np.maximum(luminance(view.color[mask]), _DARK) / bright)
    joined = np.concatenate(ratios) if ratios else np.zeros(0)
    return float(np.median(joined)) if joined.size else 1.0


def image_figures(
    rendered: Mapping[str, JudgedView], truth: Mapping[str, JudgedView], exposure: float, lpips: Lpips | None
) -> dict[str, dict[str, float | None]]:
    """Metrics of ``rendered`` against ``truth`` at ``exposure``, by view and name; LPIPS is optional."""
    gain = fitted_gain(rendered, truth)
    return {
        name: _figures_of(rendered[name], true_view, exposure, gain, lpips)
        for name, true_view in truth.items()
    }


def _figures_of(
    view: JudgedView, true_view: JudgedView, exposure: float, gain: float, lpips: Lpips | None
) -> dict[str, float | None]:
    gained = shown(view.color, exposure * gain)
    a, b = (shown(v.color, exposure) for v in (view, true_view))
    linear = [np.clip(v.color.astype(np.float64) * exposure, 0, 1) for v in (view, true_view)]
    similarity = ssim(a, b)
    return {
        "psnr_srgb_db": psnr_db(a, b),
        "psnr_linear_db": psnr_db(linear[0], linear[1]),
        "ssim": similarity,
        "dssim": 1.0 - similarity,
        "lpips_vgg": None if lpips is None else lpips(a, b),
        "gain": gain,
        "psnr_gain_db": psnr_db(gained, b),
        "dssim_gain": 1.0 - ssim(gained, b),
    }


def means(rows: Mapping[str, Mapping[str, float | None]]) -> dict[str, float | None]:
    """Mean over views of each metric of ``rows`` (by view and name), None if a view lacks it."""
    found: dict[str, float | None] = {}
    for key in next(iter(rows.values()), {}):
        values = [row[key] for row in rows.values()]
        known = [value for value in values if value is not None]
        found[key] = float(np.mean(known)) if len(known) == len(values) else None
    return found
