# SPDX-License-Identifier: MIT
"""Export of a planned configuration for another renderer, and our images of it (see bench_cycles.py).

    python -m benchmarks.studies.cycles_scene export FOLDER OUT    one package, lights, cameras, a sky
    python -m benchmarks.studies.cycles_scene reference FOLDER OUT VIEW... --samples 256
    python -m benchmarks.studies.cycles_scene quality FOLDER OUT VIEW... --quality standard

``export`` writes the room as one asset package, exactly as our renderer renders it: every placed part with
its assigned material, variations applied and UVs scaled. ``setup.json`` next to it contains the lights (skies
as an equirectangular image and a sun) and the cameras.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from benchmarks.bench_view import write_reference
from datagen.assembly.daylight import SUN_HALF_ANGLE_RAD, lookup, sun_of, sunsky
from datagen.farm.folder import DatasetFolder
from datagen.formats.asset import MATERIAL_CHANNELS, EnvironmentAsset, ObjectAsset, Texture
from datagen.formats.base import canonical_json
from datagen.formats.configuration import Configuration
from datagen.formats.lights import EnvironmentLight, SkyLight
from datagen.formats.recipe import QUALITIES, RenderRecipe
from datagen.foundation.color import srgb_from_linear
from datagen.foundation.errors import Problem, raise_problems
from datagen.foundation.exr import encode_view
from datagen.foundation.images import encode_png, read_image
from datagen.foundation.meshes.ply import decode_ply, encode_ply
from datagen.library import Library
from datagen.rendering.materials import SurfaceMaterial, resolve_materials
from datagen.rendering.renderer import SceneRenderer
from datagen.rendering.scene_builder import uv_scale_of
from datagen.rendering.textures import NO_ADJUSTMENT, SCALAR_ROLES, adjusted_constant, decoded_texture

SKY_SIZE = (512, 1024)


def open_folder(path: Path) -> tuple[Configuration, Library, DatasetFolder]:
    """Open a planned folder; returns its first configuration, its library and the folder."""
    folder = DatasetFolder(path)
    configuration = folder.read_configuration(folder.read_plan().units[0])
    return configuration, Library(folder.library_paths()), folder


class RoomExport:
    """Export of a whole configuration to the package ``out``."""

    def __init__(self, configuration: Configuration, library: Library, out: Path):
        self.configuration, self.library, self.out = configuration, library, out
        self.materials: dict[str, dict[str, Any]] = {}
        self.parts: list[dict[str, Any]] = []
        self._names: dict[Any, str] = {}
        self._meshes: dict[tuple[str, str, float], str] = {}

    def write(self) -> None:
        """Write meshes, textures and ``asset.json``."""
        for folder in ("meshes", "textures"):
            (self.out / folder).mkdir(parents=True, exist_ok=True)
        problems: list[Problem] = []
        for placed in (self.configuration.environment, *self.configuration.objects):
            package = self.library.package(placed.asset)
            asset = package.asset
            assert isinstance(asset, ObjectAsset | EnvironmentAsset)
            surfaces = resolve_materials(placed, package, self.library, problems)
            for part in asset.parts:
                world_from_part = np.array(placed.world_from_asset) @ np.array(part.asset_from_part)
                surface = surfaces[part.material]
                scale = uv_scale_of(surface, part, world_from_part)
                self.parts.append(
                    {
                        "name": f"{placed.name}/{part.name}",
                        "mesh": self._mesh(package, part.mesh, scale),
                        "material": self._material(surface),
                        "asset_from_part": world_from_part.tolist(),
                    }
                )
        raise_problems(problems)
        description = {
            "format": "scene-materials/asset",
            "version": 1,
            "kind": "environment",
            "id": self.configuration.id,
            "title": self.configuration.id,
            "provenance": {"license": "CC0-1.0"},
            "materials": self.materials,
            "parts": self.parts,
        }
        (self.out / "asset.json").write_text(json.dumps(description), encoding="utf-8")

    def _mesh(self, package: Any, name: str, uv_scale: float) -> str:
        key = (package.sha256, name, uv_scale)
        if key not in self._meshes:
            mesh = decode_ply(package.read_bytes(name), name)
            if mesh.uv is not None:
                mesh = replace(mesh, uv=(mesh.uv.astype(np.float64) * uv_scale).astype(np.float32))
            self._meshes[key] = f"meshes/{len(self._meshes):04}.ply"
            (self.out / self._meshes[key]).write_bytes(encode_ply(mesh))
        return self._meshes[key]

    def _material(self, surface: SurfaceMaterial) -> str:
        key = (surface.key, surface.emission)
        if key not in self._names:
            name = self._names[key] = f"{len(self._names):03} {surface.name}"
            self.materials[name] = {
                role: self._channel(surface, role, f"{len(self._names):03}_{role}")
                for role in MATERIAL_CHANNELS
                if getattr(surface.material, role) is not None
            } | ({"emission": list(surface.emission)} if surface.emission is not None else {})
        return self._names[key]

    def _channel(self, surface: SurfaceMaterial, role: Any, stem: str) -> Any:
        value = getattr(surface.material, role)
        adjustment = surface.adjustment if role not in ("opacity", "normal") else NO_ADJUSTMENT
        if not isinstance(value, Texture):
            return adjusted_constant(value, role, adjustment).tolist()
        source = surface.package.local_file(value.texture)
        if adjustment == NO_ADJUSTMENT:
            name = f"textures/{stem}{source.suffix}"
            shutil.copyfile(source, self.out / name)
            return {**value.model_dump(mode="json"), "texture": name}
        values = decoded_texture(surface.package, value, role, adjustment)
        is_scalar = role in SCALAR_ROLES
        coded = values if is_scalar else srgb_from_linear(values)
        name = f"textures/{stem}.png"
        pixels = np.round(255 * np.clip(coded, 0, 1)).astype(np.uint8)
        (self.out / name).write_bytes(encode_png(np.repeat(pixels[..., None], 3, 2) if is_scalar else pixels))
        return {
            "texture": name,
            "encoding": "linear" if is_scalar else "srgb",
            "channel": "r" if is_scalar else "rgb",
        }


def sky_image(light: SkyLight | EnvironmentLight, library: Library) -> NDArray[np.float32]:
    """Equirectangular radiance (H, W, 3) of a sky without sun, as in Blender: +X in the centre, +Y left."""
    rows, columns = SKY_SIZE
    elevation = (0.5 - (np.arange(rows) + 0.5) / rows) * np.pi
    azimuth = (0.5 - (np.arange(columns) + 0.5) / columns) * 2 * np.pi
    flat = np.cos(elevation)[:, None]
    up = np.broadcast_to(np.sin(elevation)[:, None], SKY_SIZE)
    directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], axis=-1).reshape(-1, 3)
    if isinstance(light, SkyLight):
        values = light.sky_scale * sunsky(
            light.sun_direction, light.turbidity, light.ground_albedo, 1.0, 0.0, directions
        )
    elif light.image is None:
        values = np.broadcast_to(light.scale * np.array(light.radiance), directions.shape)
    else:
        assert light.asset is not None
        pixels = read_image(library.package(light.asset).local_file(light.image)).astype(np.float64)
        environment_from_world = np.array(light.world_from_environment)[:3, :3].T
        values = light.scale * lookup(pixels[..., :3])(directions @ environment_from_world.T)
    # OpenEXR ignores strides, so the array must be contiguous
    return np.ascontiguousarray(values.reshape(rows, columns, 3), np.float32)


def export(configuration: Configuration, library: Library, out: Path) -> None:
    """Write the package of a configuration, ``setup.json``, and ``sky.exr`` if it has a sky."""
    RoomExport(configuration, library, out).write()
    lights: list[dict[str, Any]] = []
    for light in configuration.lights:
        if not isinstance(light, SkyLight | EnvironmentLight):
            lights.append(light.model_dump(mode="json"))
            continue
        channels = {"RGB": sky_image(light, library)}
        with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, channels) as file:
            file.write(str(out / "sky.exr"))
        if isinstance(light, SkyLight) and light.sun_scale > 0:
            sun = sun_of(light).model_copy(update={"angular_diameter_rad": 2 * SUN_HALF_ANGLE_RAD})
            lights.append(sun.model_dump(mode="json"))
    cameras = [camera.model_dump(mode="json") for camera in configuration.cameras]
    (out / "setup.json").write_bytes(canonical_json({"lights": lights, "cameras": cameras}))


def write_references(folder: Path, out: Path, views: list[int], samples: int) -> None:
    """Write two converged images, without irradiance cache, for each missing file ``view_000.npz`` etc."""
    configuration, library, planned = open_folder(folder)
    recipe = planned.read_recipe().render.model_copy(update={"irradiance_cache": False})
    renderer = SceneRenderer(configuration, library, recipe)
    out.mkdir(parents=True, exist_ok=True)
    for view in views:
        path = out / f"view_{view:03}.npz"
        write_reference(path, ("first", "second"), renderer, view, samples, "our reference")


def render_quality(folder: Path, out: Path, views: list[int], quality: str) -> None:
    """Write ``view_000.exr`` etc. at a named quality, and ``times.json`` as in cycles_baseline.py."""
    configuration, library, _ = open_folder(folder)
    renderer = SceneRenderer(configuration, library, RenderRecipe.model_validate({"quality": quality}))
    loaded = time.time()
    out.mkdir(parents=True, exist_ok=True)
    finished = []
    for view, image in zip(views, renderer.render_views(views), strict=True):
        (out / f"view_{view:03}.exr").write_bytes(encode_view(image.buffers, "zip"))
        finished.append(time.time())
    (out / "times.json").write_text(json.dumps({"loaded": loaded, "finished": finished}), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb in ("export", "reference", "quality"):
        command = verbs.add_parser(verb)
        command.add_argument("folder", type=Path)
        command.add_argument("out", type=Path)
        if verb != "export":
            command.add_argument("views", type=int, nargs="+")
        if verb == "reference":
            command.add_argument("--samples", type=int, default=256)
        if verb == "quality":
            command.add_argument("--quality", choices=tuple(QUALITIES), required=True)
    arguments = parser.parse_args()
    if arguments.verb == "export":
        configuration, library, _ = open_folder(arguments.folder)
        export(configuration, library, arguments.out)
    elif arguments.verb == "reference":
        write_references(arguments.folder, arguments.out, arguments.views, arguments.samples)
    else:
        render_quality(arguments.folder, arguments.out, arguments.views, arguments.quality)


if __name__ == "__main__":
    main()
