# SPDX-License-Identifier: MIT
"""Materials are assigned only if their class and the mesh permit, and vary within the range of the class."""

from __future__ import annotations

import colorsys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from datagen.assembly.class_statistics import main, sample_library
from datagen.assembly.materials import (
    CLASS_RANGES,
    MeanMaterial,
    MeanMaterials,
    adjusted,
    assign_materials,
    draw_adjustment,
    mean_materials,
    suits,
)
from datagen.formats.asset import (
    MATERIAL_CLASSES,
    EnvironmentAsset,
    Material,
    MaterialAsset,
    MaterialClass,
    SlotMaterial,
    Texture,
)
from datagen.formats.configuration import ColorAdjustment, MaterialAssignment, PlacedAsset
from datagen.formats.recipe import MaterialRecipe
from datagen.foundation.errors import InputError
from datagen.foundation.random import Draws
from datagen.library import Library
from datagen.rendering.textures import adjusted_constant
from tests.datagen.small_library import CC0, box, write_material, write_object, write_small_library


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return Library([write_small_library(tmp_path_factory.mktemp("library"))])


def test_slots_get_only_classes_that_fit(library: Library) -> None:
    room, palette = library.package("room-0"), library.select("material")
    assert isinstance(room.asset, EnvironmentAsset)
    seen: dict[str, Counter[str]] = {}
    recipe, means = MaterialRecipe(replace_probability=1.0), MeanMaterials()
    for seed in range(60):
        for slot, assigned in assign_materials(room, palette, recipe, means, Draws(seed)).items():
            if assigned.asset is not None:
                asset = library.package(assigned.asset).asset
                assert isinstance(asset, MaterialAsset)
                assert asset.material.classes[0] in room.asset.materials[slot].replaceable_by
                assert assigned.uv_scale is None
                seen.setdefault(slot, Counter())[assigned.asset] += 1
    assert set(seen) == {"floor", "walls", "table", "shelf"}  # the ceiling's material is fixed
    assert set(seen["shelf"]) == {"oak", "walnut", "steel"}
    assert 15 < seen["shelf"]["steel"] < 45  # the class is drawn first, so half are metal


def test_probabilities_are_met(library: Library) -> None:
    room, palette, means = library.package("room-0"), library.select("material"), MeanMaterials()
    nothing = MaterialRecipe(replace_probability=0.0, vary_probability=0.0)
    assert assign_materials(room, palette, nothing, means, Draws(1)) == {}
    half = MaterialRecipe(replace_probability=0.5, vary_probability=0.0)
    replaced = sum(len(assign_materials(room, palette, half, means, Draws(s))) for s in range(100))
    assert 150 < replaced < 250  # 4 replaceable slots, 100 times
    still = MaterialRecipe(replace_probability=0.0, vary_probability=1.0, variation_strength=0.0)
    assert assign_materials(room, palette, still, means, Draws(1)) == {}


def drawn_classes(library: Library, recipe: MaterialRecipe) -> dict[str, Counter[str]]:
    room, palette, means = library.package("room-0"), library.select("material"), MeanMaterials()
    seen: dict[str, Counter[str]] = {}
    for seed in range(80):
        for slot, assigned in assign_materials(room, palette, recipe, means, Draws(seed)).items():
            if assigned.asset is not None:
                asset = library.package(assigned.asset).asset
                assert isinstance(asset, MaterialAsset)
                seen.setdefault(slot, Counter())[asset.material.classes[0]] += 1
    return seen


def test_class_weights_decide_which_class_is_assigned(library: Library) -> None:
    recipe = MaterialRecipe(replace_probability=1.0, class_weights={"metal": 4.0})
    assert 50 < drawn_classes(library, recipe)["shelf"]["metal"] < 78  # expected: 64
    without = MaterialRecipe(replace_probability=1.0, class_weights={"metal": 0.0})
    assert set(drawn_classes(library, without)["shelf"]) == {"wood"}


def test_a_share_of_replacements_may_be_of_any_class(library: Library) -> None:
    room = library.package("room-0").asset
    assert isinstance(room, EnvironmentAsset)
    assert "metal" not in room.materials["floor"].replaceable_by
    recipe = MaterialRecipe(
        replace_probability=1.0, any_class_probability=0.5, class_weights={"metal": 100.0}
    )
    seen = drawn_classes(library, recipe)
    assert 25 < seen["floor"]["metal"] < 55
    assert "ceiling" not in seen  # no class fits, so its material is kept
    never = MaterialRecipe(replace_probability=0.0, vary_probability=0.0, any_class_probability=1.0)
    assert drawn_classes(library, never) == {}


def test_unweighted_classes_are_drawn_uniformly(library: Library) -> None:
    plain = MaterialRecipe(replace_probability=1.0)
    assert drawn_classes(library, plain) == drawn_classes(
        library, MaterialRecipe(replace_probability=1.0, class_weights={"metal": 1.0, "wood": 1.0})
    )


def test_textures_need_uvs_and_a_tile_size(library: Library, tmp_path: Path) -> None:
    room = library.package("room-0").asset
    assert isinstance(room, EnvironmentAsset)
    oak = library.package("oak").asset
    assert isinstance(oak, MaterialAsset)
    assert suits(oak, "floor", room)
    bare = tuple(p.model_copy(update={"uv_per_m": None}) if p.name == "floor" else p for p in room.parts)
    assert not suits(oak, "floor", room.model_copy(update={"parts": bare}))
    unique = oak.material.model_copy(update={"tile_size_m": None})
    assert not suits(oak.model_copy(update={"material": unique}), "floor", room)
    for change in ({"emission": (1.0, 1.0, 1.0)}, {"opacity": 0.5}):
        special = oak.model_copy(update={"material": oak.material.model_copy(update=change)})
        assert not suits(special, "floor", room)


def test_lamps_keep_their_materials(tmp_path: Path, library: Library) -> None:
    slots = {
        "bulb": SlotMaterial(
            classes=("glass",), emission=(5.0, 5.0, 5.0), replaceable_by=("glass", "plastic")
        ),
        "foot": SlotMaterial(classes=("plastic",), replaceable_by=("plastic",)),
    }
    shapes = {
        "bulb": box([-0.05, -0.05, 0.2], [0.05, 0.05, 0.3]),
        "foot": box([-0.06, -0.06, 0], [0.06, 0.06, 0.1]),
    }
    write_object(tmp_path, "lamp", "lamp", shapes, slots)
    always = MaterialRecipe(replace_probability=1.0, vary_probability=1.0)
    lamp = Library([tmp_path]).package("lamp")
    assigned = assign_materials(lamp, library.select("material"), always, MeanMaterials(), Draws(1))
    assert set(assigned) == {"foot"}


@pytest.mark.parametrize("name", MATERIAL_CLASSES)
def test_variation_stays_within_the_class(name: MaterialClass) -> None:
    limits, draws = CLASS_RANGES[name], Draws(3, name)
    for _ in range(200):
        mean = MeanMaterial(tuple(draws.units(3).tolist()), (0.04, 0.04, 0.04), draws.unit())  # type: ignore[arg-type]
        change = draw_adjustment(mean, name, 1.0, draws)
        assert abs(change.hue_shift) <= limits.hue_turns + 1e-6
        assert 1 / limits.saturation - 1e-3 <= change.saturation_scale <= limits.saturation + 1e-3
        assert 1 / limits.value - 1e-3 <= change.value_scale <= limits.value + 1e-3
        brightest = max(mean.diffuse_albedo)
        low, high = min(limits.value_limits[0], brightest), max(limits.value_limits[1], brightest)
        assert low - 1e-3 <= brightest * change.value_scale <= high + 1e-3
        rough = mean.roughness + change.roughness_offset
        low, high = (
            min(limits.roughness_limits[0], mean.roughness),
            max(limits.roughness_limits[1], mean.roughness),
        )
        assert low - 1e-3 <= rough <= high + 1e-3


def test_averages_change_as_the_renderer_changes_constants() -> None:
    draws = Draws(8)
    for _ in range(50):
        diffuse, specular = tuple(draws.units(3).tolist()), tuple(draws.units(3).tolist())
        change = ColorAdjustment(
            hue_shift=draws.uniform(-0.5, 0.5),
            saturation_scale=draws.uniform(0.5, 1.6),
            value_scale=draws.uniform(0.5, 1.6),
            roughness_offset=draws.uniform(-0.5, 0.5),
        )
        ours = adjusted(MeanMaterial(diffuse, specular, 0.4), change)  # type: ignore[arg-type]
        np.testing.assert_allclose(
            ours.diffuse_albedo, adjusted_constant(diffuse, "diffuse_albedo", change), atol=2e-5
        )  # type: ignore[arg-type]
        np.testing.assert_allclose(
            ours.specular_albedo, adjusted_constant(specular, "specular_albedo", change), atol=2e-5
        )  # type: ignore[arg-type]
        assert ours.roughness == pytest.approx(float(adjusted_constant(0.4, "roughness", change)), abs=1e-6)


def test_assigned_materials_follow_assignments(library: Library) -> None:
    change = ColorAdjustment(value_scale=0.5)
    placed = PlacedAsset(
        name="room",
        asset="room-0",
        materials={"table": MaterialAssignment(asset="walnut", adjustment=change)},
    )
    assigned = mean_materials(placed, library, MeanMaterials())
    np.testing.assert_allclose(assigned["table"].diffuse_albedo, (0.075, 0.04, 0.02))
    np.testing.assert_allclose(assigned["floor"].diffuse_albedo, (0.35, 0.22, 0.12))


def test_mean_of_a_texture_is_linear(tmp_path: Path) -> None:
    write_material(tmp_path, "checked", ("wood",), texture=True)
    package = Library([tmp_path]).package("checked")
    assert isinstance(package.asset, MaterialAsset)
    mean = MeanMaterials().mean(package, package.asset.material).diffuse_albedo
    stored = np.random.default_rng(len("checked")).uniform(90, 160, (16, 16, 3)).astype(np.uint8) / 255.0
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(mean, linear.mean(axis=(0, 1)), rtol=1e-4)
    scaled = Material(diffuse_albedo=Texture(texture="albedo.png", encoding="linear", scale=0.5, offset=0.1))
    asset = MaterialAsset(id="checked", title="", provenance=CC0, material=scaled)
    halved = MeanMaterials().mean(package, asset.material).diffuse_albedo
    np.testing.assert_allclose(halved, 0.5 * stored.mean(axis=(0, 1)) + 0.1, rtol=1e-4)


def test_varied_wood_keeps_a_wood_hue() -> None:
    draws = Draws(4)
    oak = (0.45, 0.3, 0.16)
    hue = colorsys.rgb_to_hsv(*oak)[0]
    for _ in range(100):
        change = draw_adjustment(MeanMaterial(oak, (0.04, 0.04, 0.04), 0.5), "wood", 1.0, draws)
        turned = colorsys.rgb_to_hsv(*adjusted(MeanMaterial(oak, (0.04,) * 3, 0.5), change).diffuse_albedo)[0]
        assert abs(turned - hue) < 0.021


def test_class_statistics_measure_a_library(library: Library, capsys: pytest.CaptureFixture[str]) -> None:
    samples = sample_library(library)
    assert sorted(s.value for s in samples["wood"])[0] == pytest.approx(0.15)  # walnut
    (steel,) = samples["metal"]
    assert (steel.value, steel.roughness) == (0.0, 0.3) and np.isnan(steel.value_spread)
    noisy = [s for s in samples["stone"] if np.isfinite(s.value_spread)]
    assert len(noisy) == 1 and 1.1 < noisy[0].value_spread < 1.5
    main(list(library.paths))
    assert "metal       1   0.00 0.00 0.00    0.00-1.00    0.30 0.30 0.30" in capsys.readouterr().out
    with pytest.raises(InputError, match="no such folder"):
        main([Path("/nowhere")])
