# SPDX-License-Identifier: MIT
"""Surfels thinner than a pixel: slats of a blind before a bright sky, above a floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from datagen.light.background import photographed_background
from datagen.light.emitters import photographed_emitters
from datagen.light.radiance_field import RadianceField
from datagen.light.surfels import Surfels, build_surfels

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
FLOOR, SLAT, SKY = 0.2, 0.05, 20.0
NUM_SLATS, SPACING_M, SLAT_M = 9, 0.11, 0.02
SUBPIXELS = 6


def _geometry() -> CaptureGeometry:
    """A floor of 4 x 4 m (faces 0 and 1), and slats along x at y = 2 m, 2 cm high and 11 cm apart:
    no two adjacent pixels show different ones."""
    low = [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)]
    corners = [low]
    for k in range(NUM_SLATS):
        z = 1.0 + SPACING_M * k
        corners.append([(-1, 2, z), (1, 2, z), (1, 2, z + SLAT_M), (-1, 2, z + SLAT_M)])
    positions = np.array(corners, np.float32).reshape(-1, 3)
    faces = [[4 * k + i for i in c] for k in range(len(corners)) for c in ((0, 1, 2), (0, 2, 3))]
    parts = (GeometryPart("room", 0, len(faces), None),)
    return CaptureGeometry(Mesh(positions, np.array(faces, np.int32), None, None), parts)


def _photographed(traced: TracedGeometry) -> tuple[TracedView, ...]:
    """Photographs whose pixels are the mean of all that they show."""
    views = []
    for x in (-0.6, 0.0, 0.6):
        eye = np.array([x, -1.5, 0.5])
        matrix = look_at(eye, np.array([0.0, 2.0, 0.9]))
        camera = Camera(64, 48, 48.0, 48.0, 32.0, 24.0, matrix)
        n = SUBPIXELS
        fine = Camera(64 * n, 48 * n, 48.0 * n, 48.0 * n, 32.0 * n, 24.0 * n, matrix)
        face = traced.trace_view(fine).face.reshape(48 * n, 64 * n)
        radiance = np.where(face < 0, SKY, np.where(face < 2, FLOOR, SLAT))
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


def _radiance_from_slats(
    views: tuple[TracedView, ...], traced: TracedGeometry, surfels: Surfels
) -> tuple[NDArray, NDArray]:
    """Radiance (N, 3) of rays from the floor to the slats, and whether it counts as
    photographed (N,).
    """
    import mitsuba as mi

    nothing_emits = np.zeros(2 + 2 * NUM_SLATS, bool)
    emitters = photographed_emitters(views, traced.mesh, nothing_emits, np.zeros(len(nothing_emits), np.int32))
    grid = surfels.grid
    background = photographed_background(views, grid.low, grid.low + grid.cell_m * grid.shape)
    field = RadianceField(traced.scene, surfels, emitters, background)
    on_slats = surfels.position_m[surfels.face >= 2].astype(np.float64)
    origin = np.tile([0.0, 0.0, 0.1], (len(on_slats), 1))
    toward = on_slats - origin
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(toward.T.astype(np.float32)))
    met = field.meet(ray, mi.Bool(True))
    hit = np.asarray(traced.scene.ray_test(ray).numpy())
    return (
        np.asarray(met.radiance.numpy()).reshape(3, -1).T[hit],
        np.asarray(met.is_photographed.numpy())[hit],
    )


def test_slats_are_mixed_and_the_floor_is_not(views: tuple[TracedView, ...]) -> None:
    surfels = build_surfels(views)
    on_floor = surfels.face < 2
    assert (~on_floor).sum() > 50
    assert surfels.is_mixed[~on_floor].all()
    inner = on_floor & (np.abs(surfels.position_m[:, 0]) < 1) & (surfels.position_m[:, 1] < 1)
    assert surfels.is_mixed[inner].mean() < 0.02


def test_slats_do_not_shine_like_the_sky_behind_them(
    views: tuple[TracedView, ...], traced: TracedGeometry
) -> None:
    surfels = build_surfels(views)
    radiance, is_photographed = _radiance_from_slats(views, traced, surfels)
    assert len(radiance) > 50
    assert not is_photographed.any()
    assert radiance.max() == 0  # nothing is known without an estimate


def test_mixed_pixels_as_photographs_of_the_slats_shine(
    views: tuple[TracedView, ...], traced: TracedGeometry
) -> None:
    """The twin: their photographs show mostly sky."""
    surfels = build_surfels(views)
    blind = replace(surfels, is_mixed=np.zeros(len(surfels), bool))
    radiance, is_photographed = _radiance_from_slats(views, traced, blind)
    assert is_photographed.mean() > 0.9
    assert np.median(radiance) > 50 * SLAT
