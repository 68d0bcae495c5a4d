# SPDX-License-Identifier: MIT
"""Conversion of Mitsuba shapes to meshes in local coordinates, with UVs whose v points up.

In Mitsuba, v of images and analytic shapes points down; the OBJ loader flips v by default, the PLY loader
does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.mitsuba.scene import SceneNode
from datagen.foundation.budget import Budget
from datagen.foundation.meshes.mesh import Mesh, compacted, flat_shaded, with_sound_normals
from datagen.foundation.meshes.obj import read_obj
from datagen.foundation.meshes.ply import read_ply

SUPPORTED_SHAPES = ("obj", "ply", "rectangle", "disk", "cube", "sphere", "cylinder")
FILE_SHAPES = ("obj", "ply")
_ROUND_SEGMENTS = 64


def shape_mesh(node: SceneNode, file: Path | None, budget: Budget) -> tuple[Mesh, int]:
    """Return the mesh of a shape before its ``to_world``, and the number of replaced normals.

    ``file``: mesh file of an ``obj`` or ``ply`` shape. Normals are those of the file or, if it has none,
    smooth; with ``face_normals``, they are flat. Raises :class:`InputError` for an unreadable file.
    """
    if node.type in FILE_SHAPES:
        assert file is not None
        mesh = read_obj(file, budget) if node.type == "obj" else read_ply(file, budget)
        is_v_up = bool(node.get("flip_tex_coords", node.type == "obj"))
    else:
        mesh, is_v_up = _ANALYTIC[node.type](node), False
        budget.spend("triangles", mesh.weight, node.where)
    if mesh.uv is not None and not is_v_up:
        mesh = replace(mesh, uv=np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], axis=1))
    if len(mesh.faces) == 0 or not np.isfinite(mesh.positions).all():
        return mesh, 0  # reported by the check of the finished package
    if bool(node.get("face_normals", False)):
        return compacted(flat_shaded(mesh)), 0
    return with_sound_normals(mesh)


def transformed_uv(uv: NDArray[np.float32], matrix: NDArray[np.float64]) -> NDArray[np.float32]:
    """Apply a texture transform (3, 3), defined for v pointing down, to UVs (N, 2) whose v points up."""
    down = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1).astype(np.float64)
    moved = down @ matrix[:2, :2].T + matrix[:2, 2]
    return np.stack([moved[:, 0], 1 - moved[:, 1]], axis=1).astype(np.float32)


def _f32(rows: object) -> NDArray[np.float32]:
    return np.asarray(rows, dtype=np.float32)


def _rectangle(_: SceneNode) -> Mesh:
    positions = _f32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    normals = _f32([[0, 0, 1]] * 4)
    return Mesh(positions, np.array([[0, 1, 2], [0, 2, 3]], np.int32), normals, (positions[:, :2] + 1) / 2)


def _disk(_: SceneNode) -> Mesh:
    """Return the unit disk with Mitsuba's UVs, (radius, angle / 2 pi)."""
    angle = np.arange(_ROUND_SEGMENTS + 1) / _ROUND_SEGMENTS * 2 * math.pi
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    positions = _f32(np.concatenate([rim, np.zeros((_ROUND_SEGMENTS, 3))]))
    turn = angle / (2 * math.pi)
    middle = (turn[:-1] + turn[1:]) / 2
    uv = _f32(np.concatenate([np.stack([turn * 0 + 1, turn], 1), np.stack([middle * 0, middle], 1)]))
    k = np.arange(_ROUND_SEGMENTS)
    faces = np.stack([k + _ROUND_SEGMENTS + 1, k, k + 1], axis=1).astype(np.int32)
    return Mesh(positions, faces, _f32([[0, 0, 1]] * len(positions)), uv)


_CUBE_CORNERS = (  # in Mitsuba's order, which its UVs require
    (1, -1, -1), (1, -1, 1), (-1, -1, 1), (-1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, 1, 1), (1, 1, 1),
    (1, -1, -1), (1, 1, -1), (1, 1, 1), (1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1), (-1, -1, 1),
    (-1, -1, 1), (-1, 1, 1), (-1, 1, -1), (-1, -1, -1), (1, 1, -1), (1, -1, -1), (-1, -1, -1), (-1, 1, -1),
)  # fmt: skip
_CUBE_NORMALS = ((0, -1, 0), (0, 1, 0), (1, 0, 0), (0, 0, 1), (-1, 0, 0), (0, 0, -1))


def _cube(_: SceneNode) -> Mesh:
    start = 4 * np.arange(6)[:, None]
    faces = np.concatenate([start + np.array([0, 1, 2]), start + np.array([3, 0, 2])]).astype(np.int32)
    uv = _f32([[0, 1], [1, 1], [1, 0], [0, 0]] * 6)
    return Mesh(_f32(_CUBE_CORNERS), faces, np.repeat(_f32(_CUBE_NORMALS), 4, axis=0), uv)


def _grid(columns: int, rows: int) -> NDArray[np.int32]:
    """Return two triangles for each cell of a (rows + 1) x (columns + 1) grid of vertices."""
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (row * (columns + 1) + column).ravel()
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    return np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)]).astype(np.int32)


def _sphere(node: SceneNode) -> Mesh:
    columns, rows = _ROUND_SEGMENTS, _ROUND_SEGMENTS // 2
    theta, phi = np.meshgrid(
        np.arange(rows + 1) / rows * math.pi, np.arange(columns + 1) / columns * 2 * math.pi, indexing="ij"
    )
    normal = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    normal = normal.reshape(-1, 3)
    uv = np.stack([phi.ravel() / (2 * math.pi), theta.ravel() / math.pi], axis=1)
    center, radius = np.asarray(node.get("center", (0, 0, 0))), float(node.get("radius", 1.0))
    mesh = Mesh(_f32(normal * radius + center), _grid(columns, rows), _f32(normal), _f32(uv))
    keep = mesh.areas() > 1e-12 * radius * radius  # triangles at the poles have no area
    return Mesh(mesh.positions, mesh.faces[keep], mesh.normals, mesh.uv)


def _cylinder(node: SceneNode) -> Mesh:
    start, end = np.asarray(node.get("p0", (0, 0, 0.0))), np.asarray(node.get("p1", (0, 0, 1.0)))
    axis = (end - start) / np.linalg.norm(end - start)
    # Mitsuba's frame around an axis (Duff et al. 2017), on which its UVs are based
    sign = 1.0 if axis[2] >= 0 else -1.0
    a = -1.0 / (sign + axis[2])
    side = np.array([1 + sign * axis[0] ** 2 * a, sign * axis[0] * axis[1] * a, -sign * axis[0]])
    other = np.array([axis[0] * axis[1] * a, axis[1] ** 2 * a + sign, -axis[1]])
    phi = np.arange(_ROUND_SEGMENTS + 1) / _ROUND_SEGMENTS * 2 * math.pi
    normal = np.cos(phi)[:, None] * side + np.sin(phi)[:, None] * other
    ring = normal * float(node.get("radius", 1.0))
    u = phi / (2 * math.pi)
    positions = np.concatenate([ring + end, ring + start])
    uv = np.concatenate([np.stack([u, u * 0 + 1], 1), np.stack([u, u * 0], 1)])
    normals = np.concatenate([normal, normal])
    return Mesh(_f32(positions), _grid(_ROUND_SEGMENTS, 1), _f32(normals), _f32(uv))


_ANALYTIC: dict[str, Callable[[SceneNode], Mesh]] = {
    "rectangle": _rectangle,
    "disk": _disk,
    "cube": _cube,
    "sphere": _sphere,
    "cylinder": _cylinder,
}
