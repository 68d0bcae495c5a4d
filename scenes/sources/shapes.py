# SPDX-License-Identifier: GPL-3.0-or-later
"""Modelling with arrays: functions return a :class:`Shape` in metres, Z up, with UVs in metres.

Shapes of arrays: n points, f faces, c face corners (sum of the sizes of all faces). UVs are lengths along the
surface, and a material's grain runs along u. ``unit_uv`` marks a unique UV layout in [0, 1] (prints, dials).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, pairwise
from operator import add

import bmesh
import numpy as np
from mathutils import Vector
from numpy.typing import ArrayLike, NDArray

from datagen.foundation.axes import rotation

Point = tuple[float, float, float]
Face = tuple[int, ...]


@dataclass(frozen=True)
class Shape:
    """Polygon mesh: ``points`` (n, 3) [m]; ``faces``, f tuples of point indices, counter-clockwise seen from
    outside; ``uvs`` (c, 2) by face corner.
    """

    points: NDArray
    faces: list[Face]
    uvs: NDArray
    unit_uv: bool = False

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Shape:
        return replace(self, points=self.points + np.array([x, y, z]))

    def turned(self, axis: str, degrees: float, by: Sequence[float] | NDArray | None = None) -> Shape:
        """The shape rotated counter-clockwise about a coordinate axis, then moved ``by`` (x, y, z)."""
        shape = replace(self, points=self.points @ rotation(axis, math.radians(degrees)).T)
        return shape if by is None else shape.moved(*by)

    def scaled(self, x: float, y: float | None = None, z: float | None = None) -> Shape:
        """The shape scaled about the origin; UVs remain in metres only if the scale is uniform."""
        factors = np.array([x, x if y is None else y, x if z is None else z])
        uvs = self.uvs if self.unit_uv else self.uvs * abs(np.prod(factors)) ** (1 / 3)
        shape = replace(self, points=self.points * factors, uvs=uvs)
        return shape.flipped() if np.prod(factors) < 0 else shape

    def flipped(self) -> Shape:
        """The shape with the winding of its faces reversed."""
        corners, start = [], 0
        for face in self.faces:
            corners.append(self.uvs[start : start + len(face)][::-1])
            start += len(face)
        return replace(self, faces=[face[::-1] for face in self.faces], uvs=np.concatenate(corners))

    def bent(self, mapping: Callable[[NDArray], NDArray]) -> Shape:
        """The shape with its points mapped by ``mapping``, (n, 3) -> (n, 3); UVs are unchanged."""
        return replace(self, points=mapping(self.points))

    def uv_turned(self) -> Shape:
        """The shape with its UVs, and thus its grain, rotated by 90 degrees."""
        return replace(self, uvs=self.uvs[:, ::-1] * np.array([1.0, -1.0]))

    def __add__(self, other: Shape) -> Shape:
        offset = len(self.points)
        faces = self.faces + [tuple(i + offset for i in face) for face in other.faces]
        if self.unit_uv != other.unit_uv:
            raise ValueError("cannot join shapes with unique and with metric UVs")
        return Shape(
            np.concatenate([self.points, other.points]),
            faces,
            np.concatenate([self.uvs, other.uvs]),
            self.unit_uv,
        )


def join(shapes: Sequence[Shape]) -> Shape:
    """Join shapes into one."""
    return reduce(add, shapes)


def face_normals(points: NDArray, faces: Sequence[Face]) -> NDArray:
    """Unit normals (f, 3) of arbitrary polygons, by Newell's method."""
    normals = np.zeros((len(faces), 3))
    for i, face in enumerate(faces):
        corners = points[list(face)]
        following = np.roll(corners, -1, axis=0)
        normals[i] = np.cross(corners, following).sum(axis=0)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def box_uvs(points: NDArray, faces: Sequence[Face], grain: int | None = None) -> NDArray:
    """Compute UVs (c, 2) [m] by box projection; on faces parallel to axis ``grain`` (default: the longest),
    u runs along it."""
    if grain is None:
        grain = int(np.argmax(np.ptp(points, axis=0)))
    uvs = []
    for normal, face in zip(face_normals(points, faces), faces, strict=True):
        axis = int(np.argmax(np.abs(normal)))
        first, second = [i for i in (0, 1, 2) if i != axis]
        if grain == second:
            first, second = second, first
        # an offset per direction of faces, so that the two ends of a board differ
        offset = np.array([0.0, 0.37 * axis + (0.19 if normal[axis] > 0 else 0.0)])
        uvs.append(points[list(face)][:, [first, second]] + offset)
    return np.concatenate(uvs)


def from_bmesh(mesh: bmesh.types.BMesh, grain: int | None = None) -> Shape:
    """Convert a bmesh to a shape with box-projected UVs, and free the bmesh."""
    mesh.verts.index_update()
    points = np.array([v.co[:] for v in mesh.verts])
    faces = [tuple(v.index for v in face.verts) for face in mesh.faces]
    mesh.free()
    return Shape(points, faces, box_uvs(points, faces, grain))


def box(
    size: Point,
    at: Point = (0.0, 0.0, 0.0),
    bevel: float = 0.003,
    segments: int = 1,
    grain: int | None = None,
) -> Shape:
    """Make a block with its bottom centre at ``at``, and edges bevelled in ``segments`` steps."""
    mesh = bmesh.new()
    bmesh.ops.create_cube(mesh, size=1.0)
    bmesh.ops.scale(mesh, vec=Vector(size), verts=mesh.verts)
    bevel = min(bevel, 0.45 * min(size))
    if bevel > 0:
        bmesh.ops.bevel(
            mesh, geom=list(mesh.edges), offset=bevel, segments=segments, profile=0.5, affect="EDGES"
        )
    return from_bmesh(mesh, grain).moved(at[0], at[1], at[2] + size[2] / 2)


def smooth_curve(points: ArrayLike, per_span: int = 6, closed: bool = False) -> NDArray:
    """Sample a uniform Catmull-Rom spline through ``points`` (k, d), with ``per_span`` steps per span."""
    p = np.asarray(points, dtype=float)
    if closed:
        p = np.concatenate([p[-1:], p, p[:2]])
    else:
        p = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    t = np.arange(per_span)[:, None] / per_span
    spans = []
    for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True):
        spans.append(
            0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        )
    curve = np.concatenate(spans)
    return curve if closed else np.concatenate([curve, p[-2:-1]])


def grid(points: NDArray, closed_u: bool = False, unit_uv: bool = False) -> Shape:
    """Quads over a lattice (rows, columns, 3). UVs are mean arc lengths, or in [0, 1] with ``unit_uv``.

    Seen from outside, u increases to the right by column and v upwards by row. ``closed_u`` joins the last
    column to the first.
    """
    rows, columns = points.shape[:2]
    wrapped = np.concatenate([points, points[:, :1]], axis=1) if closed_u else points
    steps_u = np.linalg.norm(np.diff(wrapped, axis=1), axis=2).mean(axis=0)
    steps_v = np.linalg.norm(np.diff(points, axis=0), axis=2).mean(axis=1)
    u = np.concatenate([[0.0], np.cumsum(steps_u)])
    v = np.concatenate([[0.0], np.cumsum(steps_v)])
    if unit_uv:
        u, v = u / u[-1], v / v[-1]
    faces: list[Face] = []
    uvs = []
    for r in range(rows - 1):
        for c in range(len(u) - 1):
            d = (c + 1) % columns
            faces.append((r * columns + c, r * columns + d, (r + 1) * columns + d, (r + 1) * columns + c))
            uvs += [(u[c], v[r]), (u[c + 1], v[r]), (u[c + 1], v[r + 1]), (u[c], v[r + 1])]
    return Shape(points.reshape(-1, 3), faces, np.array(uvs), unit_uv)


def without_degenerate(shape: Shape) -> Shape:
    """The shape with coincident points merged and faces of fewer than three distinct points removed."""
    keys = np.round(shape.points, 7) + 0.0
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces, uvs, start = [], [], 0
    for face in shape.faces:
        corners: list[int] = []
        kept: list[int] = []
        for k, i in enumerate(inverse.reshape(-1)[list(face)]):
            if int(i) not in corners:
                corners.append(int(i))
                kept.append(start + k)
        if len(corners) >= 3:
            faces.append(tuple(corners))
            uvs.append(shape.uvs[kept])
        start += len(face)
    return Shape(shape.points[first], faces, np.concatenate(uvs), shape.unit_uv)


def lathe(profile: ArrayLike, segments: int = 36, smooth: int = 0) -> Shape:
    """A body of revolution about z; ``profile`` (k, 2) is (radius, z), up the outside, then down the inside.

    Points on the axis close the shape. ``smooth``: number of spline steps per span; 0 for straight lines.
    """
    p = smooth_curve(profile, smooth) if smooth else np.asarray(profile, dtype=float)
    p = np.column_stack([np.maximum(p[:, 0], 0.0), p[:, 1]])
    angle = 2 * np.pi * np.arange(segments) / segments
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = np.empty((len(p), segments, 3))
    points[..., :2] = p[:, None, :1] * ring
    points[..., 2] = p[:, None, 1]
    return outward(without_degenerate(grid(points, closed_u=True)))


def vessel(
    outside: list[tuple[float, float]], wall: float, *, foot: float = 0.0, smooth: int = 3, segments: int = 34
) -> Shape:
    """A hollow body of revolution; ``outside`` is (radius, z) from base to rim, ``wall`` the thickness.

    ``foot``: height of a foot ring; ``smooth``: as in :func:`lathe`.
    """
    curve = smooth_curve(outside, smooth) if smooth else np.array(outside, dtype=float)
    tangent = np.gradient(curve, axis=0)
    inward = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    inner = curve + wall * inward / np.linalg.norm(inward, axis=1, keepdims=True)
    base = curve[0, 0]
    inner = inner[inner[:, 1] > wall * 1.1]
    inner[:, 0] = np.maximum(inner[:, 0], 0.002)
    top = curve[-1]
    rim = [
        (top[0] - 0.5 * wall * (1 - np.cos(a)), top[1] + 0.5 * wall * np.sin(a))
        for a in np.radians([45, 90, 135])
    ]
    foot_ring = (
        [(0, foot), (base - 3 * wall, foot), (base - 2.2 * wall, 0.0), (base - 0.4 * wall, 0.0)]
        if foot
        else [(0, 0), (base - 0.4 * wall, 0)]
    )
    floor = [(max(base - wall, 0.004) * 0.6, wall + foot), (0, wall + foot)]
    profile = [*foot_ring, *curve.tolist(), *rim, *inner[::-1].tolist(), *floor]
    return lathe(profile, segments)


def outward(shape: Shape) -> Shape:
    """Return the shape, flipped if its faces enclose a negative volume."""
    points = shape.points - shape.points.mean(axis=0)
    volume = 0.0
    for face in shape.faces:
        a = points[face[0]]
        for i, j in pairwise(face[1:]):
            volume += float(np.dot(a, np.cross(points[i], points[j])))
    return shape if volume >= 0 else shape.flipped()


def sphere(radius: float, at: Point = (0.0, 0.0, 0.0), segments: int = 24, squash: float = 1.0) -> Shape:
    """A sphere about ``at``, its height multiplied by ``squash``."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    profile = np.stack([radius * np.cos(latitude), radius * squash * np.sin(latitude)], axis=-1)
    profile[[0, -1], 0] = 0.0
    return lathe(profile, segments).moved(*at)


def cylinder(
    radius: float, height: float, at: Point = (0.0, 0.0, 0.0), bevel: float = 0.002, segments: int = 24
) -> Shape:
    """A cylinder with its bottom centre at ``at`` and bevelled rims."""
    b = min(bevel, 0.45 * radius, 0.45 * height)
    profile = [(0, 0), (radius - b, 0), (radius, b), (radius, height - b), (radius - b, height), (0, height)]
    return lathe(profile, segments).moved(*at)


def tube(
    path: ArrayLike, radius: ArrayLike, segments: int = 10, smooth: int = 0, closed: bool = False
) -> Shape:
    """A round bar along ``path`` (k, 3) with rounded ends; ``radius`` is a number or (k,)."""
    p = np.asarray(path, dtype=float)
    r = np.broadcast_to(np.asarray(radius, dtype=float), len(p))
    if smooth:
        curve = smooth_curve(np.column_stack([p, r]), smooth, closed)
        p, r = curve[:, :3], curve[:, 3]
    tangents = (
        np.roll(p, -1, axis=0) - np.roll(p, 1, axis=0) if closed else np.gradient(p, axis=0, edge_order=1)
    )
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side = np.cross(tangents[0], [0.0, 0.0, 1.0])
    if np.linalg.norm(side) < 1e-3:
        side = np.array([1.0, 0.0, 0.0])
    rings = []
    angle = 2 * np.pi * np.arange(segments) / segments
    for point, tangent, rho in zip(p, tangents, r, strict=True):
        side = side - tangent * (side @ tangent)  # parallel transport: no twist along the path
        side /= np.linalg.norm(side)
        up = np.cross(side, tangent)
        rings.append(point + rho * (np.cos(angle)[:, None] * up + np.sin(angle)[:, None] * side))
    lattice = np.array(rings)
    if closed:
        lattice = np.concatenate([lattice, lattice[:1]])
        return without_degenerate(grid(lattice, closed_u=True).uv_turned())
    start, end = _cap(lattice[0], -tangents[0], r[0]), _cap(lattice[-1], tangents[-1], r[-1])
    lattice = np.concatenate([start[::-1], lattice, end])
    return without_degenerate(grid(lattice, closed_u=True).uv_turned())


def mirrored(half: Sequence[Point]) -> list[Point]:
    """Return ``half``, then its mirror images in x = 0 in reverse order; points on the plane occur once."""
    return [*half, *[(-x, y, z) for x, y, z in half[::-1] if x]]


def hoop(radius: float, thickness: float, z: float, count: int, segments: int) -> Shape:
    """A torus about z at height ``z``; ``thickness``: radius of its tube; ``count`` x ``segments`` quads."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    path = [(radius * np.cos(a), radius * np.sin(a), z) for a in angles]
    return tube(path, thickness, segments, closed=True)


def _cap(ring: NDArray, outward: NDArray, radius: float) -> NDArray:
    centre = ring.mean(axis=0)
    bulge = 0.35 * radius
    inner = centre + 0.75 * (ring - centre) + outward * bulge * 0.8
    return np.stack([inner, np.broadcast_to(centre + outward * bulge, ring.shape)])


def loft(sections: ArrayLike, capped: bool = True) -> Shape:
    """A surface through closed rings (k, m, 3), counter-clockwise seen from the last, with caps or open."""
    rings = np.asarray(sections, dtype=float)
    if capped:
        ends = []
        for ring in (rings[0], rings[-1]):
            centre = ring.mean(axis=0)
            ends.append(np.stack([np.broadcast_to(centre, ring.shape), centre + 0.6 * (ring - centre)]))
        rings = np.concatenate([ends[0], rings, ends[1][::-1]])
    return outward(without_degenerate(grid(rings, closed_u=True)))


def extrude(outline: ArrayLike, height: float, bevel: float = 0.001, segments: int = 1) -> Shape:
    """A plate of counter-clockwise ``outline`` (k, 2) from z = 0 to ``height``, with bevelled edges."""
    mesh = bmesh.new()
    bottom = mesh.faces.new([mesh.verts.new((x, y, 0.0)) for x, y in np.asarray(outline)])
    top = bmesh.ops.extrude_face_region(mesh, geom=[bottom])
    bmesh.ops.translate(
        mesh, vec=(0, 0, height), verts=[v for v in top["geom"] if isinstance(v, bmesh.types.BMVert)]
    )
    bmesh.ops.recalc_face_normals(mesh, faces=mesh.faces)
    if bevel > 0:
        edges = [e for e in mesh.edges if e.calc_face_angle(0.0) > 0.5]
        bmesh.ops.bevel(mesh, geom=edges, offset=bevel, segments=segments, profile=0.5, affect="EDGES")
    return _in_fixed_order(from_bmesh(mesh))


def _in_fixed_order(shape: Shape) -> Shape:
    """Return the shape with sorted points and faces, and box-projected UVs.

    After an extrusion, Blender orders both by memory addresses, which differ between runs.
    """
    points = np.round(shape.points, 6) + 0.0
    order = np.lexsort(points.T[::-1])
    place = np.empty(len(order), dtype=int)
    place[order] = np.arange(len(order))
    faces = []
    for face in shape.faces:
        indices = [int(place[i]) for i in face]
        first = indices.index(min(indices))
        faces.append(tuple(indices[first:] + indices[:first]))
    faces.sort()
    return Shape(points[order], faces, box_uvs(points[order], faces))


def rounded_rectangle(width: float, depth: float, radius: float, steps: int = 4) -> list[tuple[float, float]]:
    """A counter-clockwise outline (x, y) centred at the origin; each corner has ``steps`` segments."""
    outline = []
    corners = (((1, 1), 0.0), ((-1, 1), 90.0), ((-1, -1), 180.0), ((1, -1), 270.0))
    for (sx, sy), start in corners:
        for angle in np.radians(start + np.linspace(0, 90, steps + 1)):
            x = sx * (width / 2 - radius) + radius * np.cos(angle)
            outline.append((x, sy * (depth / 2 - radius) + radius * np.sin(angle)))
    return outline


def rounded_ring(
    width: float, depth: float, radius: float, z: float, y: float = 0.0, steps: int = 5
) -> NDArray:
    """A :func:`rounded_rectangle` about (0, y) at height ``z``, (4 (steps + 1), 3), for :func:`loft`."""
    outline = np.array(rounded_rectangle(width, depth, radius, steps))
    return np.column_stack([outline[:, 0], outline[:, 1] + y, np.full(len(outline), z)])


def sheet(points: NDArray, thickness: float) -> Shape:
    """A closed sheet of ``thickness`` around a lattice (rows, columns, 3): curtains, leaves, cloth, rugs."""
    du, dv = np.gradient(points, axis=1), np.gradient(points, axis=0)
    normal = np.cross(du, dv)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    front, back = points + normal * thickness / 2, points - normal * thickness / 2
    face = grid(front)
    reverse = replace(face, points=back.reshape(-1, 3)).flipped()
    shape = face + reverse
    rows, columns = points.shape[:2]
    border = (
        [(0, c) for c in range(columns)]
        + [(r, columns - 1) for r in range(1, rows)]
        + [(rows - 1, c) for c in range(columns - 2, -1, -1)]
        + [(r, 0) for r in range(rows - 2, 0, -1)]
    )
    index = [r * columns + c for r, c in border]
    count = rows * columns
    uv_of = dict(zip(chain.from_iterable(face.faces), face.uvs, strict=True))
    faces, uvs = list(shape.faces), [shape.uvs]
    for i, j in zip(index, index[1:] + index[:1], strict=True):
        faces.append((i, i + count, j + count, j))
        inset = np.array([0.0, thickness])
        uvs.append(np.array([uv_of[i], uv_of[i] + inset, uv_of[j] + inset, uv_of[j]]))
    return Shape(shape.points, faces, np.concatenate(uvs))


def soft_box(
    size: Point,
    at: Point = (0.0, 0.0, 0.0),
    radius: float = 0.05,
    puff: Point = (0.0, 0.0, 0.02),
    steps: int = 9,
    wrinkle: float = 0.0,
    seed: int = 0,
) -> Shape:
    """An upholstered block with its bottom centre at ``at``, edges rounded to ``radius``, and swollen faces.

    ``puff``: swelling of the x, y and z faces at their centres [m]; ``wrinkle``: height of folds [m].
    """
    mesh = bmesh.new()
    bmesh.ops.create_cube(mesh, size=2.0)
    bmesh.ops.subdivide_edges(mesh, edges=list(mesh.edges), cuts=steps - 1, use_grid_fill=True)
    cube = from_bmesh(mesh)
    unit, faces = cube.points, cube.faces
    half = np.asarray(size) / 2
    # more lattice lines near the edges, where the surface curves
    unit = np.sign(unit) * np.sin(np.abs(unit) * np.pi / 2) ** 0.8
    p = unit * half
    core = np.clip(p, -(half - radius), half - radius)
    offset = p - core
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    p = np.where(length > 1e-9, core + offset / np.maximum(length, 1e-9) * radius, p)
    bulge = np.ones((len(p), 3))
    for axis in range(3):
        a, b = [i for i in range(3) if i != axis]
        window = (1 - unit[:, a] ** 2) * (1 - unit[:, b] ** 2)
        p[:, axis] += np.sign(unit[:, axis]) * (np.abs(unit[:, axis]) > 0.5) * puff[axis] * window
        bulge[:, axis] = window
    if wrinkle > 0:
        phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, 6)
        k = 2 * np.pi / np.array([0.23, 0.31, 0.17])
        wave = np.sin(p[:, 0] * k[0] + 2 * np.sin(p[:, 1] * k[1] + phase[0]) + phase[1])
        wave = wave + np.sin(p[:, 1] * k[2] + 1.5 * np.sin(p[:, 0] * k[1] + phase[2]) + phase[3])
        p[:, 2] += wrinkle * wave * bulge[:, 2] * np.sign(unit[:, 2]) * (np.abs(unit[:, 2]) > 0.5)
    return Shape(p, faces, box_uvs(p, faces)).moved(at[0], at[1], at[2] + size[2] / 2)


def pillow(size: Point, steps: int = 14, pinch: float = 0.07, wrinkle: float = 0.003, seed: int = 0) -> Shape:
    """A pillow on z = 0 with a thin seam and pointed corners; sides curve in by ``pinch`` half-widths."""
    t = np.linspace(-1, 1, 2 * steps + 1)
    t = np.sign(t) * np.sin(np.abs(t) * np.pi / 2)
    u, v = np.meshgrid(t, t)
    x = size[0] / 2 * u * (1 - pinch * (1 - v**2))
    y = size[1] / 2 * v * (1 - pinch * (1 - u**2))
    height = ((1 - u**2) * (1 - v**2)) ** 0.42
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, 4)
    fold = np.sin(7 * u + 3 * np.sin(2 * v + phase[0]) + phase[1]) * np.sin(6 * v + phase[2])
    z = size[2] / 2 * height + wrinkle * fold * height
    top = grid(np.stack([x, y, z], axis=-1))
    # the underside is flatter
    bottom = grid(np.stack([x, y, -0.8 * size[2] / 2 * height], axis=-1)).flipped()
    return without_degenerate(top + bottom).moved(z=0.8 * size[2] / 2)


def frame(
    width: float, height: float, bar: float, depth: float, at: Point, bevel: float = 0.004, segments: int = 1
) -> list[Shape]:
    """A frame with bottom centre ``at``: two level bars of width ``bar`` and two uprights between them."""
    x, y, z = at
    levels, sides = (z, z + height - bar), ((width - bar) / 2 * side for side in (-1, 1))
    across = [box((width, depth, bar), (x, y, level), bevel, segments, grain=0) for level in levels]
    size = (bar, depth, height - 2 * bar)
    return across + [box(size, (x + side, y, z + bar), bevel, segments, grain=2) for side in sides]


def panel(width: float, height: float, at: Point = (0.0, 0.0, 0.0)) -> Shape:
    """A rectangle that faces -Y, with its bottom centre at ``at`` and UVs from 0 to 1."""
    x, z = width / 2, height
    points = np.array([[-x, 0, 0], [x, 0, 0], [x, 0, z], [-x, 0, z]]) + np.asarray(at)
    return Shape(points, [(0, 1, 2, 3)], np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float), True)
