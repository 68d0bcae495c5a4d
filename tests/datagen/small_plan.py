# SPDX-License-Identifier: MIT
"""A planned dataset folder of tiny units, made without the assembler."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datagen.farm.folder import DatasetFolder
from datagen.farm.planning import start_folder, write_plan
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.base import canonical_json, write_bytes_atomically
from datagen.formats.configuration import Configuration, PlacedAsset, ViewCamera
from datagen.formats.lights import PointLight
from datagen.formats.recipe import Recipe, RenderRecipe, StatisticsRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.library import Library
from tests.datagen.small_library import write_small_library

SIZE = (64, 48)


def plan_small(
    root: Path,
    library_root: Path,
    num_units: int = 3,
    num_views: int = 3,
    objects: tuple[PlacedAsset, ...] = (),
    light: bool = False,
) -> DatasetFolder:
    """Write a plan to ``root``, and the library unless it exists; equal arguments give equal units.
    Cameras look at the ``objects``, if given, otherwise at random points."""
    if not library_root.exists():
        write_small_library(library_root)
    library = Library([library_root])
    room = library.select("environment")[0]
    assert isinstance(room.asset, EnvironmentAsset)
    region = room.asset.camera_regions[0]
    recipe = Recipe(
        name="small",
        configurations=num_units,
        views=num_views,
        resolution=SIZE,
        statistics=StatisticsRecipe(light=light),
        # With an error target, the number of passes varies between views; interruptions must not change it.
        render=RenderRecipe(
            variant="llvm_ad_rgb",
            max_rel_mse=0.02,
            max_path_samples=16,
            firefly_clamp=30,
            auxiliary_samples=4,
        ),
    )
    folder = start_folder(recipe, library, root)
    for index in range(num_units):
        rng = np.random.default_rng(index)
        cameras = []
        for view in range(num_views):
            eye, target = rng.uniform(region.minimum_m, region.maximum_m, (2, 3))
            if objects:
                places = [np.array(p.world_from_asset)[:3, 3] for p in objects]
                target = np.mean(places, axis=0) + np.array([0, 0, 0.5])
            camera = Camera(*SIZE, 40.0, 40.0, SIZE[0] / 2, SIZE[1] / 2, look_at(eye, target))
            cameras.append(ViewCamera.from_camera(f"view-{view:03d}", camera))
        middle = np.mean([region.minimum_m, region.maximum_m], axis=0)
        lamp = PointLight(name="lamp", position_m=tuple(middle), intensity=(5.0, 5.0, 4.0))
        configuration = Configuration(
            id=f"small-{index:05d}",
            index=index,
            seed=index + 10,
            environment=PlacedAsset(name="environment", asset=room.id),
            lights=(lamp,),
            cameras=tuple(cameras),
            objects=objects,
            assets={p: library.package(p).sha256 for p in sorted({room.id, *(o.asset for o in objects)})},
        )
        path = folder.configuration_path(configuration.id)
        write_bytes_atomically(path, canonical_json(configuration))
    write_plan(folder, recipe, library)
    return folder
