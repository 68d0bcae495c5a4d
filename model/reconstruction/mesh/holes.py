# SPDX-License-Identifier: MIT
"""Finds holes of a reconstructed mesh, and fills those in which photographs show a continued surface.

A hole is a simple cycle of boundary edges whose filling has about the normal of the surrounding surface,
which excludes rims of vessels and outlines of open parts. Through a window, photographs show a surface at
another depth, or light: the radiance of a point on the filling differs between views, or is much higher than
that of the surrounding surface. Such openings are left open. Holes visible in fewer than two views are filled
if they are too small for windows: their surface was not reconstructed, and daylight would leak in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.capture import Capture, CaptureGeometry, GeometryPart
from datagen.foundation.color import LUMINANCE_WEIGHTS
from datagen.foundation.meshes.mesh import Mesh, area_vectors, welded
from datagen.geometry.traced import mesh_scene
from datagen.multiview.compiled import compiled
from mitsuba_plugins.arrays import vectors_from_rows

MAX_SIZE = 0.15
"""Maximum extent of a hole, relative to the diagonal of the mesh's bounding box."""
MAX_UNSEEN_SIZE = 0.08
"""The same for a hole visible in fewer than :data:`MIN_VIEWS` views: 0.5 m in a room of 5 x 4 x 3 m."""
MIN_FLAT = 0.5
"""Minimum cosine of the angle between the normal of the filling and the mean normal around it."""
MAX_CHANGE, MAX_SPREAD, MAX_SPREADS = np.log(2.0), 0.2, 1.5
"""Maximum difference of log radiance between filling and surroundings; maximum median absolute deviation of
log radiance between views (mean over points), as a value and as a multiple of the surroundings'. The larger
maximum applies."""
MIN_VIEWS, NUM_POINTS, MAX_HOLES = 2, 12, 2000
"""Minimum number of views of a point, number of points on each filling and around it, and maximum number of
holes; those with the most edges are selected."""
PART = "filled holes"
_NEAR = 2e-3  # untested end of a shadow ray, relative to its length; avoids occlusion by the point's surface

if TYPE_CHECKING:
    import mitsuba as mi

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Hole:
    """A hole: the welded vertices ``loop`` (N,) on its border, in the winding order of the filling, and the
    triangles ``around`` (N,) at its edges, both as indices."""

    loop: Ints
    around: Ints


def find_holes(mesh: Mesh, is_ignored: NDArray[np.bool_]) -> list[Hole]:
    """Find the holes of ``mesh``; triangles ``is_ignored`` (M,) do not belong to the surface."""
    positions, vertex = welded(mesh)
    corners = vertex[mesh.faces]
    normal = area_vectors(positions.astype(np.float64)[corners])
    length = np.linalg.norm(normal, axis=1)
    kept = np.flatnonzero(~is_ignored & (length > 0))
    unit = normal / np.maximum(length, 1e-300)[:, None]
    size = MAX_SIZE * _diagonal(positions)
    found = []
    for loop, around in _cycles(*_boundary(corners[kept], len(positions))):
        points = positions[loop].astype(np.float64)
        if len(loop) < 3 or np.ptp(points, axis=0).max() > size:
            continue
        owners = kept[around]
        mean = unit[owners].mean(axis=0)
        filling = np.cross(points - points[0], np.roll(points, -1, axis=0) - points[0]).sum(axis=0)
        if filling @ mean > MIN_FLAT * np.linalg.norm(filling):
            found.append(Hole(loop, owners))
    return found


def _boundary(corners: Ints, num_vertices: int) -> tuple[Ints, Ints, Ints]:
    """Return start and end vertex and triangle (E,) of the reversed boundary edges of ``corners`` (M, 3)."""
    start = corners.ravel()
    end = np.roll(corners, -1, axis=1).ravel()
    forward, backward = start * num_vertices + end, end * num_vertices + start
    single = np.flatnonzero(~np.isin(forward, backward) & (start != end))
    return end[single], start[single], single // 3


def _cycles(start: Ints, end: Ints, owner: Ints) -> list[tuple[Ints, Ints]]:
    """Divide directed edges into simple cycles; return start vertex and owner (N,) of the edges of each."""
    leaving: dict[int, list[int]] = {}
    for edge in range(len(start) - 1, -1, -1):
        leaving.setdefault(int(start[edge]), []).append(edge)
    cycles = []
    for first in list(leaving):
        path: list[int] = []  # edges
        place: dict[int, int] = {}  # position in the path of the edge that leaves a vertex
        at = first
        while leaving.get(at):
            edge = leaving[at].pop()
            place[at] = len(path)
            path.append(edge)
            at = int(end[edge])
            if at in place:
                cycle = np.array(path[place[at] :])
                cycles.append((start[cycle], owner[cycle]))
                for closed in path[place[at] :]:
                    del place[int(start[closed])]
                del path[len(path) - len(cycle) :]
    return cycles


def triangulated(points: Floats) -> Ints:
    """Triangulate a roughly planar polygon (N, 3) by ear clipping; returns indices (N - 2, 3)."""
    normal = np.cross(points - points[0], np.roll(points, -1, axis=0) - points[0]).sum(axis=0)
    normal /= max(float(np.linalg.norm(normal)), 1e-300)
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    tangent = np.cross(helper, normal)
    tangent /= np.linalg.norm(tangent)
    flat = points @ np.stack([tangent, np.cross(normal, tangent)], axis=1)
    return np.asarray(_clip_ears(np.ascontiguousarray(flat)), np.int64)


@compiled
def _clip_ears(points: Floats) -> Ints:
    """Triangulate a counter-clockwise polygon (N, 2); if no ear is left, clip the most convex corner."""
    size = points.max() - points.min()
    rounding = 1e-12 * size * size  # excludes ears with another corner on an edge, which would leave no area
    rest = list(range(len(points)))
    found = np.empty((len(points) - 2, 3), np.int64)
    for step in range(len(found)):
        best, best_turn, best_is_free = 0, -np.inf, False
        for k in range(len(rest)):
            a, b, c = rest[k - 1], rest[k], rest[(k + 1) % len(rest)]
            turn = _turn(points, a, b, c)
            is_free = turn > rounding
            for other in rest:
                if other != a and other != b and other != c:
                    least = min(_turn(points, a, b, other), _turn(points, b, c, other))
                    is_free &= min(least, _turn(points, c, a, other)) < -rounding
            if is_free > best_is_free or (is_free == best_is_free and turn > best_turn):
                best, best_turn, best_is_free = k, turn, is_free
        found[step, 0] = rest[best - 1]
        found[step, 1] = rest[best]
        found[step, 2] = rest[(best + 1) % len(rest)]
        rest.pop(best)
    return found


@compiled
def _turn(points: Floats, a: int, b: int, c: int) -> float:
    """Compute twice the signed area of the triangle of three points."""
    return float(
        (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1])
        - (points[b, 1] - points[a, 1]) * (points[c, 0] - points[a, 0])
    )


def filled(capture: Capture) -> tuple[Capture, int]:
    """Fill holes of the capture's mesh in which photographs show a surface, and small unphotographed holes;
    also return the number of filled holes.

    The added triangles are the last part. The mesh loses its UVs.
    """
    geometry = capture.geometry
    holes = find_holes(geometry.mesh, geometry.emitter_mask())
    holes = sorted(holes, key=lambda hole: -len(hole.loop))[:MAX_HOLES]
    if not holes:
        return capture, 0
    mesh = geometry.mesh
    positions, vertex = welded(mesh)
    patches = [hole.loop[triangulated(positions[hole.loop].astype(np.float64))] for hole in holes]
    is_surface = _is_surface(capture, positions.astype(np.float64), vertex[mesh.faces], holes, patches)
    chosen = [patch for patch, is_chosen in zip(patches, is_surface, strict=True) if is_chosen]
    if not chosen:
        return capture, 0
    added = np.concatenate(chosen)
    faces = np.concatenate([vertex[mesh.faces], added]).astype(np.int32)
    parts = (*geometry.parts, GeometryPart(PART, len(mesh.faces), len(added)))
    return replace(capture, geometry=CaptureGeometry(Mesh(positions, faces), parts)), len(chosen)


def _is_surface(
    capture: Capture, positions: Floats, corners: Ints, holes: Sequence[Hole], patches: Sequence[Ints]
) -> NDArray[np.bool_]:
    """Compute the mask (H,) of the holes to fill: holes in which photographs show a continued surface, and
    small holes that are visible in too few photographs.
    """
    random = np.random.default_rng(0x686F6C65)
    triangles = [t for hole, patch in zip(holes, patches, strict=True) for t in (patch, corners[hole.around])]
    points = np.concatenate([_points_on(positions[t], random) for t in triangles])
    whole = Mesh(positions.astype(np.float32), np.concatenate([corners, *patches]).astype(np.int32))
    level, spread = _seen_radiance(capture, mesh_scene(whole), points)
    shape = (len(holes), 2, NUM_POINTS)
    levels, seen = _medians(level.reshape(shape)), np.isfinite(spread).reshape(shape)
    with np.errstate(invalid="ignore"):  # NaN: not seen
        spreads = np.nan_to_num(spread).reshape(shape).sum(axis=2) / seen.sum(axis=2)
        is_continued = np.abs(levels[:, 0] - levels[:, 1]) <= MAX_CHANGE
        agrees = spreads[:, 0] <= np.maximum(MAX_SPREAD, MAX_SPREADS * spreads[:, 1])
    sides = np.array([np.ptp(positions[hole.loop], axis=0).max() for hole in holes])  # of bounding boxes
    is_small = sides <= MAX_UNSEEN_SIZE * _diagonal(positions)
    return np.asarray((is_continued & agrees) | (is_small & ~seen[:, 0].any(axis=1)))


def _diagonal(positions: NDArray) -> float:
    return float(np.linalg.norm(np.ptp(positions, axis=0)))


def _medians(values: Floats) -> Floats:
    """Compute the upper median over the last axis, ignoring NaN; NaN if all values are NaN."""
    ordered = np.sort(values, axis=-1)  # NaN last
    count = np.isfinite(values).sum(axis=-1)
    index = np.minimum(count // 2, values.shape[-1] - 1)
    return np.where(count > 0, np.take_along_axis(ordered, index[..., None], axis=-1)[..., 0], np.nan)


def _points_on(triangles: Floats, random: np.random.Generator) -> Floats:
    """Draw NUM_POINTS points (P, 3) uniformly over the area of triangles (K, 3, 3)."""
    area = np.linalg.norm(area_vectors(triangles.astype(np.float64)), axis=1) + 1e-12
    chosen = triangles[random.choice(len(area), NUM_POINTS, p=area / area.sum())]
    shares = random.dirichlet(np.ones(3), NUM_POINTS)
    return np.asarray((shares[..., None] * chosen).sum(axis=1), np.float64)


def _seen_radiance(capture: Capture, scene: mi.Scene, points: Floats) -> tuple[Floats, Floats]:
    """Return the median log radiance (P,) of points over the views in which they are visible, and its median
    absolute deviation (P,); NaN for points visible in fewer than :data:`MIN_VIEWS` views."""
    seen = np.full((len(capture.views), len(points)), np.nan, np.float32)
    for row, view in zip(seen, capture.views, strict=True):
        image = view.read()
        luminance = image.color @ LUMINANCE_WEIGHTS
        pixels, depth = view.camera.project(points)
        x, y = np.floor(np.clip(np.nan_to_num(pixels, nan=-1.0), -1, 1e9)).astype(np.int64).T
        height, width = luminance.shape
        seen_here = np.flatnonzero((depth > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height))
        seen_here = seen_here[image.valid_mask[y[seen_here], x[seen_here]]]
        seen_here = seen_here[_is_visible(scene, view.camera.position_m, points[seen_here])]
        row[seen_here] = np.log(np.maximum(luminance[y[seen_here], x[seen_here]], 1e-6))
    seen[:, np.isfinite(seen).sum(axis=0) < MIN_VIEWS] = np.nan
    level = _medians(seen.T.astype(np.float64))
    return level, _medians(np.abs(seen.T - level[:, None]))


def _is_visible(scene: mi.Scene, eye: Floats, points: Floats) -> NDArray[np.bool_]:
    """Compute the mask (P,) of the points that are visible from ``eye``."""
    import mitsuba as mi

    if not len(points):
        return np.zeros(0, np.bool_)
    offset = points - eye
    distance = np.linalg.norm(offset, axis=1)
    start = np.broadcast_to(eye, points.shape)
    origin, direction = mi.Point3f(vectors_from_rows(start)), vectors_from_rows(offset / distance[:, None])
    reach: Any = mi.Float(distance * (1 - _NEAR))
    ray = mi.Ray3f(mi.Ray3f(origin, direction), reach)
    return np.asarray(~scene.ray_test(ray).numpy().astype(bool), np.bool_)
