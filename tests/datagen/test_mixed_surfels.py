# SPDX-License-Identifier: MIT
"""Surfels of things thinner than a pixel: slats of a blind before a bright sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from datagen.light.background import photographed_background
from datagen.light.emitters import photographed_emitters
from datagen.light.lighting import bounded
from datagen.light.radiance_field import RadianceField, unmixed_cells
from datagen.light.surfels import Surfels, build_surfels

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
WALL, SLAT, SKY = 0.2, 0.05, 20.0
"""Radiance of the room's surfaces, of the slats and of the sky."""
NUM_SLATS, SPACING_M, SLAT_M = 9, 0.11, 0.02
SUBPIXELS = 6
NUM_WALL_FACES = 10


def _geometry() -> CaptureGeometry:
    """A room of 4 x 4.5 x 2.5 m that is open at y = 2 m, and slats along x there, 2 cm high and 11 cm apart:
    no two adjacent pixels show different ones.
    """
    x, y, low, z = 2, 2, -2.5, 2.5
    corners = [
        [(-x, low, 0), (x, low, 0), (x, y, 0), (-x, y, 0)],
        [(-x, low, z), (-x, y, z), (x, y, z), (x, low, z)],
        [(-x, low, 0), (-x, low, z), (x, low, z), (x, low, 0)],
        [(-x, low, 0), (-x, y, 0), (-x, y, z), (-x, low, z)],
        [(x, low, 0), (x, low, z), (x, y, z), (x, y, 0)],
    ]
    for k in range(NUM_SLATS):
        height = 1.0 + SPACING_M * k
        top = height + SLAT_M
        corners.append([(-1, y, height), (1, y, height), (1, y, top), (-1, y, top)])
    positions = np.array(corners, np.float32).reshape(-1, 3)
    faces = [[4 * k + i for i in c] for k in range(len(corners)) for c in ((0, 1, 2), (0, 2, 3))]
    parts = (GeometryPart("room", 0, len(faces), None),)
    return CaptureGeometry(Mesh(positions, np.array(faces, np.int32), None, None), parts)


def _photographed(traced: TracedGeometry) -> tuple[TracedView, ...]:
    """Photographs whose pixels are the mean of all that they show."""
    views = []
    toward_slats = [((x, -1.5, 0.5), (0.0, 2.0, 0.9)) for x in (-0.6, 0.0, 0.6)]
    into_room = [((0.0, 1.8, 1.5), (x, y, 1.0)) for x, y in ((0.0, -2.0), (-2.0, 0.0), (2.0, 0.0))]
    for eye, target in toward_slats + into_room:
        matrix = look_at(np.array(eye), np.array(target))
        camera = Camera(64, 48, 48.0, 48.0, 32.0, 24.0, matrix)
        n = SUBPIXELS
        fine = Camera(64 * n, 48 * n, 48.0 * n, 48.0 * n, 32.0 * n, 24.0 * n, matrix)
        face = traced.trace_view(fine).face.reshape(48 * n, 64 * n)
        radiance = np.where(face < 0, SKY, np.where(face < NUM_WALL_FACES, WALL, SLAT))
        mean = radiance.reshape(48, n, 64, n).mean(axis=(1, 3))
        color = np.repeat(mean[..., None], 3, axis=2).astype(np.float32)
        views.append(TracedView(camera, color, traced.trace_view(camera), np.ones((48, 64), bool)))
    return tuple(views)


@pytest.fixture(scope="module")
def traced(mitsuba_variant: str) -> TracedGeometry:
    return TracedGeometry(_geometry())


@pytest.fixture(scope="module")
def views(traced: TracedGeometry) -> tuple[TracedView, ...]:
    return _photographed(traced)


def _field(views: tuple[TracedView, ...], traced: TracedGeometry, surfels: Surfels) -> RadianceField:
    """The radiance field without mixed surfels."""
    nothing_emits = np.zeros(NUM_WALL_FACES + 2 * NUM_SLATS, bool)
    regions = np.zeros(len(nothing_emits), np.int32)
    emitters = photographed_emitters(views, traced.mesh, nothing_emits, regions)
    grid = surfels.grid
    background = photographed_background(views, grid.low, grid.low + grid.cell_m * grid.shape)
    return RadianceField(traced.scene, surfels, emitters, background, unmixed_cells(surfels))


def test_slats_are_mixed_and_walls_are_not(views: tuple[TracedView, ...]) -> None:
    surfels = build_surfels(views)
    is_slat = surfels.face >= NUM_WALL_FACES
    assert is_slat.sum() > 50
    assert surfels.is_mixed[is_slat].all()
    assert surfels.is_mixed[surfels.position_m[:, 1] < 1.5].mean() < 0.02


def test_slats_do_not_shine_like_the_sky_behind_them(
    views: tuple[TracedView, ...], traced: TracedGeometry
) -> None:
    """Their photographs show mostly sky; the light that reaches them from the room bounds their radiance."""
    surfels = build_surfels(views)
    is_slat = surfels.face >= NUM_WALL_FACES
    assert np.median(surfels.radiance[is_slat]) > 50 * SLAT
    radiance = bounded(surfels, _field(views, traced, surfels)).radiance
    assert np.quantile(radiance[is_slat], 0.9) < 1.1 * WALL
    np.testing.assert_array_equal(radiance[~surfels.is_mixed], surfels.radiance[~surfels.is_mixed])


def test_mixed_surfels_in_unknown_light_keep_their_radiance(
    views: tuple[TracedView, ...], traced: TracedGeometry
) -> None:
    """Photographs of the slats alone show little of what illuminates them."""
    toward_slats = views[:3]
    surfels = build_surfels(toward_slats)
    is_slat = surfels.face >= NUM_WALL_FACES
    radiance = bounded(surfels, _field(toward_slats, traced, surfels)).radiance
    assert np.median(radiance[is_slat] / surfels.radiance[is_slat]) > 0.5


def test_mixed_surfels_of_possible_radiance_keep_it(
    views: tuple[TracedView, ...], traced: TracedGeometry
) -> None:
    """Thin dark things before bright ones shine no more than they can; what is mixed and dark stays."""
    surfels = build_surfels(views)
    is_slat = surfels.face >= NUM_WALL_FACES
    dark = surfels.radiance.copy()
    dark[is_slat] = SLAT
    surfels = replace(surfels, radiance=dark)
    radiance = bounded(surfels, _field(views, traced, surfels)).radiance
    np.testing.assert_array_equal(radiance[is_slat], dark[is_slat])
