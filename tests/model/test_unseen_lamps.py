# SPDX-License-Identifier: MIT
"""Lamps that are named parts of the geometry but in no photograph."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import smooth_regions
from datagen.geometry.views import TracedView
from datagen.light.emitters import Emitters
from datagen.light.lighting import Lit
from model.reconstruction.light import confidence, stage
from model.reconstruction.light.stage import LightMaterials
from model.reconstruction.light.unseen_lamps import UnseenLamps, lamp_kinds
from tests.model.light_room import LAMP, photographed_room, quads, without_pixels
from tests.model.test_light_room import ONE_ROUND, of_quad, predicted, solved, wall_error

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def without_lamp() -> tuple[TracedView, ...]:
    """The photographs of the room without the pixels of its lamp."""
    lamp = [quad.name for quad in quads()].index("lamp")
    return tuple(without_pixels(view, view.geometry.face // 2 == lamp) for view in photographed_room())


@lru_cache(maxsize=1)
def room() -> LightMaterials:
    return solved(without_lamp(), predicted(without_lamp()), options=ONE_ROUND)


def test_radiance_follows_from_the_surrounding_surfaces() -> None:
    """The lamp's radiance is within 8 %, with a network that predicts the same grey for all surfaces."""
    (found,) = room().lit.baker.field.emitters.radiance
    np.testing.assert_allclose(found, LAMP, rtol=0.08)


def test_albedo_in_the_light_of_an_unseen_lamp_is_found() -> None:
    """D of the walls is within 8 %; with a photographed lamp it is within 3.5 %."""
    assert wall_error(room()) < 0.08


def test_network_replaces_materials_where_estimated_light_prevails(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lamp that provides 40 % of the light reduces no confidence; above the range :data:`INFERRED_LIGHT`,
    confidence is 0. Metals reflect photographed light and are still found.
    """
    assert room().solved.replaced.max() > 0.9 and room().solved.confidence[:, 1:].max() > 0.9
    monkeypatch.setattr(confidence, "INFERRED_LIGHT", (0.1, 0.3))
    found = solved(without_lamp(), predicted(without_lamp()), options=ONE_ROUND)
    weights = np.column_stack([found.solved.replaced, found.solved.confidence])
    assert weights[~found.solved.is_metal].max() == 0
    metal = of_quad(found, "metal")
    np.testing.assert_allclose(np.median(weights[metal], axis=0), 0.85, atol=0.02)
    found_s = np.median(found.solved.specular_albedo[metal], axis=0)
    np.testing.assert_allclose(found_s, (0.9, 0.65, 0.35), atol=0.03)


def test_a_lamp_treated_as_dark_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Injected fault for the tests of radiance and albedo."""

    def dark(lit: Lit, *_: object) -> UnseenLamps:
        return UnseenLamps(lit.baker.field.emitters)

    monkeypatch.setattr(stage, "unseen_lamps", dark)
    found = solved(without_lamp(), predicted(without_lamp()), options=ONE_ROUND)
    assert not found.lit.baker.field.emitters.radiance.any()
    assert wall_error(found) > 0.3
    assert found.solved.confidence[:, 0].max() > 0.5


def test_order_of_views_changes_nothing() -> None:
    views = without_lamp()
    order = np.random.default_rng(3).permutation(len(views))
    shuffled = solved(tuple(views[index] for index in order), predicted(views), options=ONE_ROUND)
    for place, index in enumerate(order):
        for name, values in room().maps[index].items():
            assert values.tobytes() == shuffled.maps[place][name].tobytes()


def boxes(sides: list[float]) -> Mesh:
    """Cubes with the given sides in a row."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    quad = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    face = quad[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    positions = [side * corner + np.array([10 * k, 0, 0], np.float32) for k, side in enumerate(sides)]
    faces = [face + 8 * k for k in range(len(sides))]
    return Mesh(np.concatenate(positions), np.concatenate(faces).astype(np.int32))


def kinds_of(sides: list[float], shown: dict[int, float]) -> tuple[NDArray, NDArray]:
    """Kind and radiance of each cube; ``shown`` has the radiance of one side of each photographed cube."""
    mesh = boxes(sides)
    every = np.arange(len(mesh.faces), dtype=np.int32)
    region = smooth_regions(mesh)
    assert region.max() + 1 == 6 * len(sides)
    radiance = np.zeros((region.max() + 1, 3), np.float32)
    for cube, value in shown.items():
        radiance[region[12 * cube]] = value
    corners = mesh.triangles().astype(np.float32)
    none = np.zeros(len(every), np.float32)
    emitters = Emitters(region, radiance, none + 1, every, corners, none)
    kind, found = lamp_kinds(emitters, mesh)
    first = region[::12]
    return kind[first], found[first, 0]


def test_all_sides_of_a_lamp_have_the_same_radiance() -> None:
    kind, radiance = kinds_of([1.0, 2.0], {0: 5.0, 1: 3.0})
    np.testing.assert_array_equal(kind, -1)
    np.testing.assert_allclose(radiance, [5, 3])


def test_a_lamp_has_the_radiance_of_similar_lamps() -> None:
    """A lamp gets the mean of photographed ones of its size; other kinds have an unknown radiance."""
    kind, radiance = kinds_of([1.0, 2.0, 1.0, 1.0, 2.0, 3.0], {0: 4.0, 2: 6.0})
    np.testing.assert_allclose(radiance, [4, 0, 6, 5, 0, 0])
    np.testing.assert_array_equal(kind, [-1, 0, -1, -1, 0, 1])
