# SPDX-License-Identifier: MIT
"""Assembly of real assets: a converted scene, scanned furniture, photographed materials."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from datagen.assembly.geometry import load_geometry
from datagen.assembly.plan import assemble
from datagen.assembly.splits import check_recipe
from datagen.assembly.things import Room
from datagen.formats.base import canonical_json
from datagen.formats.configuration import Configuration, PlacedAsset
from datagen.formats.recipe import Recipe
from datagen.importers.common import ImportOptions
from datagen.importers.gltf import import_gltf
from datagen.importers.material_folder import import_material_folder
from datagen.importers.mitsuba_xml import import_mitsuba_scene
from datagen.library import Library
from tests.datagen.test_assembly_placement import triangles_cross

pytestmark = pytest.mark.slow
FURNITURE = {
    "sofa_03_1k": "sofa",
    "wooden_bookshelf_worn_1k": "bookshelf",
    "painted_wooden_stool_1k": "stool",
}
MAX_CPU_S = 8.0


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory, shared_data: Path) -> Library:
    root = tmp_path_factory.mktemp("real")
    import_mitsuba_scene(
        shared_data / "scenes/staircase2/scene.xml", root, ImportOptions(dielectric="replace")
    )
    polyhaven = {"license": "CC0-1.0", "author": "Poly Haven", "kind": "object"}
    assets = shared_data / "furniture/living_room_polyhaven/assets"
    for name, category in FURNITURE.items():
        import_gltf(assets / f"{name}.gltf", root, ImportOptions(**polyhaven, category=category))  # type: ignore[arg-type]
    tea = ImportOptions(**polyhaven, category="tea")  # type: ignore[arg-type]
    import_gltf(assets / "tea_set_01_1k.gltf", root, tea, split=True)
    for name in ("marble", "tiles", "wood-floor-43"):
        folder = shared_data / "textures/ambientcg" / name
        import_material_folder(folder, root, ImportOptions(license="CC0-1.0", author="ambientCG"))
    return Library([root])


@pytest.fixture(scope="module")
def recipe(library: Library) -> Recipe:
    made = Recipe.model_validate(
        {"name": "real", "configurations": 3, "views": 40, "objects": {"count": (8, 12)}}
    )
    check_recipe(made, library)
    return made


@pytest.fixture(scope="module")
def configurations(library: Library, recipe: Recipe) -> list[Configuration]:
    return [assemble(recipe, index, library) for index in range(3)]


def triangles(placed: PlacedAsset, library: Library, lift_m: float = 0.0) -> np.ndarray:
    geometry = load_geometry(library.package(placed.asset))
    matrix = np.array(placed.world_from_asset)
    return (geometry.vertices @ matrix[:3, :3].T + matrix[:3, 3] + [0, 0, lift_m])[geometry.faces]


def test_real_objects_do_not_intersect(configurations: list[Configuration], library: Library) -> None:
    for configuration in configurations:
        assert len(configuration.objects) >= 8
        room = triangles(configuration.environment, library)
        things = [triangles(placed, library, 6e-4) for placed in configuration.objects]
        for k, one in enumerate(things):
            low, high = one.min(axis=(0, 1)), one.max(axis=(0, 1))
            near = ((room.min(axis=1) <= high) & (room.max(axis=1) >= low)).all(axis=1)
            assert not triangles_cross(one, room[near]), configuration.objects[k].name
            beneath = room[((room.min(axis=1) <= high) & (room.max(axis=1) >= low - 0.003)).all(axis=1)]
            assert triangles_cross(one - [0, 0, 2.6e-3], beneath)  # at rest: slightly lower, it intersects
            for j in range(k):
                other = things[j]
                if ((low <= other.max(axis=(0, 1))) & (high >= other.min(axis=(0, 1)))).all():
                    assert not triangles_cross(one, other)


def test_real_rooms_get_all_their_views(configurations: list[Configuration]) -> None:
    for configuration in configurations:
        assert len(configuration.cameras) == 40 and configuration.lights
        places = np.array([np.array(c.world_from_camera)[:3, 3] for c in configuration.cameras])
        assert np.ptp(places[:, :2], axis=0).min() > 1.0


def test_real_materials_are_assigned(configurations: list[Configuration]) -> None:
    assigned = {
        m.asset for c in configurations for p in (c.environment, *c.objects) for m in p.materials.values()
    }
    assert {"marble", "tiles", "wood-floor-43"} <= assigned


def test_assembly_is_fast_and_repeatable(
    library: Library, recipe: Recipe, configurations: list[Configuration]
) -> None:
    start = time.process_time()
    again = assemble(recipe, 1, library)
    assert time.process_time() - start < MAX_CPU_S
    assert canonical_json(again) == canonical_json(configurations[1])


def test_consistent_winding_of_imported_rooms_is_recognised(library: Library) -> None:
    assert Room(load_geometry(library.package("staircase2"))).has_consistent_winding
