# SPDX-License-Identifier: MIT
"""Panoramas outside windows: rooms that get one, brightness, and lamps that are on at night."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from datagen.assembly.generated import generated_room
from datagen.assembly.notes import rooms_without_sky
from datagen.assembly.panoramas import OUTSIDE_SHARE, panoramas_of
from datagen.assembly.plan import assemble
from datagen.assembly.splits import check_recipe
from datagen.assembly.white_balance import ADAPTATION, NO_TINT, tint_of_lamps
from datagen.asset_check import check_package
from datagen.formats.asset import Daytime, PanoramaAsset, Provenance
from datagen.formats.base import canonical_json
from datagen.formats.configuration import Configuration
from datagen.formats.lights import AreaLight, EnvironmentLight
from datagen.formats.package import write_package
from datagen.formats.recipe import LightRecipe, Recipe
from datagen.foundation.bundled import bundled_library
from datagen.foundation.color import color_of_temperature
from datagen.foundation.errors import InputError
from datagen.library import Library, describe_library
from tests.datagen.small_library import write_room, write_small_library

TIMES: tuple[Daytime, ...] = ("day", "night")


def write_panorama(root: Path, name: str, daytime: Daytime, value: float = 1.0) -> None:
    """Write the package of a panorama of constant radiance ``value``."""
    file = root.parent / f"{name}.exr"
    file.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.full((8, 16, 3), value, np.float32)
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": pixels}).write(str(file))
    asset = PanoramaAsset(
        id=name, title=name, provenance=Provenance(license="CC0-1.0"), image="sky.exr", daytime=daytime
    )
    write_package(root / "panoramas" / name, asset, {"sky.exr": file})


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    root = write_small_library(tmp_path_factory.mktemp("panoramas") / "library")
    for time in TIMES:
        write_panorama(root, f"{time}-view", time)
    return Library([root])


def recipe(weights: dict[str, float] | None, **lights: Any) -> Recipe:
    base = {"area_probability": 0, "point_probability": 0, "native_probability": 0, "panoramas": weights}
    return Recipe.model_validate(
        {
            "name": "outside",
            "configurations": 20,
            "views": 1,
            "resolution": (32, 24),
            "environments": {"include": ["room-0"]},
            "objects": {"count": (0, 1)},
            "lights": {**base, **lights},
        }
    )


def outside_of(configuration: Configuration) -> EnvironmentLight:
    (light,) = (x for x in configuration.lights if isinstance(x, EnvironmentLight))
    return light


def test_rooms_with_openings_have_a_panorama_outside(library: Library) -> None:
    wanted = recipe({"day": 1}, daylight_probability=0)
    found = [assemble(wanted, index, library) for index in range(3)]
    for configuration in found:
        light = outside_of(configuration)
        assert light.asset == "day-view" and light.image == "sky.exr" and light.scale > 0
        assert configuration.assets["day-view"] == library.package("day-view").sha256
    assert len({outside_of(configuration).world_from_environment for configuration in found}) == 3
    again = assemble(wanted, 1, library)
    assert canonical_json(again) == canonical_json(found[1])


def test_by_night_lamps_are_on_and_the_outside_is_dim(library: Library) -> None:
    """At night lamps are on although the recipe requests none, and the outside is dimmer than by day."""
    for index in range(3):
        configuration = assemble(recipe({"night": 1}), index, library)
        assert any(isinstance(light, AreaLight) for light in configuration.lights)
        by_day = assemble(recipe({"day": 1}), index, library)
        assert not any(isinstance(light, AreaLight) for light in by_day.lights)
        assert 0 < outside_of(configuration).scale < 0.1 * outside_of(by_day).scale
    assert OUTSIDE_SHARE["night"][1] < OUTSIDE_SHARE["dusk"][1] < OUTSIDE_SHARE["overcast"][1]


def test_white_balance_keeps_a_share_of_the_warmth() -> None:
    for kelvin in (2700.0, 3500.0, 5000.0):
        light = np.array(color_of_temperature(kelvin))
        shown = light * tint_of_lamps(3.0 * light)
        left = 1e6 / 6500 + (1 - ADAPTATION) * (1e6 / kelvin - 1e6 / 6500)
        assert shown == pytest.approx(color_of_temperature(1e6 / left), abs=0.01)
    for bluish in ((0.9, 1.0, 1.2), (0.0, 0.0, 0.0), (1.0, 1.0, 0.0)):
        assert tint_of_lamps(np.array(bluish)) == NO_TINT


def test_lamps_are_balanced_to_the_light_of_the_room(library: Library) -> None:
    """White balance makes lamps nearly white at night and warmer by day; without a panorama it is off."""

    def warmth(**lights: Any) -> float:
        fields = {"area_probability": 1, "color_temperature_k": (2700, 2700), **lights}
        configuration = assemble(recipe(fields.pop("panoramas"), **fields), 0, library)
        red, _, blue = next(x for x in configuration.lights if isinstance(x, AreaLight)).radiance
        return red / blue

    night, day = warmth(panoramas={"night": 1}), warmth(panoramas={"day": 1})
    bare = warmth(panoramas=None, daylight_probability=0)
    red, _, blue = color_of_temperature(2700)
    assert bare == pytest.approx(red / blue, rel=1e-3)
    assert 1.0 < night < day < bare and night < 0.6 * bare


def test_rooms_without_openings_or_with_a_sky_have_none(tmp_path: Path) -> None:
    root = write_small_library(tmp_path / "library")
    write_panorama(root, "day-view", "day")
    write_room(root, "closed", openings=())
    write_room(root, "with-sky", lights=(EnvironmentLight(name="sky"),))
    library = Library([root])
    for name in ("closed", "with-sky"):
        wanted = recipe({"day": 1}, native_probability=1)
        wanted = wanted.model_copy(
            update={"environments": wanted.environments.model_copy(update={"include": (name,)})}
        )
        lights = assemble(wanted, 0, library).lights
        assert not any(isinstance(light, EnvironmentLight) and light.asset == "day-view" for light in lights)


def test_user_rooms_without_a_sky_are_reported(tmp_path: Path, library: Library) -> None:
    root = tmp_path / "own"
    write_room(root, "closed", openings=())
    write_room(root, "open")
    write_room(root, "with-sky", lights=(EnvironmentLight(name="sky"),))
    own = Library([root, *library.paths])

    def reported(**lights: Any) -> dict[str, str]:
        fields = {"environments": {"include": ["closed", "open", "with-sky"]}, "lights": lights}
        wanted = recipe({"day": 1}).model_dump(mode="json") | fields
        return {line.split()[0]: line for line in rooms_without_sky(Recipe.model_validate(wanted), own)}

    by_chance = reported(daylight_probability=0.7)
    assert set(by_chance) == {"closed", "open"}
    assert "70% of its configurations" in by_chance["open"] and "mark its windows" in by_chance["closed"]
    assert "panorama" in reported(panoramas={"day": 1})["open"]
    assert reported(daylight_probability=0) == {}
    bundled = Recipe.model_validate({"name": "b", "configurations": 1, "views": 1})
    with Library([bundled_library()]) as library:
        assert rooms_without_sky(bundled, library) == []


def test_times_of_day_are_weighted_and_must_be_in_the_library(library: Library) -> None:
    both = recipe({"day": 3, "night": 1})
    times = [outside_of(assemble(both, index, library)).asset for index in range(12)]
    assert 6 <= times.count("day-view") < 12
    assert [asset.id for asset in panoramas_of(library, "night")] == ["night-view"]
    with pytest.raises(InputError, match=r"lights.panoramas.dusk = no such panorama.*leave it out"):
        check_recipe(recipe({"dusk": 1}), library)
    with pytest.raises(ValueError, match="positive weight of day, overcast, dusk, night"):
        LightRecipe.model_validate({"panoramas": {"day": 0}})


def test_generated_rooms_drop_their_modelled_outside() -> None:
    parametric = {"parametric": {"kinds": ["study"]}}
    old = Recipe.model_validate({"name": "a", "configurations": 9, "views": 1, "environments": parametric})
    new = Recipe.model_validate(
        {
            "name": "a",
            "configurations": 9,
            "views": 1,
            "environments": parametric,
            "lights": {"panoramas": {"day": 1}},
        }
    )
    index = next(k for k in range(9) if (room := generated_room(old, k)) and room.package.asset.openings)  # type: ignore[union-attr]
    rooms = [generated_room(wanted, index) for wanted in (old, new)]
    parts = [{part.name for part in room.package.asset.parts} for room in rooms if room]  # type: ignore[union-attr]
    gone = parts[0] - parts[1]
    assert parts[1] < parts[0] and gone and all(name.startswith("outside.") for name in gone)
    assert len({room.package.id for room in rooms if room}) == 2


def test_panoramas_are_listed_and_checked(library: Library, tmp_path: Path) -> None:
    lines = {line.id: line for line in describe_library(library.paths)}
    assert lines["night-view"].kind == "panorama" and lines["night-view"].detail == "night"
    assert not check_package(library.package("day-view")).errors
    for value in (float("nan"), -1.0):
        root = tmp_path / f"value {value}"
        write_panorama(root / "library", "broken", "day", value)
        with Library([root / "library"]) as broken:
            (problem,) = check_package(broken.package("broken")).errors
        assert "NaN, Inf or negative values" in problem.got
