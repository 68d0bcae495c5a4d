# SPDX-License-Identifier: MIT
"""Mixed surfels, whose pixels show several surfaces: slats thinner than a pixel in front of a bright sky."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from datagen.light.edge_pixels import edge_slope, unmixed
from datagen.light.lighting import GatherOptions, light_surfels
from datagen.light.surfels import Surfels, build_surfels

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
WALL, SLAT, SKY = 0.2, 0.05, 20.0
"""Radiance of the room's surfaces, of the slats and of the sky."""
NUM_SLATS, SPACING_M, SLAT_M = 9, 0.11, 0.02
SUBPIXELS = 16
NUM_WALL_FACES = 10


def _geometry() -> CaptureGeometry:
    """Return a room of 4 x 4.5 x 2.5 m whose open side at y = 2 m has slats of 2 cm at intervals of 11 cm.
    Adjacent pixels show the same slat or none."""
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


def _photographed(traced: TracedGeometry, sky: float = SKY) -> tuple[TracedView, ...]:
    """Return six photographs whose pixels average 16 x 16 rays; the first three show the slats."""
    views = []
    toward_slats = [((x, -1.5, 0.5), (0.0, 2.0, 0.9)) for x in (-0.6, 0.0, 0.6)]
    into_room = [((0.0, 1.8, 1.5), (x, y, 1.0)) for x, y in ((0.0, -2.0), (-2.0, 0.0), (2.0, 0.0))]
    for eye, target in toward_slats + into_room:
        matrix = look_at(np.array(eye), np.array(target))
        camera = Camera(64, 48, 48.0, 48.0, 32.0, 24.0, matrix)
        n = SUBPIXELS
        fine = Camera(64 * n, 48 * n, 48.0 * n, 48.0 * n, 32.0 * n, 24.0 * n, matrix)
        face = traced.trace_view(fine).face.reshape(48 * n, 64 * n)
        radiance = np.where(face < 0, sky, np.where(face < NUM_WALL_FACES, WALL, SLAT))
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


def _lit(views: tuple[TracedView, ...], traced: TracedGeometry, is_bounded: bool = True) -> Surfels:
    """Return surfels of the views; ``is_bounded``: incident light bounds the radiance of mixed surfels."""
    nothing_emits = np.zeros(NUM_WALL_FACES + 2 * NUM_SLATS, bool)
    regions = np.zeros(len(nothing_emits), np.int32)
    options = GatherOptions(irradiance_rays=8, estimates_unseen=False, bounds_mixed=is_bounded)
    return light_surfels(views, traced, nothing_emits, regions, options).surfels


def _of_slats(surfels: Surfels) -> NDArray[np.float32]:
    """Return the radiance (N, 3) of the slats' surfels."""
    return surfels.radiance[surfels.face >= NUM_WALL_FACES]


def test_slats_are_mixed_and_walls_are_not(views: tuple[TracedView, ...]) -> None:
    surfels = build_surfels(views)
    is_slat = surfels.face >= NUM_WALL_FACES
    assert is_slat.sum() > 50
    assert surfels.is_mixed[is_slat].all()
    assert surfels.is_mixed[surfels.position_m[:, 1] < 1.5].mean() < 0.02


def test_slats_do_not_get_the_radiance_of_the_sky_behind_them(
    views: tuple[TracedView, ...], traced: TracedGeometry
) -> None:
    """Pixels of slats show mostly sky, but the slats' radiance is bounded by their incident light."""
    seen, found = _lit(views, traced, is_bounded=False), _lit(views, traced)
    assert np.median(_of_slats(seen)) > 50 * SLAT
    assert np.quantile(_of_slats(found), 0.9) < 1.1 * WALL
    np.testing.assert_array_equal(found.radiance[~found.is_mixed], seen.radiance[~seen.is_mixed])


def test_mixed_surfels_in_unknown_light_keep_their_radiance(
    views: tuple[TracedView, ...], traced: TracedGeometry
) -> None:
    """If photographs show only the slats, little of their incident light is known, so the bound is loose."""
    seen, found = _lit(views[:3], traced, is_bounded=False), _lit(views[:3], traced)
    assert np.median(_of_slats(found) / _of_slats(seen)) > 0.5


def test_mixed_surfels_of_plausible_radiance_keep_it(traced: TracedGeometry) -> None:
    """In front of a dark sky, the radiance of the slats' surfels is plausible and unchanged."""
    views = _photographed(traced, sky=SLAT / 2)
    seen, found = _lit(views, traced, is_bounded=False), _lit(views, traced)
    np.testing.assert_array_equal(_of_slats(found), _of_slats(seen))


def _unmixed(views: tuple[TracedView, ...], traced: TracedGeometry) -> list[TracedView]:
    nothing_emits = np.zeros(NUM_WALL_FACES + 2 * NUM_SLATS, bool)
    surface = np.arange(len(nothing_emits), dtype=np.int32) // 2
    return unmixed(views, traced, nothing_emits, surface)


def _radiance(views: Sequence[TracedView], is_slat: bool) -> NDArray[np.float32]:
    """Return the radiance (K,) of the pixels that show slats (if ``is_slat``) or walls."""
    of_views = []
    for view in views:
        face = view.geometry.face.ravel()
        shown = face >= NUM_WALL_FACES if is_slat else (face >= 0) & (face < NUM_WALL_FACES)
        of_views.append(view.color[..., 0].ravel()[shown])
    return np.concatenate(of_views)


def test_pixels_of_slats_get_the_radiance_of_slats_alone(
    views: tuple[TracedView, ...], traced: TracedGeometry
) -> None:
    found = _unmixed(views, traced)
    slats, walls = _radiance(found, True), _radiance(found, False)
    assert np.median(_radiance(views, True)) > 50 * SLAT
    assert abs(np.median(slats) - SLAT) < 0.01 * SKY  # coverage from 16 rays errs by a few percent
    assert np.quantile(slats, 0.9) < 0.04 * SKY
    assert slats.mean() < 0.02 * SKY  # uncertain pixels are shrunk towards the median of their block
    assert np.quantile(np.abs(walls - WALL), 0.95) < 0.05 * WALL


def test_pixels_without_other_surfaces_keep_their_values(
    views: tuple[TracedView, ...], traced: TracedGeometry
) -> None:
    surfels = build_surfels(views)
    for view, found, of_pixel in zip(views, _unmixed(views, traced), surfels.pixel_surfel, strict=True):
        own = of_pixel.reshape(view.color.shape[:2])
        is_mixed = (own >= 0) & surfels.is_mixed[own]
        np.testing.assert_array_equal(found.color[~is_mixed], view.color[~is_mixed])


@pytest.mark.parametrize(("part", "expected"), [(1.0, 1.0), (0.45, 0.5), (0.0, 0.0)])
def test_slope_is_the_observed_part_of_the_predicted_mixture(part: float, expected: float) -> None:
    """The median slope is divided by 0.9, its minimum for exact meshes, so 0.45 of the mixture gives 0.5."""
    rng = np.random.default_rng(3)
    share = rng.uniform(0.2, 0.8, 200_000)
    known, beyond = rng.uniform(0.1, 1, (2, len(share), 1)) * np.ones(3)
    other = (1 - share)[:, None] * beyond
    color = known + part * (share[:, None] * known + other - known)
    is_known = np.ones(len(share), bool)
    assert abs(edge_slope(color, share, other, known, is_known) - expected) < 0.02
    assert edge_slope(color, share, other, known, ~is_known) == 1.0
