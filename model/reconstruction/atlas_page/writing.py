# SPDX-License-Identifier: MIT
"""Writes the folder of the 3D page of an asset.

index.html *.css *.js     the page and the library three.js
data/scene.js             meshes, lights, cameras, and materials without their images
data/preview.js           all images with at most 1024 texels per side, for a quick first picture
data/<material>-<kind>.js images larger than the preview, with at most ``max_side`` texels per side
"""

from __future__ import annotations

import base64
import json
import math
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from datagen.formats.asset import EnvironmentAsset, ObjectAsset
from datagen.formats.base import write_bytes_atomically
from datagen.formats.package import Package, is_package, open_package
from datagen.foundation.color import cividis
from datagen.foundation.errors import input_error, raise_problems
from datagen.foundation.meshes.mesh import Mesh, joined, vertex_normals
from datagen.foundation.meshes.ply import read_ply
from datagen.foundation.paths import output_problems
from datagen.foundation.progress import Advance, no_advance
from model.reconstruction.atlas_page.sources import page_sources
from model.reconstruction.atlas_page.textures import AtlasState, material_images, read_state

MAX_SIDE = 4096
"""Default maximum side of images in texels, since larger ones exceed the limits of many GPUs."""
PREVIEW_SIDE = 1024
PAGE_FILES = ("index.html", "view.css", "three.js", "shadows.js", "shader.js", "controls.js", "view.js")


@dataclass(frozen=True)
class ViewResult:
    """A written page: its path, numbers of triangles, materials and bytes, and notes on omitted data."""

    page: Path
    num_triangles: int
    num_materials: int
    num_bytes: int
    notes: tuple[str, ...]


def write_view(
    source: Path,
    out: Path,
    max_side: int = MAX_SIDE,
    progress: Advance = no_advance,
) -> ViewResult:
    """Write the page of an asset package, or of an output folder of ``materials infer``, to ``out``, with
    images of at most ``max_side`` texels per side.

    The mask of observed texels and the confidence are read from the folder ``atlas`` next to the package, if
    present. Raises :class:`InputError` for other input, or if ``out`` contains other files.
    """
    is_page = out.is_dir() and {path.name for path in out.iterdir()} <= {*PAGE_FILES, "data"}
    raise_problems(output_problems(out, is_page, "an earlier page"))
    notes: list[str] = []
    previews: dict[str, str] = {}
    large: set[Path] = set()
    with open_package(source / "asset" if is_package(source / "asset") else source) as package:
        asset = package.asset
        if not isinstance(asset, EnvironmentAsset | ObjectAsset):
            expected = "an environment or an object"
            raise input_error(package.path, "kind", asset.kind, expected, "name another package")
        (out / "data").mkdir(parents=True, exist_ok=True)
        slots = _meshes_by_material(package, asset)
        shown = [asset.materials[slot] for slot in slots if asset.materials[slot].emission is None]
        has_atlas = sum(bool(material.textures()) for material in shown) == 1
        state = read_state(package.path.resolve().parent / "atlas") if has_atlas else AtlasState()
        materials = []
        for number, (slot, mesh) in enumerate(slots.items()):
            material = asset.materials[slot]
            described: dict[str, Any] = {"slot": slot, "emission": material.emission, "images": []}
            own = state if material.textures() and material.emission is None else AtlasState()
            described["hasMask"] = own.mask is not None
            described["hasConfidence"] = own.confidence is not None
            if material.emission is None:
                for image in material_images(package, material, own, max_side):
                    name = f"{number}-{image.kind}"
                    described["images"].append([name, image.kind, *image.pixels.shape[1::-1]])
                    previews[name] = _base64(image.png(PREVIEW_SIDE))
                    progress(len(previews), 3 * len(shown))
                    if max(image.pixels.shape) > PREVIEW_SIDE:
                        large.add(out / "data" / f"{name}.js")
                        _write_script(out / "data" / f"{name}.js", f'images["{name}"]', _base64(image.png()))
                    if image.original_side > max_side:
                        texels = f"{max_side} of {image.original_side} texels per side"
                        notes.append(f"{slot}: {image.kind} is shown at {texels}")
                if material.normal is not None or material.opacity is not None:
                    notes.append(f"{slot}: its normal map and opacity are not shown")
            materials.append({**described, **_encode_mesh(mesh)})
        sources, num_lights, unshown = page_sources(asset, slots)
        notes += unshown
        scene = {
            "sources": [source.described() for source in sources],
            "numLights": num_lights,
            "title": asset.title or asset.id,
            "materials": materials,
            "cameras": _cameras(asset),
            "bounds": _bounds(list(slots.values())),
            "colorMap": cividis(),
            "notes": notes,
        }
    for earlier in set((out / "data").glob("[0-9]*-*.js")) - large:
        earlier.unlink()
    _write_script(out / "data" / "preview.js", "preview", previews)
    _write_script(out / "data" / "scene.js", "scene", scene)
    page = files("model.reconstruction.atlas_page") / "page"
    for name in PAGE_FILES:
        write_bytes_atomically(out / name, (page / name).read_bytes())
    triangles = sum(len(mesh.faces) for mesh in slots.values())
    num_bytes = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return ViewResult(out / "index.html", triangles, len(materials), num_bytes, tuple(notes))


def _meshes_by_material(package: Package, asset: EnvironmentAsset | ObjectAsset) -> dict[str, Mesh]:
    """Join all parts of each material into one mesh in the asset's frame, with normals and UVs."""
    parts: dict[str, list[Mesh]] = {}
    for part in asset.parts:
        mesh = read_ply(package.local_file(part.mesh)).transformed(np.array(part.asset_from_part))
        normals = mesh.normals if mesh.normals is not None else vertex_normals(mesh)
        uv = mesh.uv if mesh.uv is not None else np.zeros((len(mesh.positions), 2), np.float32)
        parts.setdefault(part.material, []).append(Mesh(mesh.positions, mesh.faces, normals, uv))
    return {slot: joined(meshes) for slot, meshes in parts.items()}


def _encode_mesh(mesh: Mesh) -> dict[str, str]:
    assert mesh.normals is not None and mesh.uv is not None
    return {
        "positions": _base64(mesh.positions.astype("<f4").tobytes()),
        "normals": _base64(mesh.normals.astype("<f4").tobytes()),
        "uv": _base64(mesh.uv.astype("<f4").tobytes()),
        "faces": _base64(mesh.faces.astype("<u4").tobytes()),
    }


def _bounds(meshes: list[Mesh]) -> list[list[float]]:
    points = np.concatenate([mesh.positions for mesh in meshes])
    return [points.min(axis=0).tolist(), points.max(axis=0).tolist()]


def _cameras(asset: EnvironmentAsset | ObjectAsset) -> list[dict[str, Any]]:
    """Return name, vertical field of view (degrees), position and target (1 m ahead) of each camera."""
    found = []
    for camera in getattr(asset, "cameras", ()):
        matrix = np.array(camera.asset_from_camera)
        found.append(
            {
                "name": camera.name,
                "fov": math.degrees(2 * math.atan(0.5 * camera.height_px / camera.fy_px)),
                "position": matrix[:3, 3].tolist(),
                "target": (matrix[:3, 3] + matrix[:3, 2]).tolist(),
            }
        )
    return found


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _write_script(path: Path, name: str, data: Any) -> None:
    text = json.dumps(data, separators=(",", ":"), sort_keys=True, allow_nan=False)
    write_bytes_atomically(path, f"VIEW.{name} = {text};\n".encode())
