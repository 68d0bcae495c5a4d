# SPDX-License-Identifier: MIT
"""Reader and writer of PLY files, the triangle meshes of asset packages.

Packages contain binary little-endian PLY; texture coordinate v points up (see ``datagen.formats.asset``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.budget import Budget
from datagen.foundation.errors import InputError, input_error
from datagen.foundation.meshes.mesh import Mesh

MAX_VERTICES = 200_000_000  # headers that state more are refused before any data is read
_MAX_HEADER_BYTES = 64 * 1024
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_UV_NAMES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))
_PLY_REMEDY = "export the mesh as binary little-endian PLY with triangles"


def encode_ply(mesh: Mesh) -> bytes:
    """Encode a mesh as binary little-endian PLY: float x y z [nx ny nz] [u v], faces of int indices."""
    tables = (("x y z", mesh.positions), ("nx ny nz", mesh.normals), ("u v", mesh.uv))
    columns = [array for _, array in tables if array is not None]
    names = [name for text, array in tables if array is not None for name in text.split()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.positions)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header", ""]
    faces = np.empty(len(mesh.faces), dtype=[("n", "u1"), ("i", "<i4", 3)])
    faces["n"] = 3
    faces["i"] = mesh.faces
    vertices = np.concatenate([np.asarray(c, dtype="<f4") for c in columns], axis=1)
    encoded: bytes = "\n".join(header).encode("ascii") + vertices.tobytes() + faces.tobytes()
    return encoded


def read_ply(path: Path, budget: Budget | None = None) -> Mesh:
    """Read a PLY file. Raises :class:`InputError` if it is unreadable or refused by :func:`decode_ply`."""
    budget = budget or Budget(path)
    return decode_ply(budget.read_file(path, "a readable PLY file"), path, budget)


def decode_ply(data: bytes, where: str | Path, budget: Budget | None = None) -> Mesh:
    """Decode PLY bytes (little-endian binary or ASCII); polygons are split into fans of triangles.

    ``budget``: the enclosing import's budget, if any. Raises :class:`InputError` if the file is truncated, of
    another format or without positions. Indices and finiteness are not checked (see :func:`inspect_mesh`).
    """
    if budget is None:
        budget = Budget(where)
        budget.hold(len(data))
    end = data.find(b"\nend_header", 0, _MAX_HEADER_BYTES)  # a comment may contain the word
    newline = data.find(b"\n", end + 1)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise input_error(where, got="no PLY header", expected="a PLY file", remedy=_PLY_REMEDY)
    form, elements = _parse_header(data[:end].decode("ascii", "replace"), where)
    body = memoryview(data)[newline + 1 :]
    if form == "binary_little_endian":
        tables = _read_binary(body, elements, where, budget)
    elif form == "ascii":
        tables = _read_ascii(bytes(body), elements, where, budget)
    else:
        raise input_error(where, "format", form, "binary_little_endian", _PLY_REMEDY)
    vertex = tables.get("vertex", {})

    def columns(*names: str) -> NDArray[np.float32] | None:
        if not all(name in vertex for name in names):
            return None
        return np.stack([vertex[name] for name in names], axis=1, dtype=np.float32, casting="unsafe")

    positions = columns(*"xyz")
    if positions is None:
        raise input_error(where, "element vertex", sorted(vertex), "properties x, y and z", _PLY_REMEDY)
    faces = tables.get("face", {}).get("vertex_indices", np.zeros((0, 3), np.int32))
    uv = next((found for names in _UV_NAMES if (found := columns(*names)) is not None), None)
    mesh = Mesh(positions, faces.astype(np.int32).reshape(-1, 3), columns("nx", "ny", "nz"), uv)
    budget.spend("triangles", mesh.weight, Path(where).name)
    return mesh


# name, count, [(property, type, type of a list's count or "")]
_Element = tuple[str, int, list[tuple[str, str, str]]]


def _parse_header(header: str, where: str | Path) -> tuple[str, list[_Element]]:
    form = ""
    elements: list[_Element] = []
    for line in header.splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        try:
            if words[0] == "format":
                form = words[1]
            elif words[0] == "element":
                elements.append((words[1], int(words[2]), []))
            elif words[0] == "property" and words[1] == "list":
                elements[-1][2].append((words[4], _PLY_TYPES[words[3]], _PLY_TYPES[words[2]]))
            elif words[0] == "property":
                elements[-1][2].append((words[2], _PLY_TYPES[words[1]], ""))
        except (IndexError, KeyError) as error:
            raise input_error(
                where, "header", line.strip()[:80], f"a PLY header line ({error})", _PLY_REMEDY
            ) from None
        except ValueError:
            raise input_error(where, "header", line.strip()[:80], "a number", _PLY_REMEDY) from None
    for name, count, _ in elements:
        if not 0 <= count <= MAX_VERTICES:
            raise input_error(where, f"element {name}", count, f"0 to {MAX_VERTICES}")
    return form, elements


def _read_binary(
    body: memoryview, elements: list[_Element], where: str | Path, budget: Budget
) -> dict[str, dict[str, NDArray[Any]]]:
    tables: dict[str, dict[str, NDArray[Any]]] = {}
    offset = 0
    for name, count, properties in elements:
        lists = [p for p in properties if p[2]]
        if lists and (name != "face" or len(lists) != 1):
            raise input_error(where, f"element {name}", "lists", "lists only in 'face'", _PLY_REMEDY)
        dtype = [
            (p, f"<{kind}") if not size else (p, [("n", f"<{size}"), ("i", f"<{kind}", (3,))])
            for p, kind, size in properties
        ]
        names = [p for p, _, _ in properties]
        if not names or len(set(names)) != len(names):
            raise input_error(where, f"element {name}", names, "distinct properties", _PLY_REMEDY)
        record = np.dtype(dtype)
        if offset + count * record.itemsize <= len(body):
            table = np.frombuffer(body, record, count, offset)
            if not lists or bool((table[lists[0][0]]["n"] == 3).all()):
                tables[name] = {
                    "vertex_indices" if s else p: table[p]["i"] if s else table[p] for p, _, s in properties
                }
                offset += count * record.itemsize
                continue
        elif not lists:
            raise input_error(
                where, f"element {name}", "the file ends early", f"{count} entries", "export it again"
            )
        tables[name], offset = _read_polygons(body, offset, count, properties, where, budget)
    return tables


def _read_polygons(
    body: memoryview,
    offset: int,
    count: int,
    properties: list[tuple[str, str, str]],
    where: str | Path,
    budget: Budget,
) -> tuple[dict[str, NDArray[Any]], int]:
    """Read faces of any size as fans of triangles; return their table and the offset of the next data."""
    triangles: list[tuple[int, int, int]] = []
    most = budget.allowed("triangles")
    try:
        for _ in range(count):
            for _, kind, size in properties:
                if not size:
                    offset += np.dtype(kind).itemsize
                    continue
                num = int(np.frombuffer(body, f"<{size}", 1, offset)[0])
                if num < 0:  # numpy would read -1 as all remaining values
                    raise ValueError
                offset += np.dtype(size).itemsize
                corners = np.frombuffer(body, f"<{kind}", num, offset).tolist()
                offset += np.dtype(kind).itemsize * num
                triangles += [(corners[0], corners[k], corners[k + 1]) for k in range(1, num - 1)]
            if len(triangles) > most:
                raise budget.exceeded("triangles", len(triangles), Path(where).name)
    except InputError:
        raise
    except ValueError:
        raise input_error(
            where, "element face", "the file ends early", f"{count} faces", "export it again"
        ) from None
    return {"vertex_indices": np.array(triangles, np.int64).reshape(-1, 3)}, offset


def _read_ascii(
    body: bytes, elements: list[_Element], where: str | Path, budget: Budget
) -> dict[str, dict[str, NDArray[Any]]]:
    lines = filter(str.strip, body.decode("ascii", "replace").splitlines())
    tables: dict[str, dict[str, NDArray[Any]]] = {}
    try:
        for name, count, properties in elements:
            rows = [next(lines).split() for _ in range(count)]
            sizes = [size for _, _, size in properties]
            if any(sizes):
                start = next(k for k, size in enumerate(sizes) if size)  # single numbers before the list
                rows = [row[start:] for row in rows]
                num_triangles = sum(max(0, int(r[0]) - 2) for r in rows)
                if num_triangles > budget.allowed("triangles"):
                    raise budget.exceeded("triangles", num_triangles, Path(where).name)
                triangles = [(int(r[1]), int(r[k]), int(r[k + 1])) for r in rows for k in range(2, int(r[0]))]
                tables[name] = {"vertex_indices": np.array(triangles, np.int64).reshape(-1, 3)}
            else:
                table = np.array(rows, np.float64).reshape(count, len(properties))
                tables[name] = {p: table[:, k] for k, (p, _, _) in enumerate(properties)}
    except InputError:
        raise
    except (StopIteration, ValueError, IndexError):
        raise input_error(
            where, "body", "numbers missing or unreadable", "the numbers that the header states"
        ) from None
    return tables
