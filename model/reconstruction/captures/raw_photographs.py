# SPDX-License-Identifier: MIT
"""Reads raw photographs by libraw (``rawpy``, the extra ``raw``) as linear Rec.709, white-balanced as
recorded.

Black and white levels are the file's; values are not brightened, and no curve is applied. Channels are scaled
so that the one with the highest response to white light reaches 1 at the sensor's limit. Pixels interpolated
from a sensor value at the limit count as clipped in all channels, since the colour matrix mixes channels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.errors import input_error
from datagen.foundation.images import check_size

LIMIT_SHARE = 0.99
"""Clipping level, from black level (0) to white level (1); sensors saturate slightly below 1."""
_REACH_PX = 5
"""Width of the square of sensor values from which a pixel is interpolated."""
_TURNS = {3: 2, 5: 1, 6: -1}  # counter-clockwise quarter turns for each flip code of libraw


def read_raw(path: Path) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Read linear pixels (H, W, 3) and the mask (H, W) of clipped pixels, upright.

    Raises :class:`InputError`.
    """
    import cv2
    import rawpy

    check_size(path, raw_size(path), 8)
    try:
        with rawpy.imread(str(path)) as raw:
            if raw.raw_type != rawpy.RawType.Flat:
                got, expected = "no mosaic of sensor values", "a raw photograph with one value per pixel"
                raise input_error(path, "", got, expected, "develop it to 16-bit TIFF without a tone curve")
            stored = np.asarray(raw.raw_image_visible, np.float32)
            pattern = np.asarray(raw.raw_colors_visible)
            black = np.asarray(raw.black_level_per_channel, np.float32)
            level = np.float32(raw.white_level)
            at_limit = stored >= black[pattern] + LIMIT_SHARE * (level - black[pattern])
            turns = _TURNS.get(raw.sizes.flip, 0)
            pixels = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                use_camera_wb=True,
                adjust_maximum_thr=0.0,
                output_bps=16,
                output_color=rawpy.ColorSpace.sRGB,
                user_flip=0,
            )
    except rawpy.LibRawError as error:
        raise _unreadable(path, error) from None
    clipped = cv2.dilate(at_limit.astype(np.uint8), np.ones((_REACH_PX, _REACH_PX), np.uint8)) > 0
    if clipped.shape != pixels.shape[:2]:
        got = f"{pixels.shape[1]}x{pixels.shape[0]} of {clipped.shape[1]}x{clipped.shape[0]} sensor values"
        raise input_error(
            path, "size", got, "one pixel per sensor value", "develop it to 16-bit TIFF without a tone curve"
        )
    return np.ascontiguousarray(np.rot90(pixels, turns)), np.ascontiguousarray(np.rot90(clipped, turns))


def raw_size(path: Path) -> tuple[int, int]:
    """Read (width, height) in pixels of the upright photograph. Raises :class:`InputError`."""
    import rawpy

    if not path.is_file():
        raise input_error(path, "", "no such file", "an image", "correct its name")
    try:
        with rawpy.imread(str(path)) as raw:
            width, height = raw.sizes.width, raw.sizes.height
            return (height, width) if _TURNS.get(raw.sizes.flip, 0) % 2 else (width, height)
    except rawpy.LibRawError as error:
        raise _unreadable(path, error) from None


def raw_exposure(path: Path) -> float | None:
    """Read the relative exposure, time in s * ISO / f-number^2; None if a value is missing."""
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            other = raw.other
            relative = other.shutter_speed * other.iso_speed / other.aperture**2
    except (rawpy.LibRawError, ZeroDivisionError):  # an unreadable file is reported when its pixels are read
        return None
    return float(relative) if np.isfinite(relative) and relative > 0 else None


def _unreadable(path: Path, error: Exception) -> Exception:
    got = f"corrupt data or a camera unknown to libraw ({str(error)[:200]})"
    return input_error(
        path, "", got, "a readable raw photograph", "develop it to 16-bit TIFF without a tone curve"
    )
