# SPDX-License-Identifier: MIT
"""Converts D and S to metallic-roughness textures with a specular colour, and measures the error.

In glTF, F0 = lerp(min(0.04 c, 1), base, m) with specular colour c and metalness m, and the diffuse albedo is
base (1 - m). Surfaces with S up to 0.16 (refractive index 2.3) become dielectrics without error: m = 0, base
= D, c = S / 0.04. For larger S, m solves S (1 - m) = 0.16 (1 - m)^2 + D m in the mean over channels, so
viewers without the extension show metals as metals; c compensates for the remainder as far as possible.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import linear_from_srgb, srgb_from_linear
from datagen.foundation.images import encode_png, quantized_bytes
from model.reconstruction.atlas.atlas import Atlas
from model.reconstruction.export.atlas_images import BAND, averaged, texture_shrink

DIELECTRIC_F0 = 0.04
MAX_DIELECTRIC_F0 = 0.16


@dataclass(frozen=True)
class ConversionError:
    """Mean and maximum absolute errors of D and S as decoded by a glTF reader, over the texels with a
    surface, and the side of the textures in texels.
    """

    diffuse_mean: float
    diffuse_max: float
    specular_mean: float
    specular_max: float
    texture_px: int


def metallic_channels(
    diffuse: NDArray[np.float32], specular: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Convert D and S (..., 3) to base colour (..., 3), metalness (...) and specular colour divided by its
    factor 4 (..., 3), all in [0, 1].
    """
    limit = MAX_DIELECTRIC_F0
    d, s = diffuse.mean(axis=-1), specular.mean(axis=-1)
    b = d + s - 2 * limit
    root = np.sqrt(np.maximum(b * b - 4 * limit * (limit - s), 0.0))
    metallic = np.where(specular.max(axis=-1) <= limit, 0.0, np.clip((root - b) / (2 * limit), 0.0, 1.0))
    m = metallic[..., None]
    from_diffuse = diffuse / np.maximum(1 - m, 1e-3)
    from_specular = (specular - limit * (1 - m)) / np.maximum(m, 1e-3)
    base = np.clip(from_diffuse * (1 - m * m) + np.clip(from_specular, 0, 1) * m * m, 0.0, 1.0)
    tint = np.clip((specular - base * m) / np.maximum(limit * (1 - m), 1e-6), 0.0, 1.0)
    tint = np.where(m > 1 - 1e-3, 1.0, tint)
    return tuple(a.astype(np.float32) for a in (base, metallic, tint))  # type: ignore[return-value]


def as_read(base: NDArray, metallic: NDArray, tint: NDArray) -> tuple[NDArray, NDArray]:
    """Decode D and S (..., 3) as a glTF reader does, from the results of :func:`metallic_channels`."""
    m = metallic[..., None]
    return base * (1 - m), np.minimum(MAX_DIELECTRIC_F0 * tint, 1.0) * (1 - m) + base * m


@dataclass(frozen=True)
class MetallicTextures:
    """PNG textures: base colour; ``orm``, which contains occlusion (always 1), roughness and metalness as R,
    G and B; specular colour divided by its factor 4.
    """

    base_color: bytes
    orm: bytes
    specular_color: bytes
    error: ConversionError


def metallic_textures(atlas: Atlas) -> MetallicTextures:
    """Convert an atlas to textures; the reported error includes quantisation."""
    shrink = texture_shrink(atlas)
    bands: list[list[NDArray[np.uint8]]] = [[], [], []]
    sums, most, num = np.zeros(2), np.zeros(2), 0
    for top in range(0, atlas.size, BAND * shrink):
        rows = slice(top, top + BAND * shrink)
        diffuse, specular, rough = (averaged(atlas.maps[name][rows], shrink) for name in atlas.maps)
        base, metallic, tint = metallic_channels(diffuse, specular)
        packed = np.stack([np.ones_like(metallic), rough[..., 0], metallic], axis=-1)
        encoded = [srgb_from_linear(base), packed, srgb_from_linear(tint)]
        stored = [quantized_bytes(image) for image in encoded]
        for band, image in zip(bands, stored, strict=True):
            band.append(image)
        read = as_read(
            linear_from_srgb(stored[0] / 255.0),
            stored[1][..., 2] / 255.0,
            linear_from_srgb(stored[2] / 255.0),
        )
        on_surface = atlas.face[rows][::shrink, ::shrink] >= 0
        num += int(on_surface.sum())
        for k, (got, truth) in enumerate(zip(read, (diffuse, specular), strict=True)):
            difference = np.abs(got - truth)[on_surface]
            sums[k] += float(difference.sum()) / 3
            most[k] = max(most[k], float(difference.max(initial=0)))
        atlas.release()
    mean = sums / max(num, 1)
    errors = (float(mean[0]), float(most[0]), float(mean[1]), float(most[1]))
    error = ConversionError(*errors, atlas.size // shrink)
    base_color, orm, specular_color = (encode_png(np.concatenate(band)) for band in bands)
    return MetallicTextures(base_color, orm, specular_color, error)
