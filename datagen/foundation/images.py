# SPDX-License-Identifier: MIT
"""Reading of image files as arrays: PNG and JPEG as stored, EXR as float; encoding as PNG and JPEG.

Arrays are (H, W, C), row 0 at the top, channels in the order R G B A.
"""

from __future__ import annotations

import base64
import io
import struct
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import srgb_from_linear
from datagen.foundation.errors import input_error

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")
MAX_IMAGE_SIDE_PX = 16384
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_REPLACE = "replace the file"


def read_image(path: Path) -> NDArray[Any]:
    """Read pixels (H, W, C) of a PNG or JPEG (uint8 or uint16, as stored) or an EXR (float32).

    Raises :class:`InputError` for a missing, corrupt or oversized file and for other formats.
    """
    suffix = path.suffix.lower()
    if suffix not in IMAGE_SUFFIXES:
        raise input_error(path, got=f"{suffix or 'no suffix'}", expected="a PNG, JPEG or EXR image")
    if not path.is_file():
        raise input_error(path, "", "no such file", "an image", "restore it, or correct its name")
    return _read_exr(path) if suffix == ".exr" else read_ldr(path)


def read_radiance(path: Path) -> NDArray[np.float32]:
    """Read an EXR image of radiance (H, W, 3); a grey image is repeated in all three channels.

    Raises :class:`InputError` in the cases of :func:`read_image`, for formats other than EXR, and for NaN,
    Inf and negative values.
    """
    if path.suffix.lower() != ".exr":
        raise input_error(path, got="not an EXR file", expected="a linear EXR image", remedy="convert it")
    pixels = read_image(path)
    if not np.isfinite(pixels).all() or (pixels < 0).any():
        got = "NaN, Inf or negative values"
        raise input_error(path, "", got, "finite radiance, at least 0", "repair it")
    return pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2)


def image_size(path: Path, formats: tuple[str, ...] = ("PNG", "JPEG", "TIFF")) -> tuple[int, int]:
    """Read (width, height) from the header of an EXR file or of an image in one of Pillow's ``formats``.

    Raises :class:`InputError` for a missing or unreadable file.
    """
    if not path.is_file():  # a pipe would block for ever
        raise input_error(path, got="no such file", expected="an image", remedy="correct its name")
    if path.suffix.lower() == ".exr":
        from datagen.foundation.exr import claimed_size

        return claimed_size(path.read_bytes(), path)
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # sizes are checked here
            with Image.open(path, formats=formats) as image:
                return image.size
    except Exception as error:  # Pillow may raise any exception of its parsers
        expected = f"a readable image ({', '.join(formats)})"
        raise input_error(path, got=str(error)[:200], expected=expected, remedy=_REPLACE) from None


def check_size(path: Path, size_px: tuple[int, int], pixel_bytes: int) -> None:
    """Raise :class:`InputError` if an image is too large, or larger than its file can contain.

    ``pixel_bytes``: decoded bytes per pixel.
    """
    from datagen.foundation.exr import check_claim

    width, height = size_px
    if max(width, height) > MAX_IMAGE_SIDE_PX:
        expected = f"at most {MAX_IMAGE_SIDE_PX} pixels per side"
        raise input_error(path, "size", f"{width}x{height}", expected, "scale the image down")
    check_claim((width, height), pixel_bytes, path.stat().st_size, path)


def normalized(pixels: NDArray[Any]) -> NDArray[np.float32]:
    """Return pixels as float32; unsigned integers are scaled to [0, 1]."""
    if pixels.dtype.kind == "u":
        return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    return pixels.astype(np.float32)


def quantized_bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Quantise values, clipped to [0, 1], to 8 bits."""
    return (np.clip(values, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def shown_bytes(linear_rgb: NDArray[Any], exposure: float) -> NDArray[np.uint8]:
    """Encode linear colours times ``exposure`` as 8-bit sRGB; values that are not finite become black."""
    finite = np.where(np.isfinite(linear_rgb), linear_rgb, 0).astype(np.float32)
    return quantized_bytes(srgb_from_linear(finite * exposure))


def encode_png(pixels: NDArray[Any]) -> bytes:
    """Encode uint8 or uint16 pixels, (H, W) or (H, W, C) with C of 1, 3 or 4, as PNG, deterministically."""
    import cv2

    orders = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}
    array = pixels if pixels.ndim == 2 else pixels[..., orders[pixels.shape[2]]]
    done, data = cv2.imencode(".png", np.ascontiguousarray(array), [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not done:
        raise ValueError(f"cannot encode an image of shape {pixels.shape} and type {pixels.dtype} as PNG")
    return data.tobytes()


def encode_jpeg(pixels: NDArray[np.uint8], quality: int) -> bytes:
    """Encode 8-bit sRGB pixels (H, W, 3) as JPEG of ``quality`` 1 to 95."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", quality=quality)
    return stream.getvalue()


def data_url(image: bytes, kind: str = "png") -> str:
    """Return a data URL of the image file ``image``, whose type ``kind`` is ``png`` or ``jpeg``."""
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"


def read_ldr(path: Path, formats: tuple[str, ...] = ("PNG", "JPEG")) -> NDArray[Any]:
    """Read pixels (H, W, C), as stored, of an image in one of Pillow's ``formats``, recognised by content.

    Sizes and chunk lengths are checked first, since OpenCV does not validate headers. Raises
    :class:`InputError` for a missing, corrupt or oversized file.
    """
    import cv2

    check_size(path, image_size(path, formats), 8)  # at most four channels of 16 bits
    data = path.read_bytes()
    pixels = None
    if data[:8] != _PNG_SIGNATURE or _has_whole_chunks(data):
        with suppress(cv2.error):  # decoding failures are reported below
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise input_error(path, "", "corrupt data", f"a readable {' or '.join(formats)}", _REPLACE)
    if pixels.ndim == 2:
        return pixels[..., None]
    order = [2, 1, 0, 3][: pixels.shape[2]] if pixels.shape[2] >= 3 else list(range(pixels.shape[2]))
    return np.ascontiguousarray(pixels[..., order])


def _has_whole_chunks(png: bytes) -> bool:
    """Return whether every chunk of a PNG file, up to IEND, is complete."""
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(png):
        length, kind = struct.unpack_from(">I4s", png, position)
        position += 12 + length
        if kind == b"IEND":
            break
    return position <= len(png)


def _read_exr(path: Path) -> NDArray[np.float32]:
    from datagen.foundation.exr import decode_channels

    channels = decode_channels(path.read_bytes(), path)
    known = "RGBA" if channels.keys() & {"R", "G", "B"} else "YA" if "Y" in channels else ""
    names = [name for name in known if name in channels] or list(channels)
    if not known and len(names) != 1:
        remedy = "save the image without layers"
        raise input_error(path, "channels", ", ".join(sorted(names)) or "none", "R, G and B, or Y", remedy)
    return np.stack([channels[name].astype(np.float32) for name in names], axis=-1)
