# SPDX-License-Identifier: MIT
"""Decoders of meshopt buffer views and Basis Universal images in glTF files (optional dependency ``gltf``).

Sizes are checked against the budget of the import before decoding.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from datagen.foundation.budget import Budget
from datagen.foundation.errors import input_error
from datagen.foundation.images import encode_png

MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
BASIS = "KHR_texture_basisu"
_KTX2 = b"\xabKTX 20\xbb\r\n\x1a\n"
_MAX_STRIDE = 256
_AGAIN = "export the file again"
_INSTALL = "pip install 'scene-materials[gltf]'"
_REMEDIES = {
    "meshopt": f"{_INSTALL}, or convert it: gltfpack -noq -i IN.glb -o OUT.glb",
    "opengl_basisu": f"{_INSTALL}, or convert each image: ktx extract IN.ktx2 OUT.png (KTX-Software)",
}


def _require(module: str, where: Path, field: str, got: str, expected: str) -> None:
    if importlib.util.find_spec(module) is None:
        raise input_error(where, field, got, expected, _REMEDIES[module])


def meshopt_of(view: dict[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """Return the name and content of a buffer view's meshopt extension, or None if it has none."""
    extensions = view.get("extensions", {})
    return next(((name, extensions[name]) for name in MESHOPT if name in extensions), None)


def unpack_meshopt(
    data: bytes, name: str, extension: dict[str, Any], budget: Budget, where: Path, field: str
) -> bytes:
    """Decompress the ``data`` of a buffer view.

    ``name`` and ``extension`` are from :func:`meshopt_of`. Raises :class:`InputError` for damaged data or
    if the package ``meshopt`` is not installed.
    """
    _require("meshopt", where, field, name, "uncompressed data")
    import meshopt

    count, stride = int(extension["count"]), int(extension["byteStride"])
    if count < 0 or not 0 < stride <= _MAX_STRIDE:
        got = f"count {count}, byteStride {stride}"
        raise input_error(where, field, got, f"a stride of 1 to {_MAX_STRIDE} bytes", _AGAIN)
    budget.spend("bytes", count * stride, field)
    try:
        mode, transform = extension["mode"], extension.get("filter", "NONE")
        decoded: bytes = meshopt.decode_gltf_buffer(data, count, stride, mode, transform).tobytes()
        return decoded
    except (ValueError, RuntimeError) as error:
        raise input_error(where, field, error, f"intact data of {name}", _AGAIN) from None


def is_ktx2(content: bytes) -> bool:
    """Return whether ``content`` has the signature of a KTX 2 file."""
    return content[: len(_KTX2)] == _KTX2


def png_of_basis(content: bytes, budget: Budget, where: Path, field: str) -> bytes:
    """Return the largest image of a KTX 2 file as PNG, with alpha if it has any.

    Raises :class:`InputError` for a damaged or oversized image or a missing package ``opengl_basisu``.
    """
    _require("opengl_basisu", where, field, "a Basis Universal texture", "PNG or JPEG")
    import opengl_basisu

    try:
        texture = opengl_basisu.open(content)
        budget.spend("pixels", texture.width * texture.height, field)
        pixels = texture.transcode("rgba8").data
    except opengl_basisu.BasisuError as error:
        raise input_error(where, field, error, "an intact KTX 2 file of Basis Universal", _AGAIN) from None
    return encode_png(pixels if texture.has_alpha else pixels[..., :3])
