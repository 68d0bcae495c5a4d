# SPDX-License-Identifier: MIT
"""Rasteriser for atlases that finds the triangle at each texel's centre, and the surface point there.

The rasteriser works on any rectangle of the atlas. Edge functions are computed in float64 from the ends of
the edge in the same order for both adjacent triangles, so no texel is missed between two triangles that share
an edge. Row 0 of an atlas is at v = 1. Triangles are binned, so only those near a rectangle are tested.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh
from datagen.multiview.compiled import compiled

BIN = 256
"""Number of texels along a side of a bin."""


class TexelSurface:
    """Surface of an unwrapped mesh, sampled at the texels of a ``size`` x ``size`` atlas.

    ``normals`` (M, 3) are the unit normals of the triangles. Raises ValueError for a mesh without UVs.
    """

    def __init__(self, mesh: Mesh, normals: NDArray[np.float32], size: int):
        if mesh.uv is None:
            raise ValueError("expected a mesh with UVs")
        self.size, self.num_faces = size, len(mesh.faces)
        self.positions = np.ascontiguousarray(mesh.positions, np.float32)
        self.vertices = np.ascontiguousarray(mesh.faces, np.int32)
        self.normals = np.ascontiguousarray(normals, np.float32)
        self.uv = np.ascontiguousarray(mesh.uv, np.float32)
        num_bins = -(-size // BIN)
        starts = np.zeros(num_bins * num_bins + 1, np.int64)
        _add_to_bins(self.uv, self.vertices, size, num_bins, starts[1:], np.empty(0, np.int32))
        np.cumsum(starts, out=starts)
        members = np.empty(starts[-1], np.int32)
        _add_to_bins(self.uv, self.vertices, size, num_bins, starts[:-1].copy(), members)
        self._bins = (starts, members, num_bins)

    def faces(
        self,
        left: int,
        top: int,
        width: int,
        height: int,
        offset: tuple[float, float] = (0.5, 0.5),
        *,
        is_highest: bool = True,
    ) -> NDArray[np.int32]:
        """Find the index of the triangle at each texel of the rectangle at (``left``, ``top``): (height,
        width), -1 for none. Texels are sampled at ``offset`` (x, y) in [0, 1] from their upper left corner.

        Where triangles overlap, the highest index is returned or, if not ``is_highest``, the lowest.
        """
        face = np.full((height, width), -1, np.int32)
        _rasterise(self.uv, self.vertices, self.size, *self._bins, left, top, *offset, is_highest, face)
        return face

    def points(self, face: NDArray[np.int32], left: int, top: int) -> tuple[NDArray, NDArray]:
        """Compute world positions and normals (H, W, 3) at the texel centres of the rectangle at ``left``,
        ``top`` with the triangles ``face`` (H, W); 0 where ``face`` is -1.
        """
        points = np.zeros((*face.shape, 3), np.float32)
        _surface_points(face, left, top, self.size, self.uv, self.vertices, self.positions, points)
        normals = np.where((face >= 0)[..., None], self.normals[np.maximum(face, 0)], np.float32(0))
        return points, normals

    def overlaps(self, offset: tuple[float, float] = (0.5, 0.5)) -> tuple[NDArray, NDArray]:
        """Return the highest triangle index (size, size) at each texel, -1 for none, and the mask (size,
        size) of texels covered by several triangles."""
        whole = (0, 0, self.size, self.size, offset)
        highest = self.faces(*whole)
        return highest, highest != self.faces(*whole, is_highest=False)


@compiled
def corner(uv: Any, vertex: Any, size: Any) -> Any:
    """Compute the position (x, y) of a vertex on an atlas, in texels from the upper left corner."""
    return np.float64(uv[vertex, 0]) * size, (1.0 - np.float64(uv[vertex, 1])) * size


@compiled
def _span(a: Any, b: Any, c: Any, num_bins: Any) -> Any:
    """Find the first and last bin along an axis that overlap the range of three coordinates in texels."""
    low, high = min(a, b, c), max(a, b, c)
    last = np.float64(num_bins - 1)
    return int(min(max(np.floor(low / BIN), 0.0), last)), int(min(max(np.floor(high / BIN), 0.0), last))


@compiled
def _face_bins(uv: Any, vertices: Any, face: Any, size: Any, num_bins: Any) -> Any:
    """Find the first and last column and row of the bins that a triangle's bounding box overlaps."""
    ax, ay = corner(uv, vertices[face, 0], size)
    bx, by = corner(uv, vertices[face, 1], size)
    cx, cy = corner(uv, vertices[face, 2], size)
    first_x, last_x = _span(ax, bx, cx, num_bins)
    first_y, last_y = _span(ay, by, cy, num_bins)
    return first_x, last_x, first_y, last_y


@compiled
def _add_to_bins(uv: Any, vertices: Any, size: Any, num_bins: Any, ends: Any, members: Any) -> None:
    """Append each triangle to its bins in ``members`` and advance the bins' ``ends``; with empty ``members``,
    only advance ``ends`` (a counting pass).
    """
    for face in range(len(vertices)):  # in ascending order, so the triangles of each bin are sorted
        first_x, last_x, first_y, last_y = _face_bins(uv, vertices, face, size, num_bins)
        for row in range(first_y, last_y + 1):
            for column in range(first_x, last_x + 1):
                if len(members):
                    members[ends[row * num_bins + column]] = face
                ends[row * num_bins + column] += 1


@compiled
def _edge(ax: Any, ay: Any, bx: Any, by: Any, side: Any) -> Any:
    """Return start, vector and sign (x, y, dx, dy, sign) of the edge ab with its ends in canonical order; the
    sign is ``side``, negated if the ends are swapped."""
    if ax < bx or (ax == bx and ay <= by):
        return ax, ay, bx - ax, by - ay, side
    return bx, by, ax - bx, ay - by, -side


@compiled
def _texel_range(a: Any, b: Any, c: Any, offset: Any, first: Any, last: Any) -> Any:
    """Find the first and last texel in [first, last] whose sample point, texel + ``offset``, is between the
    smallest and largest of three coordinates; last < first if there is none.
    """
    low, high = np.ceil(min(a, b, c) - offset), np.floor(max(a, b, c) - offset)
    return int(max(low, np.float64(first))), int(min(high, np.float64(last)))


@compiled
def _rasterise(
    uv: Any,
    vertices: Any,
    size: Any,
    starts: Any,
    members: Any,
    num_bins: Any,
    left: Any,
    top: Any,
    offset_x: Any,
    offset_y: Any,
    is_highest: Any,
    face_of: Any,
) -> None:
    height, width = face_of.shape
    for bin_y in range(top // BIN, (top + height - 1) // BIN + 1):
        for bin_x in range(left // BIN, (left + width - 1) // BIN + 1):
            low_x, high_x = max(left, bin_x * BIN), min(left + width, (bin_x + 1) * BIN) - 1
            low_y, high_y = max(top, bin_y * BIN), min(top + height, (bin_y + 1) * BIN) - 1
            at = bin_y * num_bins + bin_x
            for k in range(starts[at], starts[at + 1]):
                face = members[k]
                ax, ay = corner(uv, vertices[face, 0], size)
                bx, by = corner(uv, vertices[face, 1], size)
                cx, cy = corner(uv, vertices[face, 2], size)
                first_x, last_x = _texel_range(ax, bx, cx, offset_x, low_x, high_x)
                first_y, last_y = _texel_range(ay, by, cy, offset_y, low_y, high_y)
                winding = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
                if winding == 0.0:
                    continue
                side = 1.0 if winding > 0.0 else -1.0
                x0, y0, dx0, dy0, sign0 = _edge(ax, ay, bx, by, side)
                x1, y1, dx1, dy1, sign1 = _edge(bx, by, cx, cy, side)
                x2, y2, dx2, dy2, sign2 = _edge(cx, cy, ax, ay, side)
                for row in range(first_y, last_y + 1):
                    y = row + offset_y
                    for column in range(first_x, last_x + 1):
                        x = column + offset_x
                        before = face_of[row - top, column - left]
                        is_inside = (
                            (sign0 * (dx0 * (y - y0) - dy0 * (x - x0)) >= 0.0)
                            & (sign1 * (dx1 * (y - y1) - dy1 * (x - x1)) >= 0.0)
                            & (sign2 * (dx2 * (y - y2) - dy2 * (x - x2)) >= 0.0)
                            & (is_highest | (before < 0))
                        )
                        face_of[row - top, column - left] = face if is_inside else before


@compiled
def surface_point(face: Any, x: Any, y: Any, size: Any, uv: Any, vertices: Any, positions: Any) -> Any:
    """Compute the world position (x, y, z) of the point of triangle ``face`` at texel coordinates (x, y).

    ``size`` is the atlas's side in texels; ``vertices`` (M, 3) are indices into ``uv`` and ``positions``.
    """
    i, j, k = vertices[face, 0], vertices[face, 1], vertices[face, 2]
    ax, ay = corner(uv, i, size)
    bx, by = corner(uv, j, size)
    cx, cy = corner(uv, k, size)
    scale = 1.0 / ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    s = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) * scale
    t = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) * scale
    r = 1.0 - s - t
    return (
        np.float32(r * positions[i, 0] + s * positions[j, 0] + t * positions[k, 0]),
        np.float32(r * positions[i, 1] + s * positions[j, 1] + t * positions[k, 1]),
        np.float32(r * positions[i, 2] + s * positions[j, 2] + t * positions[k, 2]),
    )


@compiled
def _surface_points(
    face_of: Any, left: Any, top: Any, size: Any, uv: Any, vertices: Any, positions: Any, points: Any
) -> None:
    for row in range(face_of.shape[0]):
        for column in range(face_of.shape[1]):
            face = face_of[row, column]
            if face >= 0:
                x, y, z = surface_point(
                    face, left + column + 0.5, top + row + 0.5, size, uv, vertices, positions
                )
                points[row, column, 0], points[row, column, 1], points[row, column, 2] = x, y, z
