# SPDX-License-Identifier: MIT
"""A rendered configuration of the tests' library as a shard: eight views that cover most of the room."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datagen.farm.local import LocalOptions, run_local
from datagen.farm.planning import start_folder, write_plan
from datagen.formats.base import canonical_json, write_bytes_atomically
from datagen.formats.configuration import Configuration, MaterialAssignment, PlacedAsset, ViewCamera
from datagen.formats.lights import EnvironmentLight, PointLight
from datagen.formats.recipe import Recipe, RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.library import Library
from tests.datagen.small_library import write_small_library

SIZE = (96, 64)


def cameras(num: int) -> list[ViewCamera]:
    """Cameras around the room's centre, looking outwards and inwards alternately."""
    made = []
    for k in range(num):
        angle = 2 * np.pi * k / num
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array([2.5, 2.0, 1.5]) + way * [1.9, 1.4, 0] * (1 if k % 2 else -0.6)
        target = np.array([2.5, 2.0, 0.7 + 0.5 * (k % 3)]) + (0 if k % 2 else 1) * way
        camera = Camera(*SIZE, 62.0, 62.0, SIZE[0] / 2, SIZE[1] / 2, look_at(eye, target))
        made.append(ViewCamera.from_camera(f"view-{k:03d}", camera))
    return made


def make_shard(root: Path, num_views: int = 8) -> tuple[Path, Configuration, Library]:
    """Render a configuration and pack it; return the shard, its configuration and its library."""
    library_root = root / "library"
    write_small_library(library_root)
    library = Library([library_root])
    recipe = Recipe(
        name="capture",
        configurations=1,
        views=num_views,
        resolution=SIZE,
        render=RenderRecipe(variant="llvm_ad_rgb", path_samples=4, auxiliary_samples=4),
    )
    folder = start_folder(recipe, library, root / "dataset")
    used = ["room-0", "chair", "oak"]
    turned = ((0.6, -0.8, 0.0, 3.6), (0.8, 0.6, 0.0, 0.9), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    configuration = Configuration(
        id="capture-00000",
        index=0,
        seed=7,
        environment=PlacedAsset(
            name="environment", asset="room-0", materials={"floor": MaterialAssignment(asset="oak")}
        ),
        objects=(PlacedAsset(name="chair", asset="chair", world_from_asset=turned),),
        lights=(
            PointLight(name="lamp", position_m=(2.4, 2.1, 2.3), intensity=(6.0, 6.0, 5.0)),
            EnvironmentLight(name="sky", radiance=(1.0, 1.1, 1.3)),
        ),
        cameras=tuple(cameras(num_views)),
        assets={name: library.package(name).sha256 for name in used},
    )
    write_bytes_atomically(folder.configuration_path(configuration.id), canonical_json(configuration))
    write_plan(folder, recipe, library)
    run_local(folder.root, LocalOptions(workers=1))
    (shard,) = sorted(folder.shards_path.glob("*.tar"))
    return shard, configuration, library
