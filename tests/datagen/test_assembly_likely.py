# SPDX-License-Identifier: MIT
"""Configurations with likely materials, which suit the kind of surface and share the style of the room."""

from __future__ import annotations

import ast
import colorsys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import pytest
from pydantic import ValidationError

from datagen.assembly.geometry import load_geometry
from datagen.assembly.likely import LikelyMaterials, reach
from datagen.assembly.looks import LOOKS, Look, RoomStyle
from datagen.assembly.materials import MeanMaterial, MeanMaterials, adjusted, mean_materials
from datagen.assembly.plan import assemble
from datagen.assembly.surface_statistics import main, sample_surfaces, weighted_median
from datagen.assembly.surfaces import surface_of_words, surfaces_of
from datagen.formats.asset import SURFACES, EnvironmentAsset, Material, MaterialAsset, ObjectAsset, Surface
from datagen.formats.configuration import MaterialAssignment, PlacedAsset
from datagen.formats.package import Package
from datagen.formats.recipe import MaterialRecipe, Recipe, Variation
from datagen.foundation.errors import InputError
from datagen.foundation.random import Draws
from datagen.library import Library, bundled_library
from tests.conftest import REPOSITORY
from tests.datagen.small_library import write_small_library

ROOMS = ("bathroom", "dining_room", "kitchen", "living_room", "study")
ALWAYS = MaterialRecipe(replace_probability=1.0, vary_probability=1.0)
MEANS = MeanMaterials()


@lru_cache(maxsize=1)
def library() -> Library:
    return Library([bundled_library()])


@lru_cache(maxsize=8)
def surfaces(name: str) -> dict[str, Surface]:
    return surfaces_of(load_geometry(library().package(name)))


def choices(name: str, seed: int, recipe: MaterialRecipe = ALWAYS) -> dict[str, MaterialAssignment]:
    likely = LikelyMaterials(RoomStyle.draw(Draws(seed)), library().select("material"), recipe, MEANS)
    return likely.assign(library().package(name), surfaces(name), Draws(seed, "dress"))


def assigned(name: str, seed: int) -> dict[str, MeanMaterial]:
    return mean_materials(PlacedAsset(name="x", asset=name, materials=choices(name, seed)), library(), MEANS)


def hsv(mean: MeanMaterial) -> tuple[float, float, float]:
    return colorsys.rgb_to_hsv(*mean.diffuse_albedo)


@pytest.mark.parametrize("name", ROOMS)
def test_surfaces_get_materials_of_their_kind(name: str) -> None:
    for seed in range(12):
        means = assigned(name, seed)
        for slot, assignment in choices(name, seed).items():
            surface = surfaces(name)[slot]
            if assignment.asset is None:
                continue
            material = library().package(assignment.asset).asset
            assert isinstance(material, MaterialAsset)
            assert not material.surfaces or surface in material.surfaces, (slot, assignment.asset)
            _, saturation, value = hsv(means[slot])
            place = (name, seed, slot, assignment.asset)
            if surface == "ceiling":
                assert value > 0.55 and saturation < 0.2, place
            if surface == "radiator":
                assert max(means[slot].specular_albedo) < 0.25, place  # never a metal
            if surface in ("joinery", "furniture", "tabletop"):
                assert not 0.68 < hsv(means[slot])[0] < 0.9 or saturation < 0.4, place  # never violet
            if surface == "fitting":
                assert value < 0.1, place


def test_a_room_has_one_style() -> None:
    tones = set()
    for seed in range(20):
        found, means = choices("kitchen", seed), assigned("kitchen", seed)
        metals = {
            colorsys.rgb_to_hsv(*means[slot].specular_albedo)[1] > 0.25
            for slot in ("hardware", "knobs")
            if slot in found and max(means[slot].specular_albedo) > 0.3
        }
        assert len(metals) <= 1, "brass beside steel"
        tones |= metals
    assert tones == {True, False}


def test_wood_has_the_tone_of_its_room() -> None:
    """All wood of a room has one tone; pale, saturated, dark and bright tones occur."""
    seen = []
    for seed in range(40):
        style, means = RoomStyle.draw(Draws(seed)), assigned("dining_room", seed)
        for slot, assignment in choices("dining_room", seed).items():
            if surfaces("dining_room")[slot] not in ("furniture", "tabletop") or assignment.asset is None:
                continue
            if library().package(assignment.asset).asset.material.classes[0] != "wood":  # type: ignore[union-attr]
                continue
            for value, (low, high) in zip(
                hsv(means[slot]), (style.wood.hue, style.wood.saturation, style.wood.value), strict=True
            ):
                assert low - 0.01 < value < high + 0.01, (seed, slot, assignment)
            seen.append(hsv(means[slot]))
    _, saturation, value = zip(*seen, strict=True)
    assert min(saturation) < 0.4 and max(saturation) > 0.65 and min(value) < 0.12 and max(value) > 0.55


def test_wallpaper_is_printed_in_the_accent() -> None:
    """Printed wallpaper takes the accent hue of the style; unprinted paper cannot."""
    style = RoomStyle.draw(Draws(1))
    (wallpaper,) = (look for look in LOOKS["wall"] if look.material_class == "paper")
    package = library().package("wallpaper_leaf")
    assert isinstance(package.asset, MaterialAsset)
    mean = MEANS.mean(package, package.asset.material)
    for hue in (0.05, 0.35, 0.6):
        look = wallpaper.in_style(replace(style, accent_hue=hue))
        assert look is not None
        found = reach(look, package.asset.material, mean)
        assert found is not None
        shown = hsv(adjusted(mean, found.at(Draws(hue > 0.3).units(4), 1.0)))
        assert abs((shown[0] - hue + 0.5) % 1 - 0.5) < 0.031
        if hue > 0.3:
            assert reach(replace(look, is_printed=False), package.asset.material, mean) is None


def test_likely_configurations_follow_the_weight_and_others_stay(tmp_path: Path) -> None:
    small = Library([write_small_library(tmp_path)])
    plain = Recipe(name="few", configurations=12, views=2, resolution=(32, 24), objects={"count": (1, 2)})  # type: ignore[arg-type]
    wild = plain.model_copy(update={"materials": MaterialRecipe(variation=Variation(wild=1.0))})
    both = plain.model_copy(update={"materials": MaterialRecipe(variation=Variation(likely=0.5, wild=0.5))})
    changed = 0
    for index in range(12):
        old, new = assemble(plain, index, small), assemble(both, index, small)
        if index < 3:
            assert assemble(wild, index, small) == old
            assert assemble(both, index, small) == new
        assert [t.world_from_asset for t in new.objects] == [t.world_from_asset for t in old.objects]
        changed += new.environment.materials != old.environment.materials
    assert 2 <= changed <= 10


def test_weights_must_not_all_be_zero() -> None:
    with pytest.raises(ValidationError, match="positive weight"):
        Variation()


def test_kept_materials_are_hardly_varied() -> None:
    never = MaterialRecipe(replace_probability=0.0, vary_probability=1.0)
    for seed in range(8):
        for slot, assignment in choices("living_room", seed, never).items():
            assert assignment.asset is None
            change = assignment.adjustment
            assert change.hue_shift == 0, slot
            assert 1 / 1.16 < change.value_scale < 1.16 and abs(change.roughness_offset) <= 0.05
    still = never.model_copy(update={"vary_probability": 0.0})
    assert choices("living_room", 1, still) == {}


def test_adjusted_materials_stay_within_the_look() -> None:
    look = Look(1.0, "painted", (0.3, 0.4), (0.2, 0.3), (0.4, 0.5), hue=(0.55, 0.6))
    tint = Material(classes=("painted",), diffuse_albedo=(0.6, 0.5, 0.45), roughness=0.6)
    mean = MeanMaterial((0.6, 0.5, 0.45), (0.04, 0.04, 0.04), 0.6)
    found = reach(look, tint, mean)
    assert found is not None
    for seed in range(20):
        after = adjusted(mean, found.at(Draws(seed).units(4), 1.0))
        hue, saturation, value = hsv(after)
        assert 0.549 < hue < 0.601 and 0.199 < saturation < 0.301 and 0.299 < value < 0.401
        assert 0.399 < after.roughness < 0.501
    assert reach(look, tint.model_copy(update={"roughness": 0.95}), MeanMaterial(
        mean.diffuse_albedo, mean.specular_albedo, 0.95)) is None  # fmt: skip
    oak = Material(classes=("wood",), diffuse_albedo=(0.6, 0.5, 0.45), roughness=0.5)
    assert reach(Look(1.0, "wood", hue=(0.55, 0.6)), oak, mean) is None, "no blue wood"


@pytest.mark.parametrize(
    ("name", "surface"),
    [
        ("FloorTiles", "floor"), ("tile_edge", "tiles"), ("sofa_legs", "legs"), ("upper units", "furniture"),
        ("Wall.001", "wall"), ("WindowFrame", "joinery"), ("lamp_shade", "shade"), ("Material.004", None),
    ],
)  # fmt: skip
def test_names_determine_a_surface(name: str, surface: str | None) -> None:
    assert surface_of_words(name) == surface


def nameless(package: Package) -> EnvironmentAsset:
    """Return the room with its slots renamed to m0, m1 etc. and its parts to p0, p1 etc."""
    asset = package.asset
    assert isinstance(asset, EnvironmentAsset)
    slots = {slot: f"m{k}" for k, slot in enumerate(asset.materials)}
    return asset.model_copy(
        update={
            "materials": {slots[slot]: material for slot, material in asset.materials.items()},
            "parts": tuple(
                part.model_copy(update={"name": f"p{k}", "material": slots[part.material]})
                for k, part in enumerate(asset.parts)
            ),
        }
    )


def test_shape_and_class_determine_surfaces_without_names(tmp_path: Path) -> None:
    package = Library([write_small_library(tmp_path)]).package("room-0")
    names = list(package.asset.materials)  # type: ignore[union-attr]
    package.asset = nameless(package)
    found = dict(zip(names, surfaces_of(load_geometry(package)).values(), strict=True))
    assert (found["floor"], found["ceiling"], found["walls"]) == ("floor", "ceiling", "wall")
    known = package.asset.materials["m0"].model_copy(update={"surface": "worktop"})
    package.asset = package.asset.model_copy(update={"materials": {**package.asset.materials, "m0": known}})
    assert surfaces_of(load_geometry(package))["m0"] == "worktop"


def test_every_slot_of_the_library_has_a_surface() -> None:
    for package in library():
        if isinstance(package.asset, ObjectAsset):
            assert set(surfaces_of(load_geometry(package)).values()) <= set(SURFACES)
    assert set(LOOKS) == set(SURFACES) - {"small"}


def test_every_look_has_a_material() -> None:
    styles = [RoomStyle.draw(Draws(seed)) for seed in range(40)]
    materials = [p.asset for p in library().select("material")]
    means = {p.id: MEANS.mean(p, p.asset.material) for p in library().select("material")}  # type: ignore[union-attr]
    for surface, looks in LOOKS.items():
        for look in looks:
            styled = [s for style in styles if (s := look.in_style(style)) is not None]
            served = any(
                reach(s, m.material, means[m.id]) is not None
                for s in styled
                for m in materials
                if isinstance(m, MaterialAsset)
                and m.material.classes[0] == look.material_class
                and (not m.surfaces or surface in m.surfaces)
            )
            assert served, (surface, look)


def test_the_extension_has_the_same_surfaces() -> None:
    tree = ast.parse((REPOSITORY / "blender_addon/gather/tags.py").read_text())
    constants = {
        node.targets[0].id: ast.literal_eval(node.value)  # type: ignore[attr-defined]
        for node in tree.body
        if isinstance(node, ast.Assign) and node.targets[0].id == "SURFACES"  # type: ignore[attr-defined]
    }
    assert constants["SURFACES"] == SURFACES


def test_statistics_of_surfaces(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    root = write_small_library(tmp_path)
    samples = sample_surfaces(Library([root]))
    assert len(samples["floor"]) == len(samples["ceiling"]) == 1
    assert samples["ceiling"][0].area_m2 > 20
    assert weighted_median([3.0, 1.0, float("nan")], [1.0, 2.0, 9.0]) == 1.0
    main([root])
    assert "| floor | 1 |" in capsys.readouterr().out
    with pytest.raises(InputError):
        main([tmp_path / "nowhere"])
