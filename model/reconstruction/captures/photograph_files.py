# SPDX-License-Identifier: MIT
"""Reads photograph files by format, and reports unsupported formats.

PNG, JPEG, TIFF and WEBP are decoded by OpenCV after a check of their size, EXR by OpenEXR, HEIC by libheif
(``pillow-heif``, the extra ``heic``), and raw photographs by libraw (``raw_photographs``). libheif and libraw
rotate photographs upright, so their EXIF orientation is not applied again.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.errors import InputError, Problem, input_error
from datagen.foundation.images import check_size, image_size, read_image, read_ldr
from model.reconstruction.captures.raw_photographs import raw_size, read_raw

HEIC_SUFFIXES = (".heic", ".heif", ".hif")
RAW_SUFFIXES = (
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".nef", ".nrw", ".orf", ".pef", ".raf",
    ".raw", ".rw2", ".sr2", ".srw", ".x3f",
)  # fmt: skip
PHOTOGRAPH_SUFFIXES = (
    ".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff", ".webp", *HEIC_SUFFIXES, *RAW_SUFFIXES,
)  # fmt: skip
KNOWN_SUFFIXES = (
    *PHOTOGRAPH_SUFFIXES, ".avif", ".bmp", ".gif", ".jp2", ".jpe", ".jfif", ".jxl", ".ppm",
    ".psd", ".tga",
)  # fmt: skip
"""Suffixes of files that are recognised as photographs, including unsupported formats."""
_READ = "PNG, JPEG, TIFF, WEBP, HEIC or EXR"
_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP")
_OPENCV_FORMATS = {".tif": ("TIFF",), ".tiff": ("TIFF",), ".webp": ("WEBP",)}


def can_read(path: Path) -> bool:
    """Return whether the suffix of ``path`` can be read; HEIC and raw photographs need optional packages."""
    suffix = path.suffix.lower()
    if suffix in HEIC_SUFFIXES:
        return find_spec("pillow_heif") is not None
    return suffix in PHOTOGRAPH_SUFFIXES and (suffix not in RAW_SUFFIXES or find_spec("rawpy") is not None)


def is_raw(path: Path) -> bool:
    """Return whether a file has the suffix of a raw photograph."""
    return path.suffix.lower() in RAW_SUFFIXES


def unread_problems(where: str | Path, files: Sequence[Path]) -> list[Problem]:
    """Return the problems of photographs in unsupported formats, one per suffix."""
    problems = []
    for suffix in sorted({file.suffix.lower() for file in files}):
        names = [file.name for file in files if file.suffix.lower() == suffix]
        field = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
        kind = suffix.removeprefix(".").upper() or "no suffix"
        if suffix in HEIC_SUFFIXES:
            expected = "the package pillow-heif, which reads HEIC"
            remedy = "pip install 'scene-materials[heic]', or convert them to PNG or JPEG"
        elif suffix in RAW_SUFFIXES:
            kind, expected = f"{kind}, a raw photograph", "the package rawpy, which reads it"
            remedy = "pip install 'scene-materials[raw]', or develop all to TIFF or PNG without a tone curve"
        else:
            expected, remedy = _READ, "convert them to PNG"
        problems.append(Problem(where, field, kind, expected, remedy))
    return problems


def read_photograph(path: Path) -> tuple[NDArray, NDArray[np.bool_] | None]:
    """Read the pixels (H, W, C) of a photograph in the stored orientation; HEIC and raw files are upright.

    Also return the mask (H, W) of clipped pixels of a raw photograph, whose values are linear regardless of
    the encoding option, else None. Raises :class:`InputError`.
    """
    _check(path)
    suffix = path.suffix.lower()
    if suffix in RAW_SUFFIXES:
        return read_raw(path)
    if suffix in HEIC_SUFFIXES:
        return _read_heic(path), None
    stored = read_ldr(path, _OPENCV_FORMATS[suffix]) if suffix in _OPENCV_FORMATS else read_image(path)
    return stored, None


def photograph_size(path: Path) -> tuple[int, int]:
    """Read (width, height) in pixels in the stored orientation; HEIC and raw files are upright.

    Raises :class:`InputError`.
    """
    _check(path)
    if is_raw(path):
        return raw_size(path)
    return image_size(path, pillow_formats(path))


def pillow_formats(path: Path) -> tuple[str, ...]:
    """Return Pillow's format names for the suffix of ``path``; registers the HEIC reader if needed."""
    if path.suffix.lower() not in HEIC_SUFFIXES or not can_read(path):
        return _FORMATS
    from pillow_heif import register_heif_opener

    register_heif_opener()
    return ("HEIF",)


def _check(path: Path) -> None:
    if not can_read(path) and path.exists():
        raise InputError(*unread_problems(path.parent, [path]))


def _read_heic(path: Path) -> NDArray[np.uint8]:
    """Read upright pixels (H, W, 3). Raises :class:`InputError`."""
    from PIL import Image

    check_size(path, photograph_size(path), 4)
    try:
        with Image.open(path, formats=pillow_formats(path)) as image:
            return np.asarray(image.convert("RGB"))
    except Exception as error:  # libheif may raise any exception
        got = f"corrupt data ({str(error)[:200]})"
        raise input_error(path, "", got, "a readable HEIC file", "replace the file") from None
