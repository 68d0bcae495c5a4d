# SPDX-License-Identifier: MIT
"""Colour encodings with their inverses, and exposure. Linear colours have Rec.709 primaries and D65."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

LUMINANCE_WEIGHTS = np.array([0.212671, 0.715160, 0.072169])
"""Rec.709 luminance weights of linear RGB, as used by Mitsuba."""

_LOG_EPSILON = 0.01  # keeps the logarithm finite at 0; trained networks depend on this value


def srgb_from_linear(linear: NDArray[Any]) -> NDArray[Any]:
    """Encode linear values as sRGB; negative values are clamped to 0, values above 1 are not clamped."""
    linear = np.maximum(linear, 0.0)
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(np.maximum(linear, 1e-12), 1 / 2.4) - 0.055
    )


def linear_from_srgb(srgb: NDArray[Any]) -> NDArray[Any]:
    """Inverse of :func:`srgb_from_linear`; negative input is clamped to 0."""
    srgb = np.maximum(srgb, 0.0)
    return np.where(srgb <= 0.04045, srgb / 12.92, np.power((srgb + 0.055) / 1.055, 2.4))


def luminance(linear_rgb: NDArray[Any]) -> NDArray[Any]:
    """Return the Rec.709 luminance (...) of linear colours (..., 3)."""
    luminances: NDArray[Any] = linear_rgb @ LUMINANCE_WEIGHTS.astype(linear_rgb.dtype)
    return luminances


def log_from_linear(linear: NDArray[Any]) -> NDArray[Any]:
    """Encode linear values x, clipped to [0, 1], as 2 ln(1 + 100 x) / ln 101 - 1, in [-1, 1]."""
    x = np.clip(linear, 0.0, 1.0)
    span = np.log(1 + _LOG_EPSILON) - np.log(_LOG_EPSILON)
    encoded: NDArray[Any] = 2 * (np.log(x + _LOG_EPSILON) - np.log(_LOG_EPSILON)) / span - 1
    return encoded


def linear_from_log(encoded: NDArray[Any]) -> NDArray[Any]:
    """Inverse of :func:`log_from_linear` on [-1, 1]."""
    span = np.log(1 + _LOG_EPSILON) - np.log(_LOG_EPSILON)
    radiance: NDArray[Any] = np.exp((encoded + 1) / 2 * span + np.log(_LOG_EPSILON)) - _LOG_EPSILON
    return radiance


def exposure_for(linear_rgb: NDArray[Any], valid_mask: NDArray[Any] | None = None) -> float:
    """Return the factor that maps the 95th percentile of an image's luminance to 0.9.

    ``linear_rgb`` (..., 3); ``valid_mask`` (...): False for ignored pixels. The factor of a black image is 1.
    """
    values = luminance(np.asarray(linear_rgb, dtype=np.float64))
    if valid_mask is not None:
        values = values[valid_mask]
    values = values[np.isfinite(values)]
    if values.size == 0:
        return 1.0
    reference = float(np.percentile(values, 95))
    return 0.9 / reference if reference > 0 else 1.0


def cividis() -> list[list[int]]:
    """Return matplotlib's colour map cividis as 256 sRGB colours [red, green, blue], 0 to 255."""
    from matplotlib import colormaps

    colors = colormaps["cividis"](np.linspace(0, 1, 256))[:, :3]
    rows: list[list[int]] = (colors * 255 + 0.5).astype(int).tolist()
    return rows


MAX_CLIPPED_SHARE = 0.025
MIN_MEDIAN = 0.1  # an image with a lower median luminance looks dark; middle grey is 0.18
MAX_DARK_CLIPPED_SHARE = 0.1  # for images that would look dark otherwise


def photographic_exposure(linear_rgb: NDArray[Any], valid_mask: NDArray[Any] | None = None) -> float:
    """Return an exposure factor for display.

    The factor of :func:`exposure_for` is lowered if more than :data:`MAX_CLIPPED_SHARE` of the pixels would
    have a channel above 1, as under a warm lamp or in the sun. If the median luminance is then below
    :data:`MIN_MEDIAN`, as in a room with sky-lit blinds, the factor is raised to reach it, with at most
    :data:`MAX_DARK_CLIPPED_SHARE` of clipped pixels. ``linear_rgb`` (..., 3); ``valid_mask`` (...): False for
    ignored pixels, such as lamps and windows.
    """
    exposure = exposure_for(linear_rgb, valid_mask)
    colors = np.asarray(linear_rgb, dtype=np.float64)
    colors = colors[valid_mask] if valid_mask is not None else colors.reshape(-1, 3)
    colors = colors[np.isfinite(colors).all(axis=-1)]
    if colors.size == 0:
        return exposure
    shares = [1 - MAX_CLIPPED_SHARE, 1 - MAX_DARK_CLIPPED_SHARE]
    highlight, dark_highlight = np.quantile(colors.max(axis=-1), shares, method="higher").tolist()
    if highlight > 0:
        exposure = min(exposure, 1.0 / highlight)
    median = float(np.median(luminance(colors)))
    return max(exposure, min(MIN_MEDIAN / median, 1.0 / dark_highlight)) if median > 0 else exposure


def clipped_share(linear_rgb: NDArray[Any], exposure: float, valid_mask: NDArray[Any] | None = None) -> float:
    """Return the share of pixels of ``linear_rgb`` (..., 3) with a channel above 1 at ``exposure``.

    ``valid_mask`` (...): False for ignored pixels. The share is 0 if all are ignored.
    """
    brightest = np.asarray(linear_rgb, dtype=np.float64).max(axis=-1)
    chosen = brightest[valid_mask] if valid_mask is not None else brightest
    return float((chosen * exposure > 1).mean()) if chosen.size else 0.0


def color_of_temperature(kelvin: float) -> tuple[float, float, float]:
    """Return a black body's Rec.709 colour of luminance 1 (Kim 2002); clamps ``kelvin`` to 1667..25000."""
    t = min(max(kelvin, 1667.0), 25000.0)
    if t < 4000:
        x = -0.2661239e9 / t**3 - 0.2343589e6 / t**2 + 0.8776956e3 / t + 0.179910
    else:
        x = -3.0258469e9 / t**3 + 2.1070379e6 / t**2 + 0.2226347e3 / t + 0.240390
    if t < 2222:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif t < 4000:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    xyz = np.array([x / y, 1.0, (1 - x - y) / y])
    rgb_from_xyz = np.array(
        [
            [3.2404542, -1.5371385, -0.4985314],
            [-0.9692660, 1.8760108, 0.0415560],
            [0.0556434, -0.2040259, 1.0572252],
        ]
    )
    rgb = np.maximum(rgb_from_xyz @ xyz, 0.0)
    rgb /= float(rgb @ LUMINANCE_WEIGHTS)
    return (float(rgb[0]), float(rgb[1]), float(rgb[2]))
