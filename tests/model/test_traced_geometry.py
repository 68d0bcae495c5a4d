# SPDX-License-Identifier: MIT
"""Faces of a mesh that rays from inside reach."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import TracedGeometry, reachable_faces
from tests.model.lit_box import SIDES, box_geometry

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def test_faces_outside_of_the_room_are_not_reachable() -> None:
    """From inside a box, its faces are reachable, but not a roof above it."""
    box = box_geometry().mesh
    roof = np.array([[0, 0, 3], [4, 0, 3], [4, 3, 3], [0, 3, 3]], np.float32)
    first = len(box.positions)
    faces = np.concatenate([box.faces, np.array([[0, 1, 2], [0, 2, 3]], np.int32) + first])
    mesh = Mesh(np.concatenate([box.positions, roof]), faces.astype(np.int32), None, None)
    traced = TracedGeometry(CaptureGeometry(mesh, (GeometryPart("all", 0, len(faces)),)))
    floor = np.array([[*SIDES[:2] / 2, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    found = reachable_faces(traced, *floor, num_rays=20_000)
    # the floor is not reachable from itself
    assert found.sum() == 12 and not found[8:10].any() and not found[-2:].any()
    outside = reachable_faces(traced, floor[0] + [0, 0, 2.9], floor[1], num_rays=2000)
    assert outside[-2:].all() and outside.sum() == 2
    assert not reachable_faces(traced, floor[0][:0], floor[1][:0]).any()
