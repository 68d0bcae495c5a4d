# SPDX-License-Identifier: MIT
"""Confidence of texels: that of the surfel at the same position and side, or 0 without one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from datagen.foundation.meshes.mesh import Mesh
from datagen.light.surfels import NUM_SIDES, CellGrid, cell_of
from model.reconstruction.atlas.atlas import empty_atlas, put_confidence
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.light.confidence import SurfelConfidence

SHAPE = np.array([8, 7, 6])
CELL_M = 0.5


def random_surfels(seed: int) -> tuple[SurfelConfidence, np.ndarray, np.ndarray]:
    """Confidence of random surfels, surfel number (-1: none) by cell and side, and confidences (N, 3)."""
    random = np.random.default_rng(seed)
    surfel = np.full(int(SHAPE.prod()) * NUM_SIDES, -1, np.int32)
    occupied = np.flatnonzero(random.random(len(surfel)) < 0.3)
    surfel[occupied] = np.arange(len(occupied))
    confidence = random.random((len(occupied), 3))
    surfels = SimpleNamespace(grid=CellGrid(np.zeros(3), CELL_M, SHAPE, surfel))
    return SurfelConfidence.of(surfels, confidence), surfel, confidence  # type: ignore[arg-type]


def test_confidence_is_taken_from_the_nearest_cell_of_the_side() -> None:
    found, surfel, confidence = random_surfels(1)
    random = np.random.default_rng(2)
    points = random.uniform(-0.4, 1.1, (400, 3)) * SHAPE * CELL_M
    normals = random.normal(size=(400, 3)).astype(np.float32)
    got = found.at(points.reshape(20, 20, 3), normals.reshape(20, 20, 3)).reshape(400, 3)
    num_own = num_near = num_none = 0
    for point, normal, value in zip(points, normals, got, strict=True):
        near: dict[int, list[int]] = {}
        for step in np.ndindex(3, 3, 3):
            at = point + (np.array(step) - 1) * CELL_M
            cell = cell_of(at, normal, np.zeros(3), CELL_M, SHAPE)
            if cell >= 0 and surfel[cell] >= 0:
                near.setdefault(sum(abs(k - 1) for k in step), []).append(surfel[cell])
        if not near:
            num_none += 1
            assert not value.any()
            continue
        num_own += min(near) == 0
        num_near += min(near) > 0
        stored = np.round(255 * confidence[near[min(near)]]).astype(np.uint8)
        assert (stored == value).all(axis=1).any()
    assert min(num_own, num_near, num_none) > 20


def test_unseen_texels_have_none() -> None:
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    mesh = Mesh(positions, np.array([[0, 1, 2], [0, 2, 3]], np.int32), None, positions[:, :2].copy())
    surface = TexelSurface(mesh, np.array([[0, 0, 1], [0, 0, 1]], np.float32), 16)
    atlas = empty_atlas(16, has_confidence=True)
    atlas.face[:] = surface.faces(0, 0, 16, 16)
    atlas.count[:, :8] = 2

    def by_place(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        assert (normals == [0, 0, 1]).all()
        return np.round(255 * points).astype(np.uint8)

    put_confidence(atlas, surface, by_place)
    assert atlas.confidence is not None and not atlas.confidence[:, 8:].any()
    centre = (np.arange(16) + 0.5) / 16
    np.testing.assert_array_equal(atlas.confidence[3, :8, 0], np.round(255 * centre[:8]))
    np.testing.assert_array_equal(atlas.confidence[:, 2, 1], np.round(255 * centre[::-1]))  # row 0 at v = 1
    with pytest.raises(ValueError, match="with confidence"):
        put_confidence(empty_atlas(16), surface, by_place)
