# SPDX-License-Identifier: MIT
"""Material channels of an import: constants and unprocessed images are kept, computed values are baked.

A *value* is a constant (float or colour), an :class:`ImageSource` (an unchanged image) or a
:class:`BakedSource` (computed pixels). :class:`ImageCache` memoises decoded images and computes with values.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import Texture
from datagen.formats.package import FileSource
from datagen.formats.textures import texture_values
from datagen.foundation.budget import Budget
from datagen.foundation.color import srgb_from_linear
from datagen.foundation.errors import InputError, input_error
from datagen.foundation.exr import encode_view
from datagen.foundation.images import IMAGE_SUFFIXES, encode_png, image_size, read_image
from datagen.foundation.naming import slug

MAX_CHANNEL_SPREAD = 0.5 / 255  # a baked channel that varies by less than half an 8-bit step is a constant
_HDR_SIZE = re.compile(rb"\n[-+][XY] (\d{1,9}) [-+][XY] (\d{1,9})\n")
ChannelName = Literal["rgb", "r", "g", "b", "a"]


@dataclass(frozen=True)
class ImageSource:
    """A channel of an image file, with fields as in :class:`datagen.formats.asset.Texture`."""

    file: Path
    encoding: Literal["srgb", "linear"]
    channel: ChannelName = "rgb"
    scale: float = 1.0
    offset: float = 0.0

    def texture(self, name: str) -> Texture:
        return Texture(
            texture=name, encoding=self.encoding, channel=self.channel, scale=self.scale, offset=self.offset
        )


@dataclass(frozen=True)
class BakedSource:
    """Linear values (H, W, 3) or (H, W); ``label`` and ``encoding``: base name and encoding of their file."""

    values: NDArray[np.float32]
    label: str
    encoding: Literal["srgb", "linear"]


Color = tuple[float, float, float]
ColorValue = Color | ImageSource | BakedSource
ScalarValue = float | ImageSource | BakedSource
Value = ColorValue | ScalarValue


def is_constant(value: Value) -> bool:
    return not isinstance(value, ImageSource | BakedSource)


class ImageCache:
    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._pixels: dict[Path, NDArray] = {}

    def pixels(self, file: Path) -> NDArray:
        """Return the pixels (H, W, C) of an image, memoised. Raises :class:`InputError` if unreadable."""
        if file not in self._pixels:
            if file.is_file():
                self._budget.hold_file(file)
                self._budget.spend("pixels", num_pixels(file), file.name)
            self._pixels[file] = read_any_image(file)
        return self._pixels[file]

    def values(self, value: Value, is_scalar: bool) -> NDArray[np.float32]:
        """Return a value as a linear array: () or (H, W) if ``is_scalar``, else (3,) or (H, W, 3)."""
        if isinstance(value, BakedSource):
            return value.values
        if isinstance(value, ImageSource):
            return texture_values(value.texture(value.file.name), self.pixels(value.file), is_scalar)
        return np.asarray(value, dtype=np.float32)

    def color(
        self,
        label: str,
        function: Callable[..., NDArray],
        *colors: ColorValue,
        scalars: tuple[ScalarValue, ...] = (),
    ) -> ColorValue:
        """Compute a colour as ``function(*colors, *scalars)``, called with arrays (..., 3) and (..., 1).

        The result is clipped to [0, 1], has the resolution of the largest image and is baked under the name
        ``label``. If it varies by less than half an 8-bit step, a constant is returned.
        """
        inputs = [*((value, False) for value in colors), *((value, True) for value in scalars)]
        return cast(ColorValue, self._combined(label, function, inputs, is_scalar=False))

    def scalar(self, label: str, function: Callable[..., NDArray], *scalars: ScalarValue) -> ScalarValue:
        """Compute a scalar as ``function(*scalars)``, called with arrays (H, W) or (); see :meth:`color`."""
        inputs = [(value, True) for value in scalars]
        return cast(ScalarValue, self._combined(label, function, inputs, is_scalar=True))

    def _combined(
        self,
        label: str,
        function: Callable[..., NDArray],
        inputs: Sequence[tuple[Value, bool]],
        is_scalar: bool,
    ) -> Value:
        """Compute :meth:`color` or :meth:`scalar`; ``inputs`` are pairs (value, whether it is a scalar)."""
        arrays = [self.values(value, scalar) for value, scalar in inputs]
        images = [a for (v, _), a in zip(inputs, arrays, strict=True) if not is_constant(v)]
        sizes = [(a.shape[0], a.shape[1]) for a in images]
        size = max(sizes, key=lambda s: s[0] * s[1], default=None)
        shaped = []
        for (value, scalar), array in zip(inputs, arrays, strict=True):
            if size is not None and not is_constant(value) and array.shape[:2] != size:
                import cv2

                array = cv2.resize(array, size[::-1], interpolation=cv2.INTER_LINEAR).astype(np.float32)
            shaped.append(array[..., None] if scalar and not is_scalar else array)
        result = np.clip(np.asarray(function(*shaped), dtype=np.float32), 0.0, 1.0)
        if size is None:
            return float(result) if is_scalar else _color(np.broadcast_to(result, (3,)))
        result = np.broadcast_to(result, size if is_scalar else (*size, 3))
        flat = result.reshape(-1, 1 if is_scalar else 3)
        if (np.ptp(flat, axis=0) < MAX_CHANNEL_SPREAD).all():
            mean = flat.mean(axis=0, dtype=np.float64)
            return float(mean[0]) if is_scalar else _color(mean)
        return BakedSource(result, label, "linear" if is_scalar else "srgb")


def num_pixels(file: Path) -> int:
    """Return the number of pixels stated in an image's header; 0 if unreadable (decoding then fails)."""
    if file.suffix.lower() in (".hdr", ".pic"):
        with file.open("rb") as stream:
            match = _HDR_SIZE.search(stream.read(4096))
        return int(match[1]) * int(match[2]) if match else 0
    try:
        width, height = image_size(file, ("PNG", "JPEG", "TIFF", "BMP", "TGA", "WEBP"))
    except InputError:
        return 0
    return width * height


def read_any_image(file: Path) -> NDArray:
    """Read an image (also of type BMP, TGA or HDR) as (H, W, C). Raises :class:`InputError` on failure."""
    if file.suffix.lower() in IMAGE_SUFFIXES:
        return read_image(file)
    import cv2

    pixels = cv2.imdecode(np.fromfile(file, np.uint8), cv2.IMREAD_UNCHANGED) if file.is_file() else None
    if pixels is None:
        raise input_error(file, got="unreadable", expected="an image", remedy="convert it to PNG or EXR")
    if pixels.ndim == 2:
        return pixels[..., None]
    return np.ascontiguousarray(pixels[..., [2, 1, 0, 3][: pixels.shape[2]]])


def _color(array: NDArray) -> Color:
    red, green, blue = (float(f"{x:.6g}") for x in array)
    return red, green, blue


class TextureFiles:
    """Texture files of a new package, by name; each image is added only once."""

    def __init__(self, cache: ImageCache) -> None:
        self.files: dict[str, FileSource] = {}
        self._cache = cache
        self._names: dict[Path, str] = {}
        self._baked: dict[str, str] = {}

    def _free_name(self, stem: str, suffix: str) -> str:
        base, number = slug(stem), 1
        name = f"textures/{base}{suffix}"
        while name in self.files:
            number += 1
            name = f"textures/{base}_{number}{suffix}"
        return name

    def add_file(self, file: Path) -> str:
        """Add an image file, converted to PNG or EXR if necessary, and return its name in the package."""
        key = file.resolve()
        if key not in self._names:
            suffix = file.suffix.lower()
            if suffix in IMAGE_SUFFIXES:
                name = self._free_name(file.stem, suffix)
                self.files[name] = file
            else:
                pixels = self._cache.pixels(file)
                is_float = pixels.dtype.kind == "f"
                name = self._free_name(file.stem, ".exr" if is_float else ".png")
                self.files[name] = encode_exr(pixels) if is_float else encode_png(pixels)
            self._names[key] = name
        return self._names[key]

    def add_baked(self, source: BakedSource) -> Texture:
        """Add baked values as an 8-bit PNG in their encoding, and return the texture."""
        values = source.values
        encoded: NDArray = (
            srgb_from_linear(values.astype(np.float64)) if source.encoding == "srgb" else values
        )
        data = encode_png(np.round(np.clip(encoded, 0, 1) * 255).astype(np.uint8))
        digest = hashlib.sha256(data).hexdigest()
        if digest not in self._baked:
            name = self._free_name(source.label, ".png")
            self.files[name] = data
            self._baked[digest] = name
        channel: ChannelName = "rgb" if values.ndim == 3 else "r"
        return Texture(texture=self._baked[digest], encoding=source.encoding, channel=channel)

    def color(self, value: ColorValue) -> Color | Texture:
        """Convert a colour to a material channel, and add its image, if any."""
        return self._channel(value) if not isinstance(value, tuple) else _color(np.clip(value, 0, 1))

    def scalar(self, value: ScalarValue) -> float | Texture:
        """Convert a scalar to a material channel, and add its image, if any; RGB becomes luminance."""
        if isinstance(value, ImageSource) and value.channel == "rgb":
            grey = self._cache.pixels(value.file).shape[2] < 3
            if grey:
                value = ImageSource(value.file, value.encoding, "r", value.scale, value.offset)
            else:
                values = self._cache.values(value, is_scalar=True)
                value = BakedSource(values, f"{value.file.stem}_grey", "linear")
        if isinstance(value, ImageSource | BakedSource):
            return self._channel(value)
        return float(f"{min(max(float(value), 0.0), 1.0):.6g}")

    def _channel(self, value: ImageSource | BakedSource) -> Texture:
        if isinstance(value, BakedSource):
            return self.add_baked(value)
        return value.texture(self.add_file(value.file))


def encode_exr(pixels: NDArray) -> bytes:
    """Encode linear pixels (H, W, 3 or more) as an EXR file of half-float RGB."""
    return encode_view({"beauty": pixels[..., :3]})
