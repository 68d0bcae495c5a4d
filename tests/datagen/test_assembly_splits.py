# SPDX-License-Identifier: MIT
"""Splits: shares of configurations, assets that never cross splits, and impossible recipes."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.assembly.plan import assemble
from datagen.assembly.splits import SPLITS, check_recipe, pools_of_split, split_counts, split_of
from datagen.formats.asset import LightSlot, Opening, Provenance, SupportSurface, Texture
from datagen.formats.lights import AreaLight, SkyLight
from datagen.formats.package import open_package, write_package
from datagen.formats.recipe import Recipe
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png
from datagen.library import Library
from tests.datagen.small_library import box, write_material, write_object, write_room, write_small_library

RESERVED = Provenance(license="CC0-1.0", usage="evaluation_only")


def recipe(**fields: Any) -> Recipe:
    base: dict[str, Any] = {"name": "splits", "configurations": 40, "views": 2, "resolution": (64, 40)}
    return Recipe.model_validate({**base, **fields})


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    root = write_small_library(tmp_path_factory.mktemp("library"), num_rooms=3)
    for k in range(4):
        write_material(root, f"pine-{k}", ("wood",), diffuse_albedo=(0.5, 0.4, 0.2 + 0.01 * k))
        write_object(root, f"cube-{k}", "box", {"body": box([-0.05, -0.05, 0], [0.05, 0.05, 0.1 + 0.01 * k])})
    return Library([root])


@pytest.mark.parametrize("count", [1, 2, 7, 40, 160, 1001])
@pytest.mark.parametrize("shares", [(1, 0, 0), (0.9, 0.1, 0), (0.8, 0.1, 0.1), (0, 0, 1), (0.34, 0.33, 0.33)])
def test_shares_are_exact_and_even(count: int, shares: tuple[float, float, float]) -> None:
    wanted = recipe(configurations=count, splits=dict(zip(SPLITS, shares, strict=True)))
    dealt = Counter(split_of(wanted, k) for k in range(count))
    assert dict(dealt) == {s: n for s, n in split_counts(wanted).items() if n}
    for split, share in zip(SPLITS, shares, strict=True):
        assert abs(dealt[split] - share * count) <= 1.0
        half = Counter(split_of(wanted, k) for k in range(count // 2))
        assert abs(half[split] - share * (count // 2)) <= 1.5


def used_assets(configuration: Any) -> set[str]:
    return set(configuration.assets)


def test_disjoint_splits_share_nothing(library: Library) -> None:
    wanted = recipe(
        configurations=12,
        splits={"train": 0.5, "validation": 0.25, "test": 0.25, "disjoint": True},
        objects={"count": (3, 5)},
    )
    check_recipe(wanted, library)
    seen: dict[str, set[str]] = {split: set() for split in SPLITS}
    for index in range(wanted.configurations):
        configuration = assemble(wanted, index, library)
        assert configuration.split == split_of(wanted, index)
        seen[configuration.split] |= used_assets(configuration)
    assert all(seen.values())
    for one in SPLITS:
        for other in SPLITS:
            assert one == other or not seen[one] & seen[other]
    shared = recipe(configurations=12, splits={"train": 0.5, "test": 0.5}, objects={"count": (3, 5)})
    both = [used_assets(assemble(shared, index, library)) for index in range(6)]
    assert set.union(*both[0::2]) & set.union(*both[1::2])  # without ``disjoint`` splits share assets


def test_partition_uses_all_assets_and_favours_training(library: Library) -> None:
    wanted = recipe(splits={"train": 0.8, "test": 0.2, "disjoint": True})
    pools = {split: pools_of_split(wanted, library, split) for split in ("train", "test")}
    rooms = [p.id for split in pools for p in pools[split].environments]  # type: ignore[index]
    assert sorted(rooms) == ["room-0", "room-1", "room-2"]
    assert len(pools["train"].environments) == 2
    woods = [p.id for p in pools["train"].materials if "wood" in p.asset.material.classes]  # type: ignore[union-attr]
    assert len(woods) == 5  # one of 6 is reserved for the test split
    assert "steel" in [p.id for p in pools["train"].materials]  # the only asset of a class is for training


def test_assets_that_share_a_file_share_a_split(tmp_path: Path, library: Library) -> None:
    root = write_small_library(tmp_path, num_rooms=2)
    for k in range(6):
        write_object(root, f"copy-{k}", "box", {"body": box([-0.03, -0.03, 0], [0.03, 0.03, 0.05])})
    wanted = recipe(splits={"train": 0.5, "test": 0.5, "disjoint": True})
    homes = [
        {p.id for p in pools_of_split(wanted, Library([root]), split).objects} for split in ("train", "test")
    ]
    copies = {f"copy-{k}" for k in range(6)}
    assert [len(home & copies) for home in homes] in ([6, 0], [0, 6])


def test_reserved_assets_are_never_used(tmp_path: Path) -> None:
    root = write_small_library(tmp_path)
    write_room(root, "reserved-room", provenance=RESERVED)
    write_object(
        root, "reserved-cube", "box", {"body": box([-0.05, -0.05, 0], [0.05, 0.05, 0.1])}, provenance=RESERVED
    )
    library = Library([root])
    wanted = recipe(configurations=10, objects={"count": (6, 8)})
    for index in range(10):
        assert not {"reserved-room", "reserved-cube"} & used_assets(assemble(wanted, index, library))
    with pytest.raises(InputError, match=r"environments.include = 'reserved-room'.*evaluation_only"):
        check_recipe(recipe(environments={"include": ["reserved-room"]}), library)
    with pytest.raises(InputError, match=r"lights.environment_images = 'reserved-room'.*evaluation_only"):
        check_recipe(recipe(lights={"environment_images": ["reserved-room"]}), library)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"environments": {"include": ["rom-0"]}}, r"environments.include = 'rom-0'.*did you mean room-0"),
        ({"materials": {"exclude": ["okk"]}}, r"materials.exclude = 'okk'.*did you mean oak"),
        (
            {"objects": {"category_weights": {"chairs": 2}}},
            r"category_weights = 'chairs'.*did you mean chair",
        ),
        ({"lights": {"environment_images": ["sky"]}}, r"lights.environment_images = 'sky'"),
        ({"lights": {"environment_images": ["oak"]}}, r"oak: lights = no environment light with an image"),
        ({"objects": {"exclude": "ALL"}}, r"objects = no usable object"),
        (
            {"environments": {"parametric": {}}, "materials": {"include": ()}},
            r"materials = no usable material; expected materials for generated rooms; add `bundled`",
        ),
        (
            {"configurations": 3, "splits": {"train": 0.9, "test": 0.1}},
            r"splits.test = 0.1, none of 3 configurations",
        ),
        (
            {
                "splits": {"train": 0.4, "validation": 0.3, "test": 0.3, "disjoint": True},
                "environments": {"include": ["room-0", "room-1"]},
            },
            r"splits.disjoint = no environment for the test split.*set splits.disjoint to false",
        ),
    ],
)
def test_impossible_recipes_are_explained(library: Library, fields: dict[str, Any], message: str) -> None:
    if fields.get("objects", {}).get("exclude") == "ALL":
        fields = {"objects": {"exclude": [p.id for p in library.select("object")]}}
    with pytest.raises(InputError, match=message):
        check_recipe(recipe(**fields), library)


def test_lights_and_surfaces_without_area_or_direction_are_reported(tmp_path: Path) -> None:
    root, corner, edge = write_small_library(tmp_path), (2.0, 2.0, 2.0), (1.0, 0.0, 0.0)
    flat: dict[str, Any] = {"name": "flat", "origin_m": corner, "edge_u_m": edge, "edge_v_m": edge}
    write_room(
        root,
        "flat-room",
        light_slots=(LightSlot(name="flat", kind="area", origin_m=corner),),
        openings=(Opening(**flat),),
        support_surfaces=(SupportSurface(kind="table", clearance_m=1.0, **flat),),
        lights=(AreaLight(radiance=edge, **flat), SkyLight(name="sky", sun_direction=(0, 0, 0))),
    )
    with pytest.raises(InputError) as caught:
        check_recipe(recipe(), Library([root]))
    assert [p.field for p in caught.value.problems] == [
        "lights[0] (flat)", "support_surfaces[0] (flat)", "light_slots[0] (flat)", "openings[0] (flat)",
        "lights[1] (sky).sun_direction",
    ]  # fmt: skip
    check_recipe(recipe(environments={"exclude": ["flat-room"]}), Library([root]))


def test_all_faults_of_a_recipe_are_reported_at_once(library: Library) -> None:
    bad = recipe(environments={"include": ["a"]}, objects={"include": ["b"]}, materials={"exclude": ["c"]})
    with pytest.raises(InputError) as caught:
        check_recipe(bad, library)
    assert len(caught.value.problems) >= 5


def assign(folder: Path, slot: str | None, pixels: np.ndarray) -> None:
    """Use ``pixels`` as the diffuse albedo of a room's ``slot`` or, if None, of a material package."""
    with open_package(folder) as package:
        files: dict[str, bytes | Path] = {
            n: package.read_bytes(n) for n in package.names() if n != "asset.json"
        }
        asset: Any = package.asset
    texture = {"diffuse_albedo": Texture(texture="shared.png", encoding="srgb")}
    if slot is None:
        assigned = {"material": asset.material.model_copy(update={**texture, "tile_size_m": 0.5})}
    else:
        assigned = {"materials": {**asset.materials, slot: asset.materials[slot].model_copy(update=texture)}}
    write_package(
        folder, asset.model_copy(update=assigned), {**files, "shared.png": encode_png(pixels)}, overwrite=True
    )


def test_a_room_never_shows_an_image_of_another_split(tmp_path: Path) -> None:
    """The floors of two rooms and a material share an image, which only one split may show."""
    root = write_small_library(tmp_path, num_rooms=2)
    for k in range(4):
        write_object(root, f"cube-{k}", "box", {"body": box([-0.05, -0.05, 0], [0.05, 0.05, 0.1 + 0.01 * k])})
    pixels = np.full((4, 4, 3), 90, np.uint8)
    pixels[::2] = 140
    for name in ("room-0", "room-1"):
        assign(root / "environments" / name, "floor", pixels)
    assign(root / "materials" / "oak", None, pixels)
    wanted = recipe(
        configurations=6,
        objects={"count": (1, 2)},
        materials={"replace_probability": 0.0, "vary_probability": 0.0},
        splits={"train": 0.5, "validation": 0.5, "disjoint": True},
    )
    library = Library([root])
    both = {split: pools_of_split(wanted, library, split) for split in ("train", "validation")}  # type: ignore[arg-type]
    home = next(s for s, pools in both.items() if "oak" in {p.id for p in pools.materials})
    owners = {p.id for p in both[home].environments}
    assert len(owners) == 1
    assert both["train"].foreign_slots == {(room, "floor") for room in {"room-0", "room-1"} - owners}
    for index in range(6):
        configuration = assemble(wanted, index, library)
        floor = configuration.environment.materials.get("floor")
        is_replaced = floor is not None and floor.asset is not None
        assert is_replaced == (configuration.split != home)
