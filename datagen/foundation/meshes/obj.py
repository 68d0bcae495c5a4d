# SPDX-License-Identifier: MIT
"""Reader of Wavefront OBJ files, each as one mesh; polygons are split into fans of triangles.

Groups, materials and lines are ignored, as by Mitsuba's loader. Texture coordinate v points up.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.budget import Budget
from datagen.foundation.errors import input_error
from datagen.foundation.meshes.mesh import Mesh

_BLOCK = 1 << 16  # number of lines split into words at once, since words take ten times the memory of lines


def read_obj(path: Path, budget: Budget | None = None) -> Mesh:
    """Read an OBJ file, merging equal corners. Raises :class:`InputError` if it is damaged or too large."""
    budget = budget or Budget(path)
    data = budget.read_file(path, "a readable OBJ file")
    positions: list[bytes] = []
    uvs: list[bytes] = []
    normals: list[bytes] = []
    faces: list[list[bytes]] = []
    for line in data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        line = line.lstrip()
        head = line[:2]
        if head == b"v " or head == b"v\t":
            positions.append(line)
        elif head == b"f " or head == b"f\t":
            faces.append(line.split()[1:])
        elif head == b"vt":
            uvs.append(line)
        elif head == b"vn":
            normals.append(line)
    num_triangles = sum(len(face) for face in faces) - 2 * len(faces)
    budget.spend("triangles", max(num_triangles, len(positions) // 3), path.name)
    try:
        tables = (number_table(positions, 3), number_table(uvs, 2), number_table(normals, 3))
        corners = _corners(faces, tuple(len(t) for t in tables))
    except (ValueError, IndexError, OverflowError) as error:
        raise input_error(path, "", str(error)[:200], "an intact OBJ file", "export it again") from None
    return _assemble(tables, corners)


def number_table(lines: list[bytes], width: int, *, is_padded: bool = False) -> NDArray[np.float64]:
    """Return the first ``width`` numbers after the keyword of each of K lines, (K, width).

    Missing numbers become 0 if ``is_padded``, else raise ``ValueError``, as invalid numbers do.
    """
    blocks = [_block(lines[k : k + _BLOCK], width, is_padded) for k in range(0, len(lines), _BLOCK)]
    return np.concatenate(blocks) if blocks else np.zeros((0, width))


def _block(lines: list[bytes], width: int, is_padded: bool) -> NDArray[np.float64]:
    tokens = b" ".join(lines).split()
    per_line = len(lines[0].split())
    if per_line > width and len(tokens) == per_line * len(lines):
        columns = [np.fromiter(map(float, tokens[k::per_line]), np.float64) for k in range(1, width + 1)]
        return np.stack(columns, axis=1)
    # rows of different lengths, such as colours on some vertices
    rows = [(line.split()[1:] + [b"0"] * (width if is_padded else 0))[:width] for line in lines]
    short = next((line for line, row in zip(lines, rows, strict=True) if len(row) < width), None)
    if short is not None:
        raise ValueError(f"{short.decode('ascii', 'replace').strip()[:80]!r} has too few numbers")
    return np.array([[float(word) for word in row] for row in rows])


def _corners(faces: list[list[bytes]], counts: tuple[int, ...]) -> NDArray[np.int64]:
    """Split faces into triangles; return their indices (M, 3 corners, 3) as in :func:`corner_indices`."""
    triangles: list[bytes] = []
    for face in faces:
        if len(face) < 3:
            raise ValueError(f"a face with {len(face)} corners")
        for k in range(1, len(face) - 1):
            triangles += (face[0], face[k], face[k + 1])
    return corner_indices(triangles, counts).reshape(-1, 3, 3)


def corner_indices(corners: list[bytes], counts: tuple[int, ...]) -> NDArray[np.int64]:
    """Parse corners of faces (``7/8/9``) to zero-based indices (C, 3) of position, uv and normal; -1: none.

    ``counts`` are the numbers of positions, uvs and normals. Raises ``ValueError`` for invalid indices.
    """
    if not corners:
        return np.zeros((0, 3), np.int64)
    numbers = b" ".join(corners).replace(b"//", b"/0/").replace(b"/", b" ").split()
    indices = np.zeros((len(corners), 3), np.int64)
    slashes = corners[0].count(b"/")
    is_even = slashes <= 2 and all(corner.count(b"/") == slashes for corner in corners)
    if is_even and len(numbers) == (slashes + 1) * len(corners):
        found = np.fromiter(map(int, numbers), np.int64)
        indices[:, : slashes + 1] = found.reshape(len(corners), -1)
    else:
        for row, corner in enumerate(corners):
            for column, number in enumerate(corner.split(b"/")[:3]):
                indices[row, column] = int(number) if number else 0
    for column, count in enumerate(counts):
        values = indices[:, column]
        given = values.copy()
        values[values < 0] += count + 1  # negative indices count from the end
        bad = (values > count) | (values < (1 if column == 0 else 0))
        if bad.any():
            raise ValueError(f"a face refers to entry {max(given[bad].tolist(), key=abs)} of {count}")
    return indices - 1


def _assemble(tables: tuple[NDArray[Any], NDArray[Any], NDArray[Any]], corners: NDArray[np.int64]) -> Mesh:
    flat = corners.reshape(-1, 3)
    if len(flat) == 0:
        return Mesh(tables[0].astype(np.float32), np.zeros((0, 3), np.int32))
    keys, inverse = np.unique(flat, axis=0, return_inverse=True)
    uv, normal = (
        tables[k][keys[:, k]].astype(np.float32) if (keys[:, k] >= 0).all() else None for k in (1, 2)
    )
    position = tables[0][keys[:, 0]].astype(np.float32)
    return Mesh(position, inverse.reshape(-1, 3).astype(np.int32), normal, uv)
