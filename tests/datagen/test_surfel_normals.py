# SPDX-License-Identifier: MIT
"""Observations of one surfel from two sides of a thin column have different normals."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from datagen.light.surfels import build_surfels

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
SIDES, RADIUS_M = 32, 0.03


@pytest.fixture(scope="module")
def views(mitsuba_variant: str) -> tuple[TracedView, ...]:
    """Return views, from the left and the right, of a column of 3 cm radius in front of a wall."""
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    ring = RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    column = np.concatenate([np.column_stack([ring, np.full(SIDES, z)]) for z in (0.0, 2.0)])
    wall = [(-4.0, 1.0, -2.0), (4.0, 1.0, -2.0), (4.0, 1.0, 4.0), (-4.0, 1.0, 4.0)]
    following = (np.arange(SIDES) + 1) % SIDES
    lower = np.stack([np.arange(SIDES), following, following + SIDES], axis=1)
    upper = np.stack([np.arange(SIDES), following + SIDES, np.arange(SIDES) + SIDES], axis=1)
    corner = 2 * SIDES
    faces = [lower, upper, [[corner, corner + 1, corner + 2], [corner, corner + 2, corner + 3]]]
    mesh = Mesh(np.concatenate([column, wall]).astype(np.float32), np.concatenate(faces).astype(np.int32))
    traced = TracedGeometry(CaptureGeometry(mesh, (GeometryPart("all", 0, len(mesh.faces), None),)))
    found = []
    for x in (-1.0, 1.0):
        matrix = look_at(np.array([x, -1.0, 1.0]), np.array([0.0, 0.0, 1.0]))
        camera = Camera(160, 120, 160.0, 160.0, 80.0, 60.0, matrix)
        color = np.ones((120, 160, 3), np.float32)
        found.append(TracedView(camera, color, traced.trace_view(camera), np.ones((120, 160), bool)))
    return tuple(found)


def test_observations_have_the_mean_normal_of_their_pixels(views: tuple[TracedView, ...]) -> None:
    surfels = build_surfels(views)
    observations, owner = surfels.observations, surfels.surfel_of_observation()
    for index, view in enumerate(views):
        surfel, weight = surfels.pixel_surfel[index], surfels.pixel_weight[index]
        used = surfel >= 0
        sums = np.zeros((len(surfels), 3))
        np.add.at(sums, surfel[used], weight[used, None] * view.geometry.normal_world.reshape(-1, 3)[used])
        mine = observations.view == index
        expected = sums[owner[mine]]
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(observations.normal[mine], expected, atol=1e-5)


def test_normals_of_a_column_differ_between_views(views: tuple[TracedView, ...]) -> None:
    surfels = build_surfels(views)
    is_seen_twice = np.diff(surfels.observations.start) == 2
    first = surfels.observations.start[:-1][is_seen_twice]
    cosine = (surfels.observations.normal[first] * surfels.observations.normal[first + 1]).sum(axis=1)
    is_column = np.linalg.norm(surfels.position_m[is_seen_twice, :2], axis=1) < 2 * RADIUS_M
    assert is_column.sum() > 20
    assert np.degrees(np.arccos(np.median(cosine[is_column]))) > 10
    np.testing.assert_allclose(cosine[~is_column], 1, atol=1e-5)
