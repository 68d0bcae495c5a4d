# SPDX-License-Identifier: MIT
"""Converts material channels to 8-bit images for the page, with at most ``max_side`` texels per side.

A material has three images. D and S are sRGB-encoded. The third contains R in red, the state of the atlas in
green (255 observed or unknown, 128 filled, 0 without a surface), and the minimum confidence of D, S and R in
blue (0 if unknown). Row 0 is at v = 1. Larger images are downsampled by averaging.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import Material, Texture
from datagen.formats.package import Package
from datagen.formats.textures import texture_values
from datagen.foundation.color import linear_from_srgb, srgb_from_linear
from datagen.foundation.errors import input_error
from datagen.foundation.images import encode_png, quantized_bytes, read_image
from model.reconstruction.export.atlas_images import SEEN

KINDS = ("diffuse", "specular", "rough")


@dataclass(frozen=True)
class PageImage:
    """An image (H, W, C) of a ``kind`` in :data:`KINDS`; ``original_side`` is its longer side in texels
    before any reduction.
    """

    kind: str
    pixels: NDArray[np.uint8]
    original_side: int

    def png(self, max_side: int | None = None) -> bytes:
        """Encode the image as PNG, downsampled to at most ``max_side`` texels per side if given."""
        is_color = self.kind != "rough"
        return encode_png(
            self.pixels if max_side is None else shrunk(self.pixels, max_side, is_color=is_color)
        )


def shrunk(pixels: NDArray[np.uint8], max_side: int, *, is_color: bool) -> NDArray[np.uint8]:
    """Downsample an image (H, W, C), sRGB-encoded if ``is_color``, to sides of at most ``max_side``."""
    longest = max(pixels.shape[:2])
    if longest <= max_side:
        return pixels
    import cv2

    size = tuple(max(1, side * max_side // longest) for side in pixels.shape[1::-1])
    if is_color:  # averaged as linear values, in 16 bits, which preserve the precision of 8-bit sRGB
        linear = np.round(65535 * linear_from_srgb(np.arange(256) / 255)).astype(np.uint16)[pixels]
        small = cv2.resize(linear, size, interpolation=cv2.INTER_AREA)
        return quantized_bytes(srgb_from_linear(small.reshape(size[1], size[0], -1) / 65535))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return small.reshape(size[1], size[0], -1).astype(np.uint8, copy=False)


@dataclass(frozen=True)
class AtlasState:
    """State of an atlas's texels: ``mask`` (N, N) as in ``mask.png``, and ``confidence`` (N, N), the minimum
    over D, S and R; None if unknown.
    """

    mask: NDArray[np.uint8] | None = None
    confidence: NDArray[np.uint8] | None = None


def material_images(
    package: Package, material: Material, state: AtlasState, max_side: int
) -> Iterator[PageImage]:
    """Make the three images of a material with sides of at most ``max_side`` texels; ``state`` describes the
    texels of its roughness texture.

    Raises :class:`InputError` if an image cannot be read, or if roughness and state differ in size.
    """
    for kind, channel in (("diffuse", material.diffuse_albedo), ("specular", material.specular_albedo)):
        pixels, side = _color_bytes(package, channel, max_side)
        yield PageImage(kind, pixels, side)
    rough, side = _rough_bytes(package, material.roughness)
    packed = [rough]
    for name, values, unknown in (("mask", state.mask, SEEN), ("confidence", state.confidence, 0)):
        if values is not None and values.shape != rough.shape:
            got, expected = (" x ".join(map(str, array.shape)) for array in (values, rough))
            remedy = "write both in one run of `materials infer`"
            raise input_error(f"{name}.png", "size", got, expected, remedy)
        packed.append(np.full(rough.shape, unknown, np.uint8) if values is None else values)
    yield PageImage("rough", shrunk(np.stack(packed, axis=-1), max_side, is_color=False), side)


def _pixels(package: Package, texture: Texture) -> NDArray:
    return read_image(package.local_file(texture.texture))


def _color_bytes(package: Package, channel: object, max_side: int) -> tuple[NDArray[np.uint8], int]:
    if not isinstance(channel, Texture):
        return quantized_bytes(srgb_from_linear(np.array(channel, np.float64).reshape(1, 1, 3))), 1
    pixels = _pixels(package, channel)
    is_stored_encoded = (
        pixels.dtype == np.uint8
        and pixels.shape[2] == 3
        and (channel.encoding, channel.channel, channel.scale, channel.offset) == ("srgb", "rgb", 1, 0)
    )
    if not is_stored_encoded:
        pixels = quantized_bytes(srgb_from_linear(texture_values(channel, pixels, is_scalar=False)))
    return shrunk(pixels, max_side, is_color=True), max(pixels.shape[:2])


def _rough_bytes(package: Package, channel: object) -> tuple[NDArray[np.uint8], int]:
    if not isinstance(channel, Texture):
        return quantized_bytes(np.full((1, 1), channel, np.float64)), 1
    values = quantized_bytes(texture_values(channel, _pixels(package, channel), is_scalar=True))
    return values, max(values.shape)


def read_state(folder: Path) -> AtlasState:
    """Read the state of an atlas from the folder ``atlas`` of ``materials infer``, if present.

    Raises :class:`InputError` if an image is not 8-bit.
    """
    mask, confidence = (_bytes_of(folder / name) for name in ("mask.png", "confidence.png"))
    return AtlasState(
        None if mask is None else mask[..., 0], None if confidence is None else confidence.min(axis=2)
    )


def _bytes_of(path: Path) -> NDArray[np.uint8] | None:
    if not path.is_file():
        return None
    pixels = read_image(path)
    if pixels.dtype != np.uint8:
        raise input_error(
            path, "", str(pixels.dtype), "8 bits per channel", "write it with `materials infer`"
        )
    return pixels
