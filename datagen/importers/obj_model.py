# SPDX-License-Identifier: MIT
"""Reader of OBJ models, one mesh per material, and of their material libraries (.mtl).

Polygons are triangulated and missing normals computed. In UVs, v points up. In array shapes, C is the number
of polygon corners, P of polygons and M of triangles.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.budget import Budget
from datagen.foundation.errors import input_error
from datagen.foundation.meshes.mesh import Mesh, area_vectors, compacted, unit_vectors
from datagen.foundation.meshes.obj import corner_indices, number_table

CREASE_COSINE = 0.5
"""Cosine of the crease angle, 60 degrees, below which edges within a smoothing group are smooth."""
MIRROR_GROUP = "sweethome3d_window_mirror"
_MAX_PAIRS = 1 << 22  # corner pairs in memory at once
_NORMAL_DIGITS = 5  # rounding lets corners share a vertex despite numerical error in their normals
_COLORS = {"kd": "diffuse", "ks": "specular", "ke": "emission"}

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Surface:
    """The faces of one material; ``is_mirror``: whether the file marks them as a mirror."""

    material: str
    is_mirror: bool
    mesh: Mesh


@dataclass(frozen=True)
class ObjModel:
    """Surfaces of an OBJ file, in its order and frame, and the names of its material libraries."""

    surfaces: tuple[Surface, ...]
    libraries: tuple[str, ...]


@dataclass
class _Statements:
    """Statements of an OBJ file; of each polygon: corner count, smoothing group, number of its surface."""

    positions: list[bytes] = field(default_factory=list)
    uvs: list[bytes] = field(default_factory=list)
    normals: list[bytes] = field(default_factory=list)
    corners: list[bytes] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    smoothing: list[int] = field(default_factory=list)
    owners: list[int] = field(default_factory=list)
    keys: dict[tuple[str, bool], int] = field(default_factory=dict)
    libraries: list[str] = field(default_factory=list)


def read_obj_model(data: bytes, where: str | Path, budget: Budget) -> ObjModel:
    """Parse the faces of an OBJ file. Raises :class:`InputError` if it is damaged or has no faces."""
    found = _sort_lines(data, budget)
    budget.spend("triangles", max(sum(found.counts) - 2 * len(found.counts), len(found.positions) // 3))
    try:
        tables = (found.positions, 3), (found.uvs, 2), (found.normals, 3)
        positions, uvs, normals = (number_table(lines, width, is_padded=True) for lines, width in tables)
        indices = corner_indices(found.corners, (len(positions), len(uvs), len(normals)))
    except (ValueError, IndexError, OverflowError) as error:
        raise input_error(where, "", str(error)[:200], "an intact OBJ file", "export it again") from None
    if not len(indices):
        raise input_error(where, got="no faces", expected="a model with a surface", remedy="export it again")
    if not np.isfinite(positions[indices[:, 0]]).all():
        raise input_error(
            where, got="NaN or infinite vertices", expected="finite numbers", remedy="repair it"
        )
    counts = np.array(found.counts)
    triangles, polygon = _triangulated(positions[indices[:, 0]], counts, budget)
    corner = indices[triangles]  # (M, 3, 3): position, uv, normal
    once = _first_of_each(corner[:, :, 0])
    corner, polygon = corner[once], polygon[once]
    shading = _corner_normals(positions, normals, corner, np.array(found.smoothing)[polygon], budget)
    owner = np.array(found.owners)[polygon]
    surfaces = []
    for (material, is_mirror), number in found.keys.items():
        chosen = owner == number
        if chosen.any():
            mesh = _mesh(positions, uvs, corner[chosen], shading[chosen])
            surfaces.append(Surface(material, is_mirror, mesh))
    return ObjModel(tuple(surfaces), tuple(found.libraries))


def _sort_lines(data: bytes, budget: Budget) -> _Statements:
    found = _Statements()
    most = 3 * budget.allowed("triangles")
    material, is_mirror, smoothing, owner = "", False, 0, -1
    for line in data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        head = line[:2]
        if head == b"v ":
            found.positions.append(line)
        elif head == b"f ":
            if owner < 0:
                owner = found.keys.setdefault((material, is_mirror), len(found.keys))
            corners = line.split()
            if len(corners) > 3:  # some files contain faces of two corners, which have no area
                found.corners += corners[1:]
                found.counts.append(len(corners) - 1)
                if len(found.corners) > most:
                    break
                found.smoothing.append(smoothing)
                found.owners.append(owner)
        elif head == b"vt":
            found.uvs.append(line)
        elif head == b"vn":
            found.normals.append(line)
        elif head == b"us" and line.startswith(b"usemtl"):
            material, owner = line[6:].decode("utf-8", "replace").strip(), -1
        elif head in (b"g ", b"o "):
            is_mirror, owner = line[2:].strip().decode("utf-8", "replace").startswith(MIRROR_GROUP), -1
        elif head == b"s ":
            word = line[2:].strip()
            smoothing = int(word) if word.isdigit() else int(word == b"on")
        elif head == b"mt" and line.startswith(b"mtllib"):
            found.libraries.append(line[6:].decode("utf-8", "replace").strip())
    return found


def _triangulated(points: Floats, counts: Ints, budget: Budget) -> tuple[Ints, Ints]:
    """Return the triangles (M, 3) as corner indices, and the polygon index (M,) of each.

    ``points`` (C, 3): positions of the corners; ``counts`` (P,): number of corners of each polygon.
    """
    starts = np.cumsum(counts) - counts
    threes, fours = np.flatnonzero(counts == 3), np.flatnonzero(counts == 4)
    parts = [starts[threes][:, None] + [0, 1, 2]]
    polygons = [threes]
    first = starts[fours]
    if len(fours):
        quad = points[first[:, None] + np.arange(4)]
        even = area_vectors(quad[:, [0, 1, 2]]), area_vectors(quad[:, [0, 2, 3]])
        odd = area_vectors(quad[:, [1, 2, 3]]), area_vectors(quad[:, [1, 3, 0]])
        # only one diagonal splits a concave quadrilateral into triangles of equal winding
        is_odd = (even[0] * even[1]).sum(axis=1) < 0
        is_odd &= (odd[0] * odd[1]).sum(axis=1) > 0
        split = np.where(is_odd[:, None], [1, 2, 3, 1, 3, 0], [0, 1, 2, 0, 2, 3])
        parts.append((first[:, None] + split).reshape(-1, 3))
        polygons.append(np.repeat(fours, 2))
    for polygon in np.flatnonzero(counts > 4):
        start, count = int(starts[polygon]), int(counts[polygon])
        ears = triangulate(points[start : start + count], budget)
        parts.append(start + ears)
        polygons.append(np.full(len(ears), polygon))
    triangles, polygon_of = np.concatenate(parts), np.concatenate(polygons)
    order = np.argsort(polygon_of, kind="stable")
    return triangles[order], polygon_of[order]


def triangulate(points: Floats, budget: Budget) -> Ints:
    """Split a planar polygon (K, 3) without holes into triangles (K - 2, 3) of indices, by ear clipping."""
    ring = np.arange(len(points))
    following = np.roll(points, -1, axis=0)
    normal = np.cross(points - points[0], following - points[0]).sum(axis=0)  # Newell's method
    axis = int(np.abs(normal).argmax())
    flat = np.delete(points, axis, axis=1)
    if (normal[axis] < 0) != (axis == 1):  # makes the winding positive; dropping y mirrors the plane
        flat = flat * [1.0, -1.0]
    before, after = flat - np.roll(flat, 1, axis=0), np.roll(flat, -1, axis=0) - flat
    turns = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    if (turns >= 0).all():
        k = np.arange(1, len(points) - 1)
        return np.stack([np.zeros_like(k), k, k + 1], axis=1)
    ears: list[tuple[int, int, int]] = []
    while len(ring) > 3:
        cut = next((k for k in range(len(ring)) if _is_ear(flat, ring, k, budget)), None)
        if cut is None:  # the polygon intersects itself: the rest becomes a fan
            break
        ears.append((ring[cut - 1], ring[cut], ring[(cut + 1) % len(ring)]))
        ring = np.delete(ring, cut)
    ears += [(ring[0], ring[k], ring[k + 1]) for k in range(1, len(ring) - 1)]
    return np.array(ears, dtype=np.int64)


def _is_ear(flat: Floats, ring: Ints, k: int, budget: Budget) -> bool:
    budget.spend("pairs", len(ring), "a concave polygon")
    corners = [k - 1, k, (k + 1) % len(ring)]
    a, b, c = flat[ring[corners]]

    def side(p: Floats, q: Floats, r: Floats) -> Floats:
        return (q[0] - p[0]) * (r[..., 1] - p[1]) - (q[1] - p[1]) * (r[..., 0] - p[0])

    if side(a, b, c) <= 0:
        return False
    others = flat[np.delete(ring, corners)]
    return not bool(((side(a, b, others) > 0) & (side(b, c, others) > 0) & (side(c, a, others) > 0)).any())


def _first_of_each(faces: Ints) -> NDArray[np.bool_]:
    """Return the mask (M,) of triangles that do not repeat an earlier one in either winding.

    Models repeat faces to make them visible from behind; here, surfaces are two-sided.
    """
    keys = np.sort(faces, axis=1)
    order = np.lexsort(keys.T)
    is_new = np.ones(len(keys), dtype=bool)
    is_new[order[1:]] = (keys[order[1:]] != keys[order[:-1]]).any(axis=1)
    return is_new


def _corner_normals(
    positions: Floats, normals: Floats, corner: Ints, smoothing: Ints, budget: Budget
) -> Floats:
    """Return corner normals (M, 3 corners, 3), from the file if valid, else from :func:`creased`."""
    unit = unit_vectors(area_vectors(positions[corner[:, :, 0]]))
    named = corner[:, :, 2]
    if len(normals):
        given = normals[np.maximum(named, 0)]
        size = np.linalg.norm(given, axis=2, keepdims=True)
        sound = (named >= 0) & np.isfinite(size[..., 0]) & (size[..., 0] > 1e-6)
        if sound.all():
            return given / size
    else:
        given, size = np.zeros((*corner.shape[:2], 3)), np.ones((*corner.shape[:2], 1))
        sound = np.zeros(corner.shape[:2], dtype=bool)
    made = creased(positions, corner[:, :, 0], unit, smoothing, budget)
    return np.where(sound[..., None], given / np.maximum(size, 1e-300), made)


def creased(positions: Floats, faces: Ints, unit: Floats, smoothing: Ints, budget: Budget) -> Floats:
    """Return corner normals (M, 3 corners, 3) of ``faces`` (M, 3) with unit normals ``unit`` (M, 3).

    Each is the angle-weighted mean over those faces at the vertex that are in the same smoothing group
    (``smoothing``, (M,)) and within 60 degrees of the corner's face; faces of group 0 are flat.
    """
    made = np.repeat(unit[:, None], 3, axis=1)
    chosen = np.flatnonzero(smoothing > 0)
    if not len(chosen):
        return made
    points = positions[faces[chosen]]
    angle = np.empty((len(chosen), 3))
    for k in range(3):
        a, b = points[:, (k + 1) % 3] - points[:, k], points[:, (k + 2) % 3] - points[:, k]
        angle[:, k] = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
    vertex = faces[chosen].ravel()
    order = np.argsort(vertex, kind="stable")
    _, first, count = np.unique(vertex[order], return_index=True, return_counts=True)
    budget.spend("pairs", int((count.astype(np.int64) ** 2).sum()), "smooth normals")
    first, count = np.repeat(first, count), np.repeat(count, count)  # per sorted corner
    normal, weight = np.repeat(unit[chosen], 3, axis=0)[order], angle.ravel()[order]
    group = np.repeat(smoothing[chosen], 3)[order]
    total = np.empty((len(order), 3))
    bounds = np.searchsorted(np.cumsum(count), np.arange(_MAX_PAIRS, count.sum() + _MAX_PAIRS, _MAX_PAIRS))
    low = 0
    for high in (*np.minimum(bounds + 1, len(order)), len(order)):
        if high <= low:
            continue
        sizes = count[low:high]
        starts = np.cumsum(sizes) - sizes
        one = np.repeat(np.arange(low, high), sizes)
        other = np.repeat(first[low:high], sizes) + np.arange(sizes.sum()) - np.repeat(starts, sizes)
        near = ((normal[one] * normal[other]).sum(axis=1) > CREASE_COSINE) & (group[one] == group[other])
        parts = normal[other] * (weight[other] * near)[:, None]
        total[low:high] = np.add.reduceat(parts, starts, axis=0)
        low = int(high)
    size = np.linalg.norm(total, axis=1, keepdims=True)
    smooth = np.where(size > 1e-6, total / np.maximum(size, 1e-300), normal)
    back = np.empty_like(smooth)
    back[order] = np.round(smooth, _NORMAL_DIGITS)
    made[chosen] = back.reshape(-1, 3, 3)
    return made


def _mesh(positions: Floats, uvs: Floats, corner: Ints, normals: Floats) -> Mesh:
    """Return a surface as a mesh, with UVs only if all its corners have finite ones."""
    flat = corner.reshape(-1, 3)
    uv = None
    if len(uvs) and (flat[:, 1] >= 0).all():
        found = uvs[flat[:, 1]].astype(np.float32)
        uv = found if np.isfinite(found).all() else None
    faces = np.arange(len(flat), dtype=np.int32).reshape(-1, 3)
    points = positions[flat[:, 0]].astype(np.float32)
    return compacted(Mesh(points, faces, normals.reshape(-1, 3).astype(np.float32), uv))


@dataclass
class PhongMaterial:
    """A material of an MTL file; ``maps``: arguments of its map statements by lower-case keyword."""

    diffuse: tuple[float, float, float] = (0.8, 0.8, 0.8)
    specular: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    exponent: float = 0.0
    opacity: float = 1.0
    illumination: int = 2
    maps: dict[str, str] = field(default_factory=dict)


def read_mtl(data: bytes, where: str | Path) -> dict[str, PhongMaterial]:
    """Parse an MTL file to materials by name. Raises :class:`InputError` for invalid numbers."""
    found: dict[str, PhongMaterial] = {}
    current = PhongMaterial()
    for raw in data.decode("utf-8", "replace").splitlines():
        keyword, _, rest = raw.strip().replace("\t", " ").partition(" ")
        keyword, rest = keyword.lower(), rest.strip()
        try:
            if keyword == "newmtl":
                current = found.setdefault(rest, PhongMaterial())
            elif keyword in _COLORS:
                setattr(current, _COLORS[keyword], _rgb(rest))
            elif keyword == "ns":
                current.exponent = _finite(rest)
            elif keyword == "d":
                current.opacity = _finite(rest.split()[-1])
            elif keyword == "tr":
                current.opacity = 1 - _finite(rest)
            elif keyword == "illum":
                current.illumination = int(rest.split()[0])
            elif keyword.startswith(("map_", "bump", "refl", "disp", "norm")):
                current.maps[keyword] = rest
        except (ValueError, IndexError):
            raise input_error(where, keyword, repr(rest), "numbers", "correct the MTL file") from None
    return found


def _finite(text: str) -> float:
    value = float(text.split()[0])
    if not np.isfinite(value):
        raise ValueError(text)
    return value


def _rgb(text: str) -> tuple[float, float, float]:
    numbers = [_finite(word) for word in text.split()[:3]]
    red, green, blue = numbers if len(numbers) == 3 else numbers * 3
    return red, green, blue
