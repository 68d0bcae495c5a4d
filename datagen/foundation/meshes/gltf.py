# SPDX-License-Identifier: MIT
"""Reader of glTF 2.0 containers (.gltf, .glb): JSON, buffers, accessors, images and the node tree.

Buffers and images may be files in the document's folder, data URIs or parts of the binary chunk. Other files,
Draco and unknown required extensions are refused.
"""

from __future__ import annotations

import base64
import binascii
import struct
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.axes import affine
from datagen.foundation.budget import Budget
from datagen.foundation.documents import parse_json
from datagen.foundation.errors import InputError, input_error
from datagen.foundation.meshes.gltf_compressed import (
    BASIS,
    MESHOPT,
    is_ktx2,
    meshopt_of,
    png_of_basis,
    unpack_meshopt,
)
from datagen.foundation.paths import named_file

KNOWN_EXTENSIONS = frozenset(
    {
        "KHR_materials_specular", "KHR_materials_ior", "KHR_materials_emissive_strength",
        "KHR_materials_transmission", "KHR_materials_clearcoat", "KHR_materials_sheen",
        "KHR_materials_volume",
        "KHR_materials_anisotropy", "KHR_materials_iridescence", "KHR_materials_unlit", "KHR_lights_punctual",
        "KHR_texture_transform", "KHR_mesh_quantization", "EXT_texture_webp", "KHR_materials_variants",
        "KHR_materials_dispersion", BASIS, *MESHOPT,
    }
)  # fmt: skip
MAX_FILE_BYTES = 2 << 30
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
TRIANGLE_MODES = (4, 5, 6)  # list, strip, fan
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_MALFORMED = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, ArithmeticError)
_IMAGE_SUFFIX = {"image/png": ".png", "image/jpeg": ".jpg", "image/webp": ".webp"}


@dataclass(frozen=True)
class PlacedNode:
    """A node of the default scene and its transform (4, 4); ``root`` is the index of its topmost ancestor."""

    index: int
    root: int
    node: dict[str, Any]
    scene_from_node: NDArray[np.float64]

    @property
    def name(self) -> str:
        return str(self.node.get("name") or f"node_{self.index}")


class GltfFile:
    """An open glTF document. Referenced files must be in its folder or in the ``allowed`` folders.

    As a context manager, it removes temporary image files at exit and converts the Python errors that
    malformed documents cause in many places to :class:`InputError`.
    """

    def __init__(self, path: Path, budget: Budget | None = None, allowed: Sequence[Path] = ()):
        self.path = path
        self.folder = path.parent
        self.budget, self.allowed = budget or Budget(path), allowed
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        self._buffers: dict[int, bytes] = {}
        self._unpacked: dict[object, bytes] = {}
        self._images: dict[object, Path] = {}
        self._lists: dict[str, list[dict[str, Any]]] = {}
        self._binary = b""
        self.json = self._load()
        version = self.json.get("asset", {})
        version = version.get("version", "") if isinstance(version, dict) else ""
        if not str(version).startswith("2."):
            raise input_error(self.path, "asset.version", repr(version), "2.0", "export it as glTF 2.0")
        required = {str(name) for name in self._list("extensionsRequired")} - KNOWN_EXTENSIONS
        if required:
            got = ", ".join(sorted(required))
            raise self.error("extensionsRequired", got, "known extensions", "export it without them")

    def __enter__(self) -> GltfFile:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if self._temporary is not None:
            self._temporary.cleanup()
        if isinstance(error, _MALFORMED) and not isinstance(error, InputError):
            raise self.error("", repr(error)[:200], "a readable glTF file") from None

    def error(
        self, field: str, got: object, expected: str, remedy: str = "export the file again"
    ) -> InputError:
        return input_error(self.path, field, got, expected, remedy)

    def _list(self, key: str) -> list[Any]:
        value = self.json.get(key, [])
        if not isinstance(value, list):
            raise self.error(key, type(value).__name__, "a list")
        return value

    def items(self, key: str) -> list[dict[str, Any]]:
        """Return the top-level list ``key`` of the document, empty if absent."""
        if key not in self._lists:
            value = self._list(key)
            if not all(isinstance(v, dict) for v in value):
                raise self.error(key, "a list with other values", "a list of objects")
            self._lists[key] = value
        return self._lists[key]

    def item(self, key: str, index: object, user: str) -> dict[str, Any]:
        """Return entry ``index`` of the top-level list ``key``; errors name ``user``, the referring field."""
        entries = self.items(key)
        if not isinstance(index, int) or not 0 <= index < len(entries):
            raise self.error(user, index, f"an index below {len(entries)} into {key}")
        return entries[index]

    def _load(self) -> dict[str, Any]:
        if self.path.is_file() and self.path.stat().st_size > MAX_FILE_BYTES:
            raise input_error(self.path, got="over 2 GB", expected="a glTF file")
        data = self.budget.read_file(self.path, "a glTF file")
        if data[:4] == b"glTF":
            data = self._split_binary(data)
        if not data.strip(b" \0"):
            is_binary = self.path.suffix.lower() == ".glb"
            got = "a .glb without its JSON chunk" if is_binary else "a .gltf without its JSON"
            expected = f"an intact {self.path.suffix} file"
            raise self.error("", got, expected)
        try:
            text = data.decode("utf-8")
        except UnicodeDecodeError:
            expected = "a glTF file: .glb, or .gltf in UTF-8"
            raise self.error("", "neither binary glTF nor text", expected, "check the file") from None
        value = parse_json(text, self.path, self.budget, "export the file again")
        if not isinstance(value, dict):
            raise input_error(self.path, got=type(value).__name__, expected="a glTF document")
        return value

    def _split_binary(self, data: bytes) -> bytes:
        document, offset = b"", 12
        try:
            while offset + 8 <= len(data):
                length, kind = struct.unpack_from("<II", data, offset)
                chunk = data[offset + 8 : offset + 8 + length]
                if len(chunk) != length:
                    raise struct.error("cut short")
                if kind == 0x4E4F534A:
                    document = chunk
                elif kind == 0x004E4942:
                    self._binary = chunk
                offset += 8 + length
        except struct.error:
            raise input_error(self.path, "", "a chunk that is cut short", "an intact .glb file") from None
        return document

    # data

    def resource(self, uri: str, user: str) -> bytes | Path:
        """Return the content of a data URI, or the path of another URI's file; the file may be missing."""
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.split(",", 1)[1], validate=True)
            except (IndexError, binascii.Error):
                raise self.error(user, uri[:40], "base64 data") from None
        remedy = "copy it there, or name its folder with --allow"
        return named_file(self.folder, unquote(uri), self.path, user, self.allowed, remedy)

    def buffer(self, index: int) -> bytes:
        """Return the content of buffer ``index``. Raises :class:`InputError` if missing or cut short."""
        if index not in self._buffers:
            entry = self.item("buffers", index, "bufferViews")
            content: bytes | Path = self._binary
            if "uri" in entry:
                content = self.resource(str(entry["uri"]), f"buffers[{index}].uri")
            if isinstance(content, Path):
                if not content.is_file():
                    got = f"{entry['uri']!r} (no such file)"
                    raise self.error(f"buffers[{index}].uri", got, "the buffer", "restore it")
                content = self.budget.read_file(content)
            if len(content) < int(entry.get("byteLength", 0)):
                raise self.error(
                    f"buffers[{index}]", f"{len(content)} bytes", f"{entry.get('byteLength')} bytes"
                )
            self._buffers[index] = content
        return self._buffers[index]

    def view(self, index: object) -> tuple[memoryview, int]:
        """Return the decompressed bytes of buffer view ``index`` and its stride in bytes (0: packed)."""
        entry = self.item("bufferViews", index, "accessors")
        stride = int(entry.get("byteStride", 0))
        packed = meshopt_of(entry)
        if packed is None:
            return self._part(entry), stride
        name, extension = packed
        if index not in self._unpacked:
            field, data = f"bufferViews[{index}]", bytes(self._part(extension))
            self._unpacked[index] = unpack_meshopt(data, name, extension, self.budget, self.path, field)
        return memoryview(self._unpacked[index]), stride

    def _part(self, entry: dict[str, Any]) -> memoryview:
        data = memoryview(self.buffer(int(entry.get("buffer", 0))))
        start = int(entry.get("byteOffset", 0))
        return data[start : start + int(entry["byteLength"])]

    def count(self, index: object, user: str) -> int:
        """Return the declared length of accessor ``index``. Raises :class:`InputError` if implausible."""
        count = self.item("accessors", index, user).get("count")
        if not isinstance(count, int) or not 0 <= count <= 3 * self.budget.allowed("triangles"):
            expected = f"0 to {3 * self.budget.allowed('triangles')}"
            raise self.error(f"accessors[{index}].count", repr(count)[:80], expected)
        return count

    def weight(self, primitive: dict[str, Any], user: str) -> int:
        """Return the number of triangles to charge to a budget for a primitive, without reading its data.

        It is at least the number of faces and at least a third of the number of vertices. Raises
        :class:`InputError` unless the attributes have one entry per vertex.
        """
        attributes = primitive.get("attributes", {})
        if "POSITION" not in attributes:
            raise self.error(user, "no POSITION", "vertex positions")
        num_vertices = self.count(attributes["POSITION"], user)
        for name, index in attributes.items():
            if name.startswith(("NORMAL", "TEXCOORD_")) and self.count(index, user) != num_vertices:
                raise self.error(f"{user}: {name}", self.count(index, user), f"{num_vertices} entries")
        corners = self.count(primitive["indices"], user) if "indices" in primitive else num_vertices
        is_list = primitive.get("mode", 4) == 4
        return max(corners // 3 if is_list else corners, -(-num_vertices // 3))

    def accessor(self, index: object, user: str) -> NDArray[Any]:
        """Return the values (count, components) of an accessor; normalised integers become floats."""
        entry = self.item("accessors", index, user)
        try:
            kind = np.dtype(_COMPONENTS[entry["componentType"]])
            width, count = _WIDTHS[entry["type"]], int(entry["count"])
        except KeyError as error:
            raise self.error(f"accessors[{index}]", str(error), "a known component type and shape") from None
        if "bufferView" in entry:
            values = self._strided(entry, kind, width, count, f"accessors[{index}]")
        else:
            self.count(index, user)  # an accessor without data is all zeros
            values = np.zeros((count, width), kind)
        if "sparse" in entry:
            values = self._sparse(entry["sparse"], values, kind, width, f"accessors[{index}].sparse")
        if entry.get("normalized") and kind.kind in "iu":
            limit = np.iinfo(kind).max
            values = np.maximum(values.astype(np.float32) / limit, -1.0)
        return values

    def _strided(
        self, entry: dict[str, Any], kind: np.dtype[Any], width: int, count: int, user: str
    ) -> NDArray[Any]:
        data, stride = self.view(entry["bufferView"])
        size = kind.itemsize * width
        stride = stride or size
        start = int(entry.get("byteOffset", 0))
        if min(count, start, stride) < 0:
            raise self.error(user, f"count {count}, offset {start}", "numbers of at least 0")
        if count and (stride < size or start + stride * (count - 1) + size > len(data)):
            raise self.error(user, f"{len(data)} bytes", f"{start + stride * (count - 1) + size} bytes")
        if stride == size:
            return np.frombuffer(data, kind, count * width, start).reshape(count, width)
        raw = np.frombuffer(data, np.uint8)
        rows = np.lib.stride_tricks.as_strided(raw[start:], (count, size), (stride, 1))
        return np.ascontiguousarray(rows).view(kind).reshape(count, width)

    def _sparse(
        self, sparse: dict[str, Any], values: NDArray[Any], kind: np.dtype[Any], width: int, user: str
    ) -> NDArray[Any]:
        count = int(sparse["count"])
        part = sparse["indices"]
        index_kind = np.dtype(_COMPONENTS[part["componentType"]])
        indices = self._strided(part, index_kind, 1, count, user)[:, 0].astype(np.int64)
        replacement = self._strided(sparse["values"], kind, width, count, user)
        if len(indices) and (indices.min() < 0 or indices.max() >= len(values)):
            got = int(indices.min() if indices.min() < 0 else indices.max())
            raise self.error(user, got, f"indices from 0 to {len(values) - 1}")
        values = np.array(values)
        values[indices] = replacement
        return values

    def image_file(self, index: object, user: str) -> Path:
        """Return the path of the file of image ``index``; the file may be missing.

        On first use, embedded images and Basis Universal images (as PNG) are written to a temporary folder.
        """
        entry = self.item("images", index, user)
        if index not in self._images:
            self._images[index] = self._image_file(index, entry)
        return self._images[index]

    def _image_file(self, index: object, entry: dict[str, Any]) -> Path:
        if "uri" in entry:
            content = self.resource(str(entry["uri"]), f"images[{index}].uri")
            if isinstance(content, Path):
                if not (content.suffix.lower() == ".ktx2" and content.is_file()):
                    return content
                content = self.budget.read_file(content)
        else:
            content = bytes(self.view(entry.get("bufferView"))[0])
        kind = str(entry.get("mimeType", ""))
        if is_ktx2(content):
            content, kind = png_of_basis(content, self.budget, self.path, f"images[{index}]"), "image/png"
        suffix = _IMAGE_SUFFIX.get(kind) or (".png" if content[:4] == b"\x89PNG" else ".jpg")
        if self._temporary is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="gltf-")
        name = str(entry.get("name") or f"image_{index}").replace("/", "_")
        folder = Path(self._temporary.name) / str(index)
        folder.mkdir(exist_ok=True)
        path = folder / f"{Path(name).stem or 'image'}{suffix}"
        path.write_bytes(content)
        return path

    # nodes

    def placed_nodes(self) -> Iterator[PlacedNode]:
        """Yield the default scene's nodes, depth first. Raises :class:`InputError` unless they are a tree."""
        nodes = self.items("nodes")
        scenes = self.items("scenes")
        if scenes:
            roots = _indices(self.item("scenes", self.json.get("scene", 0), "scene").get("nodes", []))
        else:
            inner = {c for n in nodes for c in _indices(n.get("children", []))}
            roots = [k for k in range(len(nodes)) if k not in inner]
        seen: set[int] = set()
        for root in roots:
            rest = [(root, np.eye(4), 1)]
            while rest:
                index, outer, depth = rest.pop()
                node = self.item("nodes", index, "nodes")
                if index in seen:  # 40 nodes with two parents each would expand to 10^12
                    raise self.error(f"nodes[{index}]", "two parents or a cycle", "a tree of nodes")
                seen.add(index)
                self.budget.spend("nodes", 1, f"nodes[{index}]")
                self.budget.check_depth(depth, f"nodes[{index}]")
                with np.errstate(over="ignore", invalid="ignore"):
                    matrix = outer @ self._local_matrix(index, node)
                if not np.isfinite(matrix).all():
                    raise self.error(f"nodes[{index}]", "an infinite transform", "finite transforms")
                yield PlacedNode(index, root, node, matrix)
                children = _indices(node.get("children", []))
                rest.extend((child, matrix, depth + 1) for child in reversed(children))

    def placed_primitives(self, nodes: Sequence[PlacedNode]) -> None:
        """Charge the meshes of ``nodes`` to the budget, once per node, without reading their data."""
        for index, buffer in enumerate(self.items("buffers")):
            content = self.resource(str(buffer.get("uri", "data:,")), f"buffers[{index}].uri")
            if isinstance(content, Path) and content.is_file():
                self.budget.hold_file(content)
        weights: dict[object, tuple[int, int]] = {}  # per mesh: primitives, triangles
        for placed in nodes:
            if "mesh" not in placed.node:
                continue
            key = placed.node["mesh"]
            if key not in weights:
                primitives = self.item("meshes", key, f"node {placed.name!r}").get("primitives", [])
                known = [p for p in primitives if p.get("mode", 4) in TRIANGLE_MODES]
                weights[key] = len(known), sum(self.weight(p, f"meshes[{key}]") for p in known)
            num_primitives, num_triangles = weights[key]
            self.budget.spend("instances", num_primitives, f"node {placed.name!r}")
            self.budget.spend("triangles", num_triangles, f"node {placed.name!r}")

    def _local_matrix(self, index: int, node: dict[str, Any]) -> NDArray[np.float64]:
        """Return a node's (4, 4) transform: its column-major matrix, or translation x rotation x scale."""
        for key, count in (("matrix", 16), ("rotation", 4), ("scale", 3), ("translation", 3)):
            value = node.get(key, [0.0] * count)
            is_list = isinstance(value, list) and len(value) == count
            if not is_list or not all(isinstance(v, int | float) and abs(v) < 1e30 for v in value):
                got = f"{len(value)} entries" if isinstance(value, list) and not is_list else repr(value)
                raise self.error(f"nodes[{index}].{key}", got, f"{count} numbers")
        if "matrix" in node:
            return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
        x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        linear = rotation * np.asarray(node.get("scale", (1.0, 1.0, 1.0)))
        return affine(linear, node.get("translation", (0.0, 0.0, 0.0)))


def _indices(value: object) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError(f"{value!r:.80} is not a list of nodes")
    return value


def triangles_of(indices: NDArray[np.int64], mode: int) -> NDArray[np.int32]:
    """Return the triangles (M, 3) of a list (``mode`` 4), strip (5) or fan (6) of vertex indices (K,)."""
    if mode == 4 or len(indices) < 3:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3).astype(np.int32)
    k = np.arange(len(indices) - 2)
    if mode == 6:
        corners = indices[0] + 0 * k, indices[k + 1], indices[k + 2]
    else:
        odd = k % 2
        corners = indices[k + odd], indices[k + 1 - odd], indices[k + 2]
    triangles: NDArray[np.int32] = np.stack(corners, axis=1).astype(np.int32)
    return triangles
