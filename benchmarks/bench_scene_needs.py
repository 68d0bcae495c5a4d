# SPDX-License-Identifier: MIT
"""Savings from modelling only what a scene requires, each measured in one process.

    python -m benchmarks.bench_scene_needs                 two rooms of the bundled library; a minute

* assets: a configuration's meshes and textures, against those of the whole library;
* sharing: the second configuration of a process, against one that finds nothing of the first;
* constants: channels that are one number, against the same number as an image of 256 x 256 texels;
* one scene: built once for all views, against once for each;
* recordings: paths recorded once for all views of a scene, against for each.

Seconds are processor seconds, medians of --repeats; kernels are in the cache on disk. The length of paths is
measured by bench_path_depth, textures by ``python -m datagen.tradeoff --sweep texture_shrink``
(docs/decisions/0072), kernels on disk by bench_first_pixel.
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bench_first_pixel import planned_folder
from benchmarks.timing import timed
from datagen.farm.folder import DatasetFolder
from datagen.formats.asset import EnvironmentAsset, Material, MaterialAsset, ObjectAsset, Texture
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import RenderRecipe
from datagen.library import Library
from datagen.rendering.prepared_scene import release_memory
from datagen.rendering.renderer import SceneRenderer
from datagen.rendering.scene_builder import AssetCaches, build_scene
from datagen.rendering.textures import SCALAR_ROLES, Role, TextureCache, adjusted_constant, upload
from mitsuba_plugins.variant import select_variant

REPOSITORY = Path(__file__).resolve().parents[1]
CONSTANT_SIDE = 256
ROLES: tuple[Role, ...] = ("diffuse_albedo", "specular_albedo", "roughness", "normal", "opacity")


class ImagesOfConstants(TextureCache):
    """As if nothing were constant: every channel is an image."""

    def channel(self, package: Any, value: Any, role: Any, *arguments: Any, **options: Any) -> Any:
        """See :class:`TextureCache`."""
        if isinstance(value, Texture):
            return super().channel(package, value, role, *arguments, **options)
        constant = adjusted_constant(value, role, *arguments[:1]) if arguments else np.float32(value)
        shape = (CONSTANT_SIDE, CONSTANT_SIDE) + (() if role in SCALAR_ROLES else (3,))
        self.num_bytes += 2 * int(np.prod(shape))
        return upload(np.broadcast_to(constant, shape).astype(np.float32))


def seconds(work: Callable[[], Any]) -> float:
    """Processor seconds."""
    gc.collect()
    return timed(work).cpu


def load_everything(library: Library) -> AssetCaches:
    """Every mesh and every texture of a library."""
    caches = AssetCaches()
    caches.meshes.max_bytes = caches.textures.max_bytes = 1 << 40
    for package in library:
        asset = package.asset
        materials: list[Material] = []
        if isinstance(asset, ObjectAsset | EnvironmentAsset):
            materials += asset.materials.values()
            for part in asset.parts:
                caches.meshes.mesh(package, part.mesh)
        elif isinstance(asset, MaterialAsset):
            materials.append(asset.material)
        for material in materials:
            for role in ROLES:
                value = getattr(material, role)
                if isinstance(value, Texture):
                    caches.textures.channel(package, value, role)
    return caches


def megabytes(caches: AssetCaches) -> float:
    """Of meshes and textures."""
    return (caches.meshes.num_bytes + caches.textures.num_bytes) / 1e6


def row(name: str, unit: str, done: list[float], left: list[float]) -> dict[str, Any]:
    """Medians of the costs with and without."""
    return {"name": name, "unit": unit, "with": statistics.median(done), "without": statistics.median(left)}


def loading(configurations: tuple[Configuration, Configuration], library: Library, repeats: int) -> list[Any]:
    """Time and memory of loading a configuration."""
    first, second = configurations
    alone, after_first, by_itself, everything = [], [], [], []
    build_scene(first, library, AssetCaches())  # imports, and files that the system has not read yet
    for _ in range(repeats):
        own = AssetCaches()
        alone.append(seconds(partial(build_scene, first, library, own)))
        own_megabytes = megabytes(own)
        after_first.append(seconds(partial(build_scene, second, library, own)))
        by_itself.append(seconds(partial(build_scene, second, library, AssetCaches())))
        everything.append(alone[-1] + seconds(partial(load_everything, library)))
        release_memory()
    all_megabytes = megabytes(load_everything(library))
    release_memory()
    return [
        row("assets of the configuration only", "s", alone, everything),
        row("assets of the configuration only", "MB", [own_megabytes], [all_megabytes]),
        row("second configuration uses the first's", "s", after_first, by_itself),
    ]


def rendering(configuration: Configuration, library: Library, repeats: int) -> list[Any]:
    """Time and memory of building a scene, and the number of builds."""
    recipe = RenderRecipe(path_samples=16, auxiliary_samples=64, denoise=False, irradiance_cache=True)
    rows: list[Any] = []
    built: dict[str, list[float]] = {}
    views: dict[str, list[float]] = {}
    texture_megabytes: dict[str, list[float]] = {}
    for name, textures in (("constants", TextureCache), ("images", ImagesOfConstants)):
        built[name], views[name] = [], []
        for number in range(repeats + 1):
            caches = AssetCaches(textures=textures())
            start = time.process_time()
            renderer = SceneRenderer(configuration, library, recipe, caches=caches)
            if number > 0:  # the first compiles
                built[name].append(time.process_time() - start)
            renderer.render_view(0)  # records
            if number > 0:
                views[name].append(seconds(partial(renderer.render_view, 1)))
            if number < repeats:
                renderer.close()
        texture_megabytes[name] = [caches.textures.num_bytes / 1e6]
        if name == "constants":
            played, anew = [], []
            for _ in range(repeats):
                played.append(seconds(partial(renderer.render_view, 1)))
                renderer.tracer.forget_recordings()
                anew.append(seconds(partial(renderer.render_view, 1)))
            count = len(configuration.cameras)
            pairs = list(zip(built[name], views[name], strict=True))
            once, each = [b / count + v for b, v in pairs], [b + v for b, v in pairs]
            rows.append(row(f"one scene for {count} views", "s a view", once, each))
            rows.append(row("paths recorded once for a scene", "s a view", played, anew))
        renderer.close()
    for unit, found in (("s to build", built), ("s a view", views), ("MB of textures", texture_megabytes)):
        rows.append(row("constants stay constants", unit, found["constants"], found["images"]))
    return rows


def main() -> None:
    """Parse, measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, nargs=2, default=(160, 96))
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    select_variant("llvm_ad_rgb")
    folder = DatasetFolder(planned_folder(arguments.out, tuple(arguments.size), arguments.views, 2))
    library = Library(folder.library_paths())
    first, second = (folder.read_configuration(unit) for unit in folder.read_plan().units)
    rows = loading((first, second), library, arguments.repeats)
    rows += rendering(first, library, arguments.repeats)
    print("| what | unit | with it | without it | ratio |\n|---|---|---|---|---|")
    for r in rows:
        cells = f"{r['with']:.2f} | {r['without']:.2f} | {r['without'] / r['with']:.2f}"
        print(f"| {r['name']} | {r['unit']} | {cells} |")
    (arguments.out / "bench_scene_needs.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
