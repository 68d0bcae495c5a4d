# SPDX-License-Identifier: MIT
"""A surface from sparse points: a room with a block, and the points of a binary COLMAP model."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.foundation.budget import Budget
from datagen.foundation.errors import InputError
from datagen.foundation.meshes.mesh import Mesh
from model.reconstruction.captures.colmap import Sights, read_sights
from model.reconstruction.photos.sparse_mesh import sparse_surface

ROOM, BLOCK = np.array([4.0, 3.0, 2.5]), np.array([[1.4, 1.0, 0.0], [2.4, 2.0, 1.0]])


def points_on(low: NDArray, high: NDArray, num: int, rng: np.random.Generator) -> NDArray:
    """Points on the six sides of a box."""
    points = rng.uniform(low, high, (num, 3))
    axis, side = rng.integers(0, 3, num), rng.integers(0, 2, num)
    points[np.arange(num), axis] = np.where(side, high[axis], low[axis])
    return points


def is_hidden(origin: NDArray, target: NDArray) -> bool:
    """Return whether the block is between two points."""
    way = np.where(np.abs(target - origin) < 1e-9, 1e-9, target - origin)
    ends = np.sort((BLOCK - origin) / way, axis=0)
    return bool(max(ends[0].max(), 0) < min(ends[1].min(), 1 - 1e-3))


def room_sights(num_false: int = 0) -> Sights:
    """Lines of sight from eight cameras in a room with a block; points err by 3 mm, and false ones are in
    free space and seen by one camera each."""
    rng = np.random.default_rng(2)
    points = np.concatenate(
        [points_on(np.zeros(3), ROOM, 900, rng), points_on(*BLOCK, 500, rng)]  # type: ignore[call-arg]
    )
    points = points[~((points[:, 2] == 0) & ((points > BLOCK[0]) & (points < BLOCK[1]))[:, :2].all(axis=1))]
    centers = rng.uniform([0.4, 0.4, 1.3], [3.6, 2.6, 2.2], (8, 3))
    pairs = [(c, p) for p in range(len(points)) for c in range(8) if not is_hidden(centers[c], points[p])]
    false = rng.uniform([0.5, 0.3, 1.2], [3.5, 2.7, 2.3], (num_false, 3))
    pairs += [(k % 8, len(points) + k) for k in range(num_false)]
    points = np.concatenate([points + rng.normal(0, 0.003, points.shape), false])
    camera, point = np.array(pairs).T
    return Sights(points, centers, camera, point)


def enclosed_m3(mesh: Mesh) -> float:
    """Volume (m3) enclosed by a closed mesh whose triangles face inwards."""
    a, b, c = np.moveaxis(mesh.triangles().astype(np.float64) - ROOM / 2, 1, 0)
    return -float((np.cross(a, b) * c).sum() / 6)


def distances(points: NDArray) -> NDArray:
    """Distance of points to the surfaces of the room and of the block."""
    to_walls = np.minimum(np.abs(points), np.abs(points - ROOM)).min(axis=1)
    nearest = np.clip(points, *BLOCK)
    outside = np.linalg.norm(points - nearest, axis=1)
    inside = np.minimum(np.abs(points - BLOCK[0]), np.abs(points - BLOCK[1])).min(axis=1)
    return np.asarray(np.minimum(to_walls, np.where(outside > 0, outside, inside)))


def test_surface_of_a_room_with_a_block_is_closed() -> None:
    """The surface is closed, faces the cameras, and follows walls and block despite false points."""
    mesh = sparse_surface(room_sights(num_false=40))
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    assert sorted(map(tuple, edges.tolist())) == sorted(map(tuple, edges[:, ::-1].tolist()))
    volume = float(ROOM.prod() - np.diff(BLOCK, axis=0).prod())
    assert enclosed_m3(mesh) == pytest.approx(volume, rel=0.03)
    assert np.quantile(distances(mesh.triangles().mean(axis=1)), 0.97) < 0.12
    assert np.mean(distances(mesh.positions) > 0.05) < 0.01


def test_no_points_give_no_surface() -> None:
    none = np.zeros(0, np.int64)
    assert len(sparse_surface(Sights(np.zeros((0, 3)), np.zeros((2, 3)), none, none)).faces) == 0


def write_model(folder: Path) -> None:
    """Write a model of two images at x = 1 and x = -2, and three points, the second with a large error."""
    folder.mkdir()
    images = struct.pack("<Q", 2)
    for image_id, x in ((7, 1.0), (3, -2.0)):
        images += struct.pack("<i7di", image_id, 1, 0, 0, 0, -x, 0, 0, 1) + f"{image_id}.jpg".encode() + b"\0"
        images += struct.pack("<Q2dq", 1, 0.5, 0.5, -1)
    (folder / "images.bin").write_bytes(images)
    points = struct.pack("<Q", 3)
    for number, (error, shown_in) in enumerate([(0.5, (3, 7)), (3.0, (3, 7)), (1.0, (7,))]):
        points += struct.pack("<Q3d3BdQ", 10 + number, number, 0, 5, 9, 9, 9, error, len(shown_in))
        points += b"".join(struct.pack("<2i", image_id, 0) for image_id in shown_in)
    (folder / "points3D.bin").write_bytes(points)


def test_sights_of_a_binary_model_are_read(tmp_path: Path) -> None:
    write_model(tmp_path / "model")
    sights = read_sights(tmp_path / "model", Budget(tmp_path), 2.0)
    np.testing.assert_array_equal(sights.points, [[0, 0, 5], [2, 0, 5]])
    np.testing.assert_array_equal(sights.centers, [[1, 0, 0], [-2, 0, 0]])
    assert list(zip(sights.camera.tolist(), sights.point.tolist(), strict=True)) == [(1, 0), (0, 0), (0, 1)]
    path = tmp_path / "model" / "points3D.bin"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(InputError, match="ends early"):
        read_sights(tmp_path / "model", Budget(tmp_path), 2.0)
