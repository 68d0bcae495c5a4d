# SPDX-License-Identifier: MIT
"""Conversion of metallic-roughness materials (glTF, texture folders) to D, S and R:

D = base (1 - metallic),  S = F0 (1 - metallic) + base metallic,  R = roughness

A channel given by one unprocessed image is kept as it is; only products of images are baked.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.importers.channels import ColorValue, ImageCache, ScalarValue, is_constant

DEFAULT_F0 = 0.04
_MIN_AGREEMENT = 0.2  # correlation of normals and height; matching pairs reach 0.3 to 0.96
_END_TOLERANCE = 0.02  # JPEG noise in a metalness image intended to be all 0 or all 1


def metallic_roughness(
    cache: ImageCache,
    label: str,
    base: ColorValue,
    metallic: ScalarValue,
    roughness: ScalarValue,
    f0: ColorValue = (DEFAULT_F0,) * 3,
) -> tuple[ColorValue, ColorValue, ScalarValue]:
    """Convert a material to D, S and R; names of baked files begin with ``label``."""
    metallic = settled(cache, metallic)
    if metallic == 0.0:
        return base, f0, roughness
    if metallic == 1.0:
        return (0.0, 0.0, 0.0), base, roughness
    diffuse = cache.color(f"{label}_diffuse_albedo", lambda b, m: b * (1 - m), base, scalars=(metallic,))
    specular = cache.color(
        f"{label}_specular_albedo", lambda b, s, m: s * (1 - m) + b * m, base, f0, scalars=(metallic,)
    )
    return diffuse, specular, roughness


def settled(cache: ImageCache, value: ScalarValue) -> ScalarValue:
    """Return 0 or 1 if all pixels of ``value``'s image are within 0.02 of that number, else ``value``."""
    if is_constant(value):
        return value
    pixels = cache.values(value, is_scalar=True)
    if float(pixels.max()) <= _END_TOLERANCE:
        return 0.0
    if float(pixels.min()) >= 1 - _END_TOLERANCE:
        return 1.0
    return value


def green_points_up(pixels: NDArray, height: NDArray | None = None) -> bool:
    """Return whether the ``pixels`` (H, W, 3) of a normal map imply +Y up (OpenGL), not down (DirectX).

    If a ``height`` image of the same size correlates with the normals, the sign of the correlation decides.
    Otherwise, the curl decides: the slopes p = nx / nz and q = ny / nz of a height field satisfy dp/dv =
    dq/du. With rows downwards, this is dp/drow + dq/dcolumn = 0 for OpenGL and dp/drow - dq/dcolumn = 0 for
    DirectX; the convention with the smaller residual is assumed. Columns and rows wrap around.
    """
    values = pixels[..., :3].astype(np.float64) / np.iinfo(pixels.dtype).max * 2 - 1
    if height is not None and height.shape[:2] == pixels.shape[:2]:
        rise = height[..., 0].astype(np.float64)
        slope_v = np.roll(rise, 1, axis=0) - np.roll(rise, -1, axis=0)  # v is opposite to the rows
        if slope_v.std() > 0 and values[..., 1].std() > 0:
            agreement = float(np.corrcoef(values[..., 1].ravel(), -slope_v.ravel())[0, 1])
            if abs(agreement) > _MIN_AGREEMENT:
                return agreement > 0
    depth = np.maximum(values[..., 2], 0.1)  # a steep or missing z would dominate the sums
    p, q = values[..., 0] / depth, values[..., 1] / depth
    dp = np.roll(p, -1, axis=0) - np.roll(p, 1, axis=0)
    dq = np.roll(q, -1, axis=1) - np.roll(q, 1, axis=1)
    return float(((dp + dq) ** 2).sum()) <= float(((dp - dq) ** 2).sum())
