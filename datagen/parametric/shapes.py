# SPDX-License-Identifier: MIT
"""Solids as triangle meshes in metres, Z up, with UVs in metres.

Shapes of arrays: n vertices, m triangles. Wood grain runs along u. Solids are closed, with faces
counter-clockwise seen from outside. ``at`` is the centre of the base unless stated otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.axes import rotation
from datagen.foundation.meshes.mesh import area_vectors, unit_vectors

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Point = tuple[float, float, float]
_SHARP_COSINE = math.cos(math.radians(40.0))  # sharper corners of a profile are not smoothed
_ORIGIN: Point = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Shape:
    """A triangle mesh: ``points`` and ``normals`` (n, 3), ``uv`` (n, 2), ``faces`` (m, 3).

    With ``is_print``, the UVs cover [0, 1] exactly once, for an image.
    """

    points: Floats
    normals: Floats
    uv: Floats
    faces: Ints
    is_print: bool = False

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Shape:
        return replace(self, points=self.points + np.array([x, y, z]))

    def turned(self, axis: str, degrees: float) -> Shape:
        """Return the shape rotated right-handed about the axis ``x``, ``y`` or ``z`` through the origin."""
        matrix = rotation(axis, math.radians(degrees))
        return replace(self, points=self.points @ matrix.T, normals=self.normals @ matrix.T)

    def shifted_uv(self, u: float, v: float) -> Shape:
        """Return the shape with shifted UVs, for another section of its pattern; prints are unchanged."""
        return self if self.is_print else replace(self, uv=self.uv + np.array([u, v]))

    @property
    def bounds(self) -> Floats:
        """Lower and upper corner (2, 3) of the bounding box."""
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])


def middles(length: float, count: int) -> list[float]:
    """Return the middles of ``count`` equal intervals of [-length/2, length/2]."""
    return [-length / 2 + (k + 0.5) * length / count for k in range(count)]


def joined(shapes: Sequence[Shape]) -> Shape:
    """Return one shape with the triangles of all ``shapes``."""
    starts = np.cumsum([0] + [len(s.points) for s in shapes[:-1]])
    return Shape(
        np.concatenate([s.points for s in shapes]),
        np.concatenate([s.normals for s in shapes]),
        np.concatenate([s.uv for s in shapes]),
        np.concatenate([s.faces + start for s, start in zip(shapes, starts, strict=True)]),
        shapes[0].is_print,
    )


@lru_cache(maxsize=1)
def _box_topology() -> tuple[Ints, Ints, Ints]:
    """Return faces (44, 3), and per vertex normal axis (24,) and corner signs (24, 3), of a bevelled box."""
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    axis_sign = [(a, s) for a in range(3) for s in (-1, 1)]
    vertex: dict[tuple[int, tuple[int, ...]], int] = {}
    place: list[tuple[int, list[int]]] = []
    for a, s in axis_sign:
        for sb, sc in signs.tolist():
            corner = [0, 0, 0]
            corner[a], corner[(a + 1) % 3], corner[(a + 2) % 3] = s, sb, sc
            vertex[a, tuple(corner)] = len(place)
            place.append((a, corner))
    points = np.array([[c * (1.0 if k == a else 0.8) for k, c in enumerate(corner)] for a, corner in place])
    polygons = [tuple(range(4 * k, 4 * k + 4)) for k in range(6)]
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    for c in corners:
        for e in range(3):
            if c[e] == -1:
                other = list(c)
                other[e] = 1
                a, b = (e + 1) % 3, (e + 2) % 3
                polygons.append(
                    (vertex[a, c], vertex[a, tuple(other)], vertex[b, tuple(other)], vertex[b, c])
                )
        polygons.append((vertex[0, c], vertex[1, c], vertex[2, c]))
    faces = []
    for polygon in polygons:
        p = points[list(polygon)]
        outward = np.cross(p[1] - p[0], p[2] - p[0]) @ p.mean(axis=0)
        ring = polygon if outward > 0 else polygon[::-1]
        faces += [(ring[0], ring[k], ring[k + 1]) for k in range(1, len(ring) - 1)]
    return np.array(faces), np.array([a for a, _ in place]), np.array([corner for _, corner in place])


def box(size: Point, at: Point = _ORIGIN, bevel: float = 0.003, grain: int | None = None) -> Shape:
    """Make a smooth-shaded box with bevelled edges; u runs along axis ``grain`` (default: the longest)."""
    half = 0.5 * np.array(size, dtype=np.float64)
    r = min(bevel, 0.45 * float(half.min()))
    faces, axis, corner = _box_topology()
    is_axis = np.arange(3)[None] == axis[:, None]
    local = corner * np.where(is_axis, half, half - r)
    normals = np.where(is_axis, corner, 0).astype(np.float64)
    uv = _box_uv(local, normals, int(np.argmax(half)) if grain is None else grain, half)
    flat_faces = faces if r > 0 else faces[:12]  # the faces of a zero bevel would have no area
    return Shape(local + np.array(at) + np.array([0.0, 0.0, half[2]]), normals, uv, flat_faces)


def _box_uv(points: Floats, normals: Floats, grain: int, half: Floats) -> Floats:
    """Return UVs (n, 2) by box projection; u follows the grain or, on faces across it, the longer side."""
    uv = np.zeros((len(points), 2))
    axis = np.argmax(np.abs(normals), axis=1)
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        along = grain if grain in (b, c) else (b if half[b] >= half[c] else c)
        rows = axis == a
        facing = np.sign(normals[rows, a])
        if along == b:
            uv[rows] = np.stack([points[rows, b], facing * points[rows, c]], axis=1)
        else:
            uv[rows] = np.stack([points[rows, c], -facing * points[rows, b]], axis=1)
    return uv


def rounded_box(
    size: Point, radius: float, at: Point = _ORIGIN, segments: int = 2, bulge: float = 0.0
) -> Shape:
    """Make a box with rounded edges, whose two largest faces bulge by ``bulge`` metres as on a cushion."""
    half = 0.5 * np.array(size, dtype=np.float64)
    r = min(radius, 0.98 * float(half.min()))
    angles = np.linspace(-math.pi / 4, 0, segments + 1)
    inner = 3 if bulge else 0
    thin = int(np.argmin(half))
    shapes = []
    for a, s in product(range(3), (-1.0, 1.0)):
        b, c = (a + 1) % 3, (a + 2) % 3
        grids = []
        for k in (b, c):
            flat = half[k] - r
            middle = np.linspace(-flat, flat, inner + 2)[1:-1]
            base = np.concatenate([np.full(segments + 1, -flat), middle, np.full(segments + 1, flat)])
            grids.append((base, np.concatenate([angles, np.zeros(inner), -angles[::-1]])))
        (pb, ab), (pc, ac) = grids
        direction = np.zeros((len(pc), len(pb), 3))
        direction[..., a] = s
        direction[..., b] = np.tan(ab)[None]
        direction[..., c] = np.tan(ac)[:, None]
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        points = r * direction
        points[..., a] += s * (half[a] - r)
        points[..., b] += pb[None]
        points[..., c] += pc[:, None]
        sheet = _lattice(points, direction, (pb + r * ab)[None] * s, (pc + r * ac)[:, None])
        shapes.append(sheet if s > 0 else replace(sheet, faces=sheet.faces[:, ::-1]))
    shape = joined(shapes)
    points = shape.points
    if bulge:
        others = [k for k in range(3) if k != thin]
        share = np.clip(1 - (points[:, others] / half[others]) ** 2, 0, 1).prod(axis=1)
        points = points.copy()
        points[:, thin] += bulge * share * np.sign(points[:, thin]) * np.abs(points[:, thin]) / half[thin]
        shape = smooth(replace(shape, points=points))
    return shape.moved(at[0], at[1], at[2] + half[2])


def _lattice_faces(rows: int, columns: int) -> Ints:
    """Return the triangles (m, 3) of a lattice, counter-clockwise if columns run along x and rows along y."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.concatenate(
        [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    )


def _lattice(points: Floats, normals: Floats, u: Floats, v: Floats) -> Shape:
    """Return the surface through points (rows, columns, 3); ``u`` and ``v`` broadcast to (rows, columns)."""
    uv = np.stack(np.broadcast_arrays(u, v), axis=-1).reshape(-1, 2)
    faces = _lattice_faces(*points.shape[:2])
    return Shape(points.reshape(-1, 3), normals.reshape(-1, 3), uv, faces)


def smooth(shape: Shape) -> Shape:
    """Return the shape with area-weighted vertex normals, averaged over coincident vertices."""
    _, spot = np.unique(np.round(shape.points, 7), axis=0, return_inverse=True)
    spot = spot.reshape(-1)
    cross = area_vectors(shape.points[shape.faces])
    total = np.zeros((int(spot.max()) + 1, 3))
    for k in range(3):
        np.add.at(total, spot[shape.faces[:, k]], cross)
    return replace(shape, normals=unit_vectors(total)[spot])


def grid(points: Floats) -> Shape:
    """Make a smooth sheet through points (rows, columns, 3), the first at the bottom left of its front."""
    along = np.linalg.norm(np.diff(points, axis=1), axis=2).mean(axis=0)
    up = np.linalg.norm(np.diff(points, axis=0), axis=2).mean(axis=1)
    u, v = np.concatenate([[0.0], np.cumsum(along)]), np.concatenate([[0.0], np.cumsum(up)])
    return without_slivers(smooth(_lattice(points, np.zeros_like(points), u[None], v[:, None])))


def flipped(shape: Shape) -> Shape:
    """Return the shape with reversed winding and normals, so that the front of a sheet becomes its back."""
    return replace(shape, normals=-shape.normals, faces=shape.faces[:, ::-1])


def without_slivers(shape: Shape) -> Shape:
    """Return the shape without triangles of zero area."""
    area = np.linalg.norm(area_vectors(shape.points[shape.faces]), axis=1)
    return replace(shape, faces=shape.faces[area > 1e-12])


def lathe(profile: Sequence[tuple[float, float]], at: Point = _ORIGIN, segments: int = 24) -> Shape:
    """Make a body of revolution about z from a ``profile`` of (radius, height) pairs.

    The profile starts at the foot and runs up the outside, then down the inside, if any. u runs along it, v
    around z. Corners sharper than 40 degrees are not smoothed.
    """
    steps = np.array(profile, dtype=np.float64)
    steps[np.abs(steps[:, 0]) < 1e-9, 0] = 0.0  # the rounding error of cos(90 degrees) would leave a hole
    edges = np.diff(steps, axis=0)
    unit = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    runs, start = [], 0
    for k in range(1, len(unit) + 1):
        if k == len(unit) or float(unit[k] @ unit[k - 1]) < _SHARP_COSINE:
            runs.append((start, k))
            start = k
    angle = np.linspace(0, 2 * math.pi, segments + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    circle[-1] = circle[0]
    widest = float(steps[:, 0].max())
    shapes, length = [], 0.0
    for first, last in runs:
        ring = steps[first : last + 1]
        side = np.stack([unit[first:last, 1], -unit[first:last, 0]], axis=1)  # outward in (r, z)
        mean = np.concatenate([side[:1], 0.5 * (side[1:] + side[:-1]), side[-1:]])
        mean /= np.linalg.norm(mean, axis=1, keepdims=True)
        run = np.linalg.norm(np.diff(ring, axis=0), axis=1)
        u = length + np.concatenate([[0.0], np.cumsum(run)])
        length = float(u[-1])
        points = np.empty((len(ring), segments + 1, 3))
        points[..., :2] = ring[:, None, :1] * circle[None]
        points[..., 2] = ring[:, None, 1]
        normals = np.empty_like(points)
        normals[..., :2] = mean[:, None, :1] * circle[None]
        normals[..., 2] = mean[:, None, 1]
        shapes.append(_lattice(points, normals, u[:, None], (angle * widest)[None]))
    return without_slivers(joined(shapes)).moved(*at)


def frame(width: float, height: float, bar: float, depth: float, at: Point) -> list[Shape]:
    """Make a rectangular frame: two level bars of width ``bar``, two uprights between them, 4 mm bevels."""
    x, y, z = at
    levels, sides = (z, z + height - bar), ((width - bar) / 2 * side for side in (-1, 1))
    across = [box((width, depth, bar), (x, y, level), 0.004, grain=0) for level in levels]
    size = (bar, depth, height - 2 * bar)
    return across + [box(size, (x + side, y, z + bar), 0.004, grain=2) for side in sides]


def cylinder(
    radius: float, height: float, at: Point = _ORIGIN, segments: int = 20, bevel: float = 0.002
) -> Shape:
    """Make a cylinder along z with bevelled rims."""
    b = min(bevel, 0.4 * radius, 0.4 * height)
    r, h = radius, height
    return lathe([(0, 0), (r - b, 0), (r, b), (r, h - b), (r - b, h), (0, h)], at, segments)


def ball(radius: float, at: Point = _ORIGIN, segments: int = 16) -> Shape:
    """Make a sphere whose lowest point is ``at``."""
    angle = np.linspace(-math.pi / 2, math.pi / 2, segments // 2 + 1)
    return lathe([(radius * math.cos(a), radius + radius * math.sin(a)) for a in angle], at, segments)


def tube(path: Sequence[Point], radius: float, segments: int = 8) -> Shape:
    """Make a round bar along a path of points, with flat ends; u runs along the bar."""
    points = np.array(path, dtype=np.float64)
    ahead = np.gradient(points, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead[0], [0.0, 0.0, 1.0] if abs(ahead[0, 2]) < 0.9 else [1.0, 0.0, 0.0])
    rings, normals = [], []
    angle = np.linspace(0, 2 * math.pi, segments + 1)
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    turn[-1] = turn[0]
    for place, forward in zip(points, ahead, strict=True):
        side = side - (side @ forward) * forward
        side /= np.linalg.norm(side)
        other = np.cross(forward, side)
        normal = turn[:, :1] * side + turn[:, 1:] * other
        rings.append(place + radius * normal)
        normals.append(normal)
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    body = _lattice(np.array(rings), np.array(normals), run[:, None], (angle * radius)[None])
    return joined([_wound(body), _cap(rings[0][:-1], -ahead[0]), _cap(rings[-1][:-1], ahead[-1])])


def _wound(shape: Shape) -> Shape:
    """Return the shape with each triangle wound to agree with its vertex normals."""
    cross = area_vectors(shape.points[shape.faces])
    inward = (cross * shape.normals[shape.faces].mean(axis=1)).sum(axis=1) < 0
    faces = np.where(inward[:, None], shape.faces[:, ::-1], shape.faces)
    return replace(shape, faces=faces)


def _cap(rim: Floats, normal: Floats) -> Shape:
    faces = np.array([(0, k, k + 1) for k in range(1, len(rim) - 1)])
    side = (rim[0] - rim.mean(axis=0)) / np.linalg.norm(rim[0] - rim.mean(axis=0))
    uv = np.stack([(rim - rim[0]) @ side, (rim - rim[0]) @ np.cross(normal, side)], axis=1)
    return _wound(Shape(rim, np.broadcast_to(normal, rim.shape).copy(), uv, faces))


def flat(quads: Floats, is_print: bool = False) -> Shape:
    """Make flat-shaded quads (q, 4, 3); u runs along the first edge of each."""
    a, b, d = quads[:, 0], quads[:, 1], quads[:, 3]
    normal = np.cross(b - a, d - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    u = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    v = np.cross(normal, u)
    if is_print:
        uv = np.tile(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), (len(quads), 1))
    else:
        uv = np.stack([np.einsum("qcx,qx->qc", quads, edge) for edge in (u, v)], axis=-1).reshape(-1, 2)
    start = 4 * np.arange(len(quads))[:, None]
    faces = np.concatenate([start + np.array([0, 1, 2]), start + np.array([0, 2, 3])])
    return Shape(quads.reshape(-1, 3), np.repeat(normal, 4, axis=0), uv, faces, is_print)


def loft(rings: Floats, caps: tuple[bool, bool] = (False, False)) -> Shape:
    """Make a smooth surface through closed rings (k, c, 3), counter-clockwise from above, lowest ring first.

    For a basin, further rings run down the inside. ``caps``: whether to close the first and the last ring.
    """
    shapes = [grid(np.concatenate([rings, rings[:, :1]], axis=1))]
    for is_capped, ring, sign in ((caps[0], rings[0], -1.0), (caps[1], rings[-1], 1.0)):
        if is_capped:
            shapes.append(_cap(ring, np.array([0.0, 0.0, sign])))
    return joined(shapes)


def rounded_ring(width: float, depth: float, radius: float, z: float, centre: tuple[float, float]) -> Floats:
    """Return a rounded rectangle at height z as a counter-clockwise ring (20, 3) of points."""
    r = min(radius, 0.499 * width, 0.499 * depth)
    points = []
    for k, (sx, sy) in enumerate(((1, -1), (1, 1), (-1, 1), (-1, -1))):
        for angle in np.linspace(-math.pi / 2, 0, 5) + k * math.pi / 2:
            x = centre[0] + sx * (0.5 * width - r) + r * math.cos(angle)
            points.append((x, centre[1] + sy * (0.5 * depth - r) + r * math.sin(angle), z))
    return np.array(points)
