# SPDX-License-Identifier: MIT
"""Reads a capture's views and traces its mesh at their pixels: the input of all stages of reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import Capture
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import input_error
from datagen.foundation.progress import Advance
from datagen.geometry.traced import TracedGeometry, ViewGeometry, reachable_faces
from datagen.multiview.statistics import StatisticsView


@dataclass(frozen=True)
class TracedView:
    """A view of a capture, with the surfaces at its pixel centres (``geometry``).

    ``color`` (H, W, 3), linear radiance; ``valid_mask`` (H, W), False where the photograph has no value;
    ``limit``, radiance at which the sensor clips, and ``clipped_mask`` (H, W, 3), True where ``color`` is
    therefore a lower bound; both are None if the sensor's limit is unknown.
    """

    camera: Camera
    color: NDArray[np.float32]
    geometry: ViewGeometry
    valid_mask: NDArray[np.bool_]
    name: str = "view"
    clipped_mask: NDArray[np.bool_] | None = None
    limit: float | None = None

    @property
    def statistics(self) -> StatisticsView:
        """The view as input of the multi-view statistics; its arrays are not copied."""
        mesh = self.geometry
        return StatisticsView(
            self.camera, self.color, mesh.depth_z_m, mesh.normal_world, mesh.surface_mask, self.name
        )


@dataclass(frozen=True)
class TracedCapture:
    """A capture, its mesh prepared for ray tracing, and its views in the capture's order."""

    capture: Capture
    geometry: TracedGeometry
    views: tuple[TracedView, ...]

    @property
    def statistics(self) -> list[StatisticsView]:
        return [view.statistics for view in self.views]


def trace_capture(capture: Capture, progress: Advance | None = None) -> TracedCapture:
    """Read and trace every view; ``progress(done, total)`` is called after each.

    Raises :class:`InputError` if no view shows a reflecting surface.
    """
    geometry, views = TracedGeometry(capture.geometry), []
    for number, view in enumerate(capture.views, start=1):
        image = view.read()
        pixels = image.color, geometry.trace_view(view.camera, image.valid_mask), image.valid_mask
        views.append(TracedView(view.camera, *pixels, view.name, image.clipped_mask, image.limit))
        if progress is not None:
            progress(number, len(capture.views))
    if not any(view.geometry.surface_mask.any() for view in views):
        expected = "cameras that face the mesh"
        remedy = "check that mesh and cameras share their frame, axes and unit"
        raise input_error(capture.name, "geometry", "no view shows the mesh", expected, remedy)
    return TracedCapture(capture, geometry, tuple(views))


def visible_faces(traced: TracedCapture) -> NDArray[np.bool_]:
    """Return the mask (M,) of triangles visible in a view or hit by random rays from visible surfaces."""
    found = np.zeros(len(traced.geometry.mesh.faces), dtype=bool)  # stays False for the outside of walls
    points, normals = [], []
    for view in traced.views:
        hit = np.flatnonzero(view.geometry.face.ravel() >= 0)
        found[view.geometry.face.ravel()[hit]] = True
        pixel = hit[:: max(1, len(hit) // 500)]
        ray = view.camera.ray_directions().reshape(-1, 3)[pixel]
        distance = view.geometry.depth_z_m.ravel()[pixel] / (ray @ view.camera.forward)
        points.append(view.camera.position_m + ray * distance[:, None])
        normals.append(view.geometry.normal_world.reshape(-1, 3)[pixel])
    return found | reachable_faces(traced.geometry, np.concatenate(points), np.concatenate(normals))
