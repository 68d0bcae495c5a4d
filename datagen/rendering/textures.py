# SPDX-License-Identifier: MIT
"""Material channels as Mitsuba textures, which are uploaded once and shared between scenes.

BSDF and ground truth read the same textures, so all operations on values are applied before upload: decoding,
scale and offset (``formats.textures``), then the configuration's :class:`ColorAdjustment`, then rounding to
half floats. Constants are adjusted by the same functions, as images of one texel.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import Texture
from datagen.formats.configuration import ColorAdjustment
from datagen.formats.textures import texture_values
from datagen.foundation.color import linear_from_srgb
from datagen.foundation.errors import InputError, Problem, input_error
from datagen.foundation.images import read_image

if TYPE_CHECKING:
    from datagen.formats.package import Package

Role = Literal["diffuse_albedo", "specular_albedo", "roughness", "opacity", "normal"]
SCALAR_ROLES = ("roughness", "opacity")
NO_ADJUSTMENT = ColorAdjustment()
MAX_CACHE_BYTES = 256 << 20
_MIN_SATURATION = 1e-3  # below, S is grey up to rounding


def adjusted(values: NDArray[np.float32], role: Role, adjustment: ColorAdjustment) -> NDArray[np.float32]:
    """Adjust channel values, (H, W, 3) for colours and (H, W) for scalars; results are clamped to [0, 1].

    In linear HSV, hue, saturation and value of D and, for coloured texels, hue and saturation of S are
    adjusted; the offset is added to R. Opacity and normals are returned unchanged.
    """
    if role == "roughness":
        return np.clip(values + np.float32(adjustment.roughness_offset), 0.0, 1.0)
    has_color_change = (
        adjustment.hue_shift != 0 or adjustment.saturation_scale != 1 or adjustment.value_scale != 1
    )
    if role not in ("diffuse_albedo", "specular_albedo") or not has_color_change:
        return values
    import cv2

    hsv = cv2.cvtColor(np.ascontiguousarray(values, dtype=np.float32), cv2.COLOR_RGB2HSV)
    hue, saturation, value = hsv[..., 0], hsv[..., 1], hsv[..., 2]
    is_colored = saturation > _MIN_SATURATION if role == "specular_albedo" else np.ones_like(hue, bool)
    hsv[..., 0] = np.where(is_colored, (hue + 360.0 * adjustment.hue_shift) % 360.0, hue)
    scaled = np.clip(saturation * adjustment.saturation_scale, 0.0, 1.0)
    hsv[..., 1] = np.where(is_colored, scaled, saturation)
    if role == "diffuse_albedo":
        hsv[..., 2] = np.clip(value * adjustment.value_scale, 0.0, 1.0)
    return np.clip(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), 0.0, 1.0)


def adjusted_constant(
    value: float | tuple[float, float, float], role: Role, adjustment: ColorAdjustment
) -> NDArray[np.float32]:
    """Like :func:`adjusted`, for a constant; the result is (3,) for colours, () for scalars."""
    array = np.asarray(value, dtype=np.float32)
    return adjusted(array[None, None], role, adjustment)[0, 0]


class TextureCache:
    """Cache of uploaded textures by content; drops the least recently used above 256 MB in total.

    Adjusted textures, which hardly ever recur in another configuration, are kept until
    :meth:`forget_variations`. Before upload, linear values are averaged over squares with a side of
    ``shrink`` texels.
    """

    def __init__(self, shrink: int = 1):
        self.shrink = shrink
        self.num_bytes = 0
        self._textures: OrderedDict[tuple, tuple[Any, int]] = OrderedDict()
        self._variations: dict[tuple, Any] = {}

    def forget_variations(self) -> None:
        """Drop the adjusted textures; existing scenes keep theirs."""
        self._variations.clear()

    def channel(
        self,
        package: Package,
        value: Texture | float | tuple[float, float, float],
        role: Role,
        adjustment: ColorAdjustment = NO_ADJUSTMENT,
        *,
        flip_green: bool = False,
    ) -> Any:
        """Return the Mitsuba texture of a material channel, or its dictionary for a constant.

        ``flip_green`` is for normal maps on mirrored UVs. Raises :class:`InputError` for unreadable images
        and for images with NaN or Inf.
        """
        if not isinstance(value, Texture):
            constant = adjusted_constant(value, role, adjustment)
            if role in SCALAR_ROLES:
                return {"type": "uniform", "value": float(constant)}
            return {"type": "rgb", "value": [float(c) for c in constant]}
        if role in ("opacity", "normal"):
            adjustment = NO_ADJUSTMENT
        key = (package.sha256, value, role, adjustment, flip_green)
        if key in self._variations:
            return self._variations[key]
        if key in self._textures:
            self._textures.move_to_end(key)
            return self._textures[key][0]
        values = box_filtered(decoded_texture(package, value, role, adjustment), self.shrink)
        if flip_green:
            values = values.copy()
            values[..., 1] = 1.0 - values[..., 1]
        texture = upload(values)
        if adjustment != NO_ADJUSTMENT:
            self._variations[key] = texture
            return texture
        self._textures[key] = (texture, values.size * 2)
        self.num_bytes += values.size * 2
        while self.num_bytes > MAX_CACHE_BYTES and len(self._textures) > 1:
            _, (_, num_bytes) = self._textures.popitem(last=False)
            self.num_bytes -= num_bytes
        return texture


def decoded_texture(package: Package, texture: Texture, role: Role, adjustment: ColorAdjustment) -> NDArray:
    """Adjusted linear values (H, W) or (H, W, 3) of a texture. Raises :class:`InputError` for NaN and Inf."""
    path = package.local_file(texture.texture)
    pixels = read_image(path)
    num_bad = int(np.count_nonzero(~np.isfinite(pixels))) if pixels.dtype.kind == "f" else 0
    if num_bad:
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(pixels))[0])
        got = f"{num_bad} of {pixels.size} values NaN or Inf (first at {first})"
        raise InputError(Problem(path, role, got, "finite values", "repair the texture"))
    if role == "normal" and texture.channel != "rgb":
        raise input_error(path, "normal.channel", texture.channel, "rgb", "correct the material")
    if texture.encoding == "srgb" and texture.channel != "a" and pixels.dtype.kind == "u":
        # decode a table of code values, since decoding all texels takes half the time of building a scene
        codes = np.arange(np.iinfo(pixels.dtype).max + 1).astype(np.float32)
        pixels = linear_from_srgb(codes / codes[-1]).astype(np.float32)[pixels]
        texture = texture.model_copy(update={"encoding": "linear"})
    return adjusted(texture_values(texture, pixels, role in SCALAR_ROLES), role, adjustment)


def box_filtered(values: NDArray[np.float32], shrink: int) -> NDArray[np.float32]:
    """Average ``values`` (H, W) or (H, W, 3) over squares with a side of ``shrink`` texels.

    A side that is not a multiple of ``shrink`` is divided into the nearest number of equal parts, at least 1.
    """
    if shrink <= 1:
        return values
    import cv2

    height, width = (max(1, round(side / shrink)) for side in values.shape[:2])
    filtered = np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    return filtered.reshape(height, width, *values.shape[2:])


def upload(values: NDArray[np.float32]) -> Any:
    """Upload linear values (H, W) or (H, W, 3) as half floats to a repeated, bilinear ``bitmap`` texture."""
    import mitsuba as mi

    pixels = np.ascontiguousarray(values if values.ndim == 3 else values[..., None], dtype=np.float16)
    return mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "format": "auto"})
