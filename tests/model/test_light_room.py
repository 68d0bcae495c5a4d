# SPDX-License-Identifier: MIT
"""Materials from light in a room whose materials and light are known."""

from __future__ import annotations

import copyreg
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.geometry.traced import TracedGeometry, smooth_regions
from datagen.geometry.views import TracedView
from datagen.light import estimated_light
from datagen.light.bake import Baker
from datagen.light.lighting import light_surfels
from datagen.light.radiance_field import RadianceField
from model.reconstruction.light.confidence import trust_in_hidden
from model.reconstruction.light.options import LightOptions
from model.reconstruction.light.solve import MAX_ALBEDO
from model.reconstruction.light.stage import LightMaterials, materials_from_light, surfel_albedo
from model.reconstruction.light.view_maps import view_materials
from model.reconstruction.stages import DoubtAt
from tests.model.light_room import (
    LAMP,
    SIDES,
    SKY,
    photographed_room,
    quads,
    room_geometry,
    sunlit_room,
    without_pixels,
)
from tests.once import once

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
EXPOSURE = 0.5
ONE_ROUND = LightOptions(num_rounds=1)
"""Without reflections at metals and with more noise, for tests whose results depend on neither."""
WALLS = ("west", "south", "north", "ceiling", "east-low")


def predicted(
    views: tuple[TracedView, ...], diffuse: float = 0.35, specular: float = 0.03, roughness: float = 0.7
) -> list[dict[str, NDArray]]:
    """Constant prediction of an uninformed network: one grey, faintly glossy material."""
    height, width = views[0].color.shape[:2]
    maps = {
        "diffuse_albedo": np.full((height, width, 3), diffuse, np.float16),
        "specular_albedo": np.full((height, width, 3), specular, np.float16),
        "roughness": np.full((height, width, 1), roughness, np.float16),
    }
    return [dict(maps) for _ in views]


def solved(
    views: tuple[TracedView, ...],
    maps: list[dict[str, NDArray]],
    exposure: float = EXPOSURE,
    doubt_at: DoubtAt | None = None,
    options: LightOptions = LightOptions(),
) -> LightMaterials:
    geometry = room_geometry()
    traced = TracedGeometry(geometry)
    regions, emits = smooth_regions(traced.mesh), geometry.emitter_mask()
    return materials_from_light(views, maps, traced, emits, regions, exposure, options, doubt_at)


def _field(*parts: Any) -> RadianceField:
    return RadianceField(TracedGeometry(room_geometry()).scene, *parts)


def _parts_of_field(field: RadianceField) -> tuple[Callable[..., RadianceField], tuple[Any, ...]]:
    return _field, (field.cells, field.emitters, field.background, field.metals, field.outer)


def _parts_of_baker(baker: Baker) -> tuple[type[Baker], tuple[Any, ...]]:
    return Baker, (baker.field, baker.size_m)


# Results of the room are shared among test processes by `once`, without the scene, which is not picklable.
copyreg.pickle(RadianceField, _parts_of_field)
copyreg.pickle(Baker, _parts_of_baker)


@lru_cache(maxsize=1)
def room() -> LightMaterials:
    return once("light-room-solved", lambda: solved(photographed_room(), predicted(photographed_room())))


@lru_cache(maxsize=1)
def sunlit() -> LightMaterials:
    return once("light-room-sun-solved", lambda: solved(sunlit_room(), predicted(sunlit_room())))


def of_quad(found: LightMaterials, name: str) -> NDArray[np.bool_]:
    """Mask (N,) of the surfels of a quad."""
    number = [quad.name for quad in quads()].index(name)
    return found.lit.surfels.face // 2 == number


def median_albedo(found: LightMaterials, name: str) -> NDArray[np.float64]:
    return np.median(found.albedo[of_quad(found, name)], axis=0)


def wall_error(found: LightMaterials) -> float:
    """Largest relative error of a wall's median diffuse albedo in any channel."""
    true = {quad.name: np.array(quad.diffuse) for quad in quads()}
    return max(float(np.abs(median_albedo(found, name) / true[name] - 1).max()) for name in WALLS)


def test_light_of_lamp_and_sky_is_found() -> None:
    """Radiance of lamp and sky is within 5 %, although neither is an input."""
    field = room().lit.baker.field
    np.testing.assert_allclose(field.emitters.radiance, [LAMP], rtol=0.05)
    sky = field.background.radiance[field.background.is_photographed]
    np.testing.assert_allclose(np.median(sky, axis=0), SKY, rtol=0.05)


def test_uncertain_light_leaves_the_networks_materials() -> None:
    """D is still bounded by the light that the surface reflects, at up to a tenth of the pixels."""
    maps = predicted(photographed_room())
    found = solved(
        photographed_room(),
        maps,
        doubt_at=lambda position_m, normal: np.full(len(normal), 99.0),
        options=ONE_ROUND,
    )
    for name, value in maps[0].items():
        differs = np.abs(np.stack([view[name] for view in found.maps]) - value[0, 0, 0]) > 1e-3
        assert differs.mean() < (0.1 if name == "diffuse_albedo" else 1e-9), name


def test_diffuse_albedo_of_coloured_walls_is_found() -> None:
    """D is within 3 %; the error compensates a specular albedo of 0.01, which is within the noise."""
    assert wall_error(room()) < 0.03


def test_tiles_of_a_floor_keep_their_pattern() -> None:
    tiles = [quad for quad in quads() if quad.name.startswith("tile")]
    found = np.array([median_albedo(room(), tile.name) for tile in tiles])
    true = np.array([tile.diffuse for tile in tiles])
    np.testing.assert_allclose(np.median(found / true, axis=0), 1.0, atol=0.03)
    assert np.quantile(np.abs(found - true), 0.9) < 0.03


def test_glossy_panel_is_found() -> None:
    panel = of_quad(room(), "glossy")
    assert np.abs(np.median(room().solved.specular_albedo[panel]) - 0.04) < 0.03
    assert np.abs(np.median(room().solved.roughness[panel]) - 0.25) < 0.08
    np.testing.assert_allclose(median_albedo(room(), "glossy"), [0.15, 0.2, 0.4], atol=0.03)


@pytest.mark.parametrize(("name", "tolerance"), [("metal", 0.03), ("mirror", 0.03)])
def test_metal_has_its_colour_and_no_diffuse_part(name: str, tolerance: float) -> None:
    """Metal is distinguished from dark paint by its view-dependent radiance, without a prediction."""
    (quad,) = (quad for quad in quads() if quad.name == name)
    panel = of_quad(room(), name)
    assert room().solved.is_metal[panel].mean() > 0.6
    found = np.median(room().solved.specular_albedo[panel], axis=0)
    np.testing.assert_allclose(found, quad.specular, atol=tolerance)
    assert np.abs(np.median(room().solved.roughness[panel]) - quad.roughness) < 0.08
    assert median_albedo(room(), name).max() == 0


def test_exposure_changes_nothing() -> None:
    """Photographs at a quarter of the exposure give the same materials."""
    views = tuple(replace(view, color=view.color * np.float32(0.25)) for view in photographed_room())
    darker = solved(views, predicted(views), exposure=4 * EXPOSURE)
    np.testing.assert_allclose(darker.albedo, room().albedo, atol=2e-3)
    np.testing.assert_array_equal(darker.solved.is_metal, room().solved.is_metal)


def test_order_of_views_changes_nothing() -> None:
    views = photographed_room()
    order = np.random.default_rng(3).permutation(len(views))
    shuffled = solved(tuple(views[index] for index in order), predicted(views))
    for place, index in enumerate(order):
        for name, values in room().maps[index].items():
            assert values.tobytes() == shuffled.maps[place][name].tobytes()


def test_predicted_diffuse_albedo_is_ignored_where_light_is_known() -> None:
    other = solved(photographed_room(), predicted(photographed_room(), diffuse=0.7))
    for name in WALLS:
        np.testing.assert_allclose(median_albedo(other, name), median_albedo(room(), name), rtol=0.03)


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_a_five_per_cent_irradiance_error_is_detected(factor: float) -> None:
    """Injected fault for the test of coloured walls."""
    found = room()
    wrong = surfel_albedo(
        found.lit.surfels,
        found.lit.diffuse * np.float32(factor),
        found.solved.specular,
        found.solved.specular_albedo,
        found.solved.is_metal,
    )
    assert wall_error(replace(found, albedo=wrong)) > 0.045


@pytest.mark.parametrize("name", ["west", "south", "north", "east-low", "glossy"])
def test_energy_is_conserved(name: str) -> None:
    """Where all light is photographed no surface reflects more than arrives, up to noise."""
    found = room()
    seen = (found.lit.irradiance.photographed > 0.98) & of_quad(found, name)
    reflected = found.lit.surfels.radiance[seen] / found.lit.diffuse[seen]
    assert seen.sum() > 300
    assert (reflected.max(axis=1) > 1).mean() < 0.01


SEEN_FROM_M = 1.3
"""Smallest x in photographs of :func:`cropped_room`, in which a third of the room is unseen."""


def without(axis: int, low_m: float, high_m: float) -> tuple[TracedView, ...]:
    """The photographs without pixels whose surface is between ``low_m`` and ``high_m`` along ``axis``."""
    views = []
    for view in photographed_room():
        depth = view.geometry.depth_z_m[..., 0]
        way = view.camera.ray_directions()
        to_plane = way @ view.camera.world_from_camera[:3, 2]
        at = view.camera.position_m[axis] + way[..., axis] * depth / to_plane
        hidden = (at > low_m) & (at < high_m) & (view.geometry.face >= 0)
        views.append(without_pixels(view, hidden))
    return tuple(views)


@lru_cache(maxsize=1)
def cropped_room() -> LightMaterials:
    views = without(0, -np.inf, SEEN_FROM_M)
    return solved(views, predicted(views))


def test_surface_in_uncertain_light_is_no_whiter_than_paint() -> None:
    packed = [
        np.dstack([m["diffuse_albedo"].max(axis=2), m["confidence"][..., 0]]) for m in cropped_room().maps
    ]
    albedo, confidence = np.concatenate([maps.reshape(-1, 2) for maps in packed]).astype(np.float64).T
    white, known = cropped_room().solved.white
    assert white == pytest.approx(0.8, abs=0.02) and known > 0.5  # of the ceiling
    assert (albedo <= white + (MAX_ALBEDO - white) * confidence + 2e-3).all()
    unsure = confidence < 0.5
    assert np.isclose(albedo[unsure], white + (MAX_ALBEDO - white) * confidence[unsure], atol=2e-3).any()


def test_light_of_an_unseen_lamp_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the ceiling and its lamp, surfaces are much too bright for their light (median hidden share
    above 0.05); without the west wall, none is (all below 0.04)."""
    monkeypatch.setattr(estimated_light, "HIDDEN_GAIN", 3.0)
    geometry = room_geometry()
    traced = TracedGeometry(geometry)
    regions = smooth_regions(traced.mesh)
    without_ceiling = without(2, float(SIDES[2]) - 0.1, np.inf)
    nothing_emits = np.zeros_like(geometry.emitter_mask())
    lit = light_surfels(without_ceiling, traced, nothing_emits, regions, LightOptions())
    median, most = float(np.median(lit.hidden)), float(cropped_room().lit.hidden.max())
    assert median > 0.05
    assert most < 0.04


def test_confidence_falls_with_the_share_of_hidden_light() -> None:
    """Confidence falls earlier for sources at unknown positions than for lamps that the geometry declares."""
    hidden, none = np.array([0.0, 0.25, 0.325, 0.4, 1.0]), np.zeros(5)
    np.testing.assert_allclose(trust_in_hidden(hidden, none), [1, 1, 0.5, 0, 0], atol=1e-6)
    declared = np.array([0.0, 0.4, 0.7, 1.0, 1.0])
    np.testing.assert_allclose(trust_in_hidden(none, declared), [1, 1, 0.5, 0, 0], atol=1e-6)


def test_unseen_surface_reflects_light() -> None:
    """The west wall is outside of the bounding box of all photographed points, but its light is estimated."""
    found = cropped_room()
    assert found.lit.surfels.grid.low[0] > 0.5
    assert not of_quad(found, "west").any()
    assert found.lit.irradiance.photographed.mean() < 0.85
    assert found.lit.irradiance.known.mean() > 0.99


def test_albedo_is_found_with_a_third_of_the_room_unseen() -> None:
    """The error is due to the colour of the unseen wall, which is assumed to be that of the room."""
    found = cropped_room()
    for quad in quads():
        if quad.name in ("south", "north", "ceiling", "east-low"):
            np.testing.assert_allclose(median_albedo(found, quad.name), quad.diffuse, rtol=0.04)


@pytest.mark.parametrize(("roughness", "shows_detail"), [(0.5, True), (0.1, False)])
def test_rough_metal_has_the_detail_of_the_photograph(roughness: float, shows_detail: bool) -> None:
    """Pixels that differ by a fifth from their surfels keep this detail on rough metal, not on smooth
    metal."""
    view, surfels, found = photographed_room()[0], room().lit.surfels, room().solved
    ones = np.ones((len(surfels), 3), np.float32)
    metal = replace(
        found,
        specular_albedo=0.5 * ones,
        roughness=roughness * ones[:, 0],
        is_metal=ones[:, 0] > 0,
        confidence=ones,
    )
    row, column = np.indices(view.color.shape[:2])
    pattern = np.where((row + column) % 2, 1.2, 0.8)[..., None].astype(np.float32)
    plain, detailed = (
        view_materials(surfels, metal, 0, seen, predicted((view,))[0])["specular_albedo"].astype(np.float64)
        for seen in (view, replace(view, color=view.color * pattern))
    )
    is_metal = (np.abs(plain - 0.5) < 0.3).all(axis=2) & (view.geometry.depth_z_m[..., 0] > 0)
    assert is_metal.mean() > 0.3
    expected = np.broadcast_to(pattern if shows_detail else 1.0, plain.shape)
    np.testing.assert_allclose((detailed / plain)[is_metal], expected[is_metal], rtol=4e-3)
