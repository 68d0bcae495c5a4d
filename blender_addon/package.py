# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts baked materials and gathered meshes to entries of ``asset.json`` and the files they refer to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .bake.plan import PlainImage
from .bake.textures import BakedMaterial, BakedTexture
from .cycles import pixels_of
from .gather.mesh import MeshArrays, Submesh
from .gather.tags import slug
from .write import PackageWriter, exr_bytes, ply_bytes, png_bytes, quantize, srgb_encoded

_PASSED_THROUGH = {".png": ".png", ".jpg": ".jpg", ".jpeg": ".jpg", ".exr": ".exr"}
_COLOURS = ("diffuse_albedo", "specular_albedo")


def channel_entry(name: str, channel: Any, stem: str, writer: PackageWriter, bits: int) -> Any:
    """The JSON value of a channel; writes its texture, if any, named ``stem``_``name``, of 8 or 16 bits."""
    if isinstance(channel, BakedTexture):
        pixels = channel.pixels[::-1]
        is_colour = name in _COLOURS
        stored = quantize(srgb_encoded(pixels) if is_colour else pixels, bits)
        path = writer.add("textures", f"{stem}_{name}", ".png", png_bytes(stored))
        return {
            "texture": path,
            "encoding": "srgb" if is_colour else "linear",
            "channel": "rgb" if stored.shape[2] == 3 else "r",
        }
    if isinstance(channel, PlainImage):
        path = image_file(channel.image, writer)
        return {"texture": path, "encoding": channel.encoding, "channel": channel.channel}
    return list(channel) if len(channel) == 3 else channel[0]


def image_file(image: bpy.types.Image, writer: PackageWriter) -> str:
    """Write an image's file unchanged if packages support its format, else its pixels; returns the path."""
    stem = slug(Path(image.filepath or image.name).stem)
    suffix = _PASSED_THROUGH.get(Path(image.filepath_raw or image.name).suffix.lower())
    if suffix is not None and not image.is_dirty:
        content = image.packed_file.data if image.packed_file else None
        path = Path(bpy.path.abspath(image.filepath_from_user(), library=image.library))
        if content is None and path.is_file():
            content = path.read_bytes()
        if content:
            return writer.add("textures", stem, suffix, content)
    pixels = pixels_of(image)
    if image.is_float:
        rgb = pixels[..., :3] if image.channels >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
        return writer.add("textures", stem, ".exr", exr_bytes(rgb))
    if image.channels == 2:
        pixels = pixels[..., :1]
    return writer.add("textures", stem, ".png", png_bytes(quantize(pixels, 8)))


def material_entry(
    baked: BakedMaterial,
    stem: str,
    classes: tuple[str, ...],
    approximations: tuple[str, ...],
    writer: PackageWriter,
    bits: int,
) -> dict[str, Any]:
    """The JSON object of a material; writes its textures, named ``stem``_CHANNEL, of 8 or 16 bits."""
    entry: dict[str, Any] = {"classes": list(classes)}
    for name, channel in baked.channels.items():
        if name == "emission" and not any(channel):  # type: ignore[arg-type]
            continue
        if name == "opacity" and channel == (1.0,):
            continue
        entry[name] = channel_entry(name, channel, stem, writer, bits)
    if baked.normal is not None:
        stored = quantize(baked.normal.pixels[::-1], bits)
        path = writer.add("textures", f"{stem}_normal", ".png", png_bytes(stored))
        entry["normal"] = {"texture": path, "encoding": "linear", "channel": "rgb"}
    if approximations:
        entry["approximations"] = list(approximations)
    return entry


def mesh_file(part: Submesh, stem: str, writer: PackageWriter) -> str:
    """Write a submesh as PLY file named ``stem``; returns its path in the package."""
    content = ply_bytes(part.positions, part.normals, part.uv, part.faces)
    return writer.add("meshes", stem, ".ply", content)


def uv_density(part: Submesh, matrix: NDArray[np.float64]) -> float | None:
    """Median UV units per metre over triangles, or None without UVs or area; ``matrix``: metres_from_part."""
    if part.uv is None or len(part.faces) == 0:
        return None
    faces = part.faces if len(part.faces) <= 20_000 else part.faces[:: len(part.faces) // 20_000]
    points = part.positions.astype(np.float64) @ matrix[:3, :3].T
    a, b, c = (points[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    p, q, r = (part.uv[faces[:, i]].astype(np.float64) for i in range(3))
    u, v = q - p, r - p
    uv_area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    is_good = (area > 1e-14) & (uv_area > 1e-14)
    if not is_good.any():
        return None
    return float(np.sqrt(np.median(uv_area[is_good] / area[is_good])))


def box_uv(mesh: MeshArrays, metres: NDArray[np.float64]) -> NDArray[np.float32]:
    """UVs (C, 2) projected along the dominant axis of each polygon's normal, one unit per metre.

    ``metres`` (3,) scales the object's axes to metres. Corners that no triangle uses get 0.
    """
    points = mesh.positions * metres.astype(np.float32)
    corners = points[mesh.corner_vertices[mesh.triangles]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    num_polygons = int(mesh.triangle_polygons.max()) + 1 if len(mesh.triangle_polygons) else 0
    per_polygon = np.zeros((num_polygons, 3))
    np.add.at(per_polygon, mesh.triangle_polygons, normal)
    axis = np.abs(per_polygon).argmax(axis=1)[mesh.triangle_polygons]
    columns = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    uv = np.zeros((len(mesh.corner_vertices), 2), np.float32)
    for corner in range(3):
        uv[mesh.triangles[:, corner]] = np.take_along_axis(corners[:, corner], columns, axis=1)
    return uv
