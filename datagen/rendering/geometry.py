# SPDX-License-Identifier: MIT
"""The meshes of a configuration, merged into one Mitsuba shape per BSDF.

Parts are transformed to world space in double precision and joined by BSDF, emission and vertex layout. A
room of 775 meshes becomes 35 shapes, which load faster and trace equally fast (docs/decisions/0007). A table
maps triangles to instances. The texture coordinate v points up in files and down in Mitsuba; it is flipped
here.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.errors import input_error
from datagen.foundation.meshes.mesh import Mesh, inspect_mesh, joined
from datagen.foundation.meshes.ply import decode_ply

if TYPE_CHECKING:
    from datagen.formats.package import Package

MAX_CACHE_BYTES = 256 << 20


class MeshCache:
    """Cache of decoded meshes by package and file; drops the least recently used above 256 MB in total."""

    def __init__(self) -> None:
        self.num_bytes = 0
        self._meshes: OrderedDict[tuple[str, str], tuple[Mesh, int]] = OrderedDict()

    def mesh(self, package: Package, name: str) -> Mesh:
        """Return the mesh in file ``name`` of a package. Raises :class:`InputError` if it is unusable."""
        key = (package.sha256, name)
        if key in self._meshes:
            self._meshes.move_to_end(key)
            return self._meshes[key][0]
        where = f"{package.path}/{name}"
        mesh = decode_ply(package.read_bytes(name), where)
        _check(mesh, where)
        arrays = (mesh.positions, mesh.faces, mesh.normals, mesh.uv)
        num_bytes = sum(a.nbytes for a in arrays if a is not None)
        self._meshes[key] = (mesh, num_bytes)
        self.num_bytes += num_bytes
        while self.num_bytes > MAX_CACHE_BYTES and len(self._meshes) > 1:
            _, (_, dropped) = self._meshes.popitem(last=False)
            self.num_bytes -= dropped
        return mesh


def _check(mesh: Mesh, where: str) -> None:
    """Raise :class:`InputError` for a mesh that would cause NaN or crashes."""
    arrays = [a for a in (mesh.positions, mesh.normals, mesh.uv) if a is not None]
    indices_fit = len(mesh.faces) > 0 and mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.positions)
    if indices_fit and all(np.isfinite(a).all() for a in arrays):
        return
    raise input_error(where, "", inspect_mesh(mesh), "finite triangles", "export it again")


@dataclass(frozen=True)
class GroupKey:
    """Properties shared by all triangles of one Mitsuba shape."""

    bsdf: Hashable
    emission: tuple[float, float, float] | None
    has_normals: bool
    has_uv: bool
    has_mirrored_uv: bool


@dataclass
class MeshGroup:
    """Triangles of one shape, as world-space ``meshes`` and the instance id of each mesh."""

    meshes: list[Mesh] = field(default_factory=list)
    instances: list[int] = field(default_factory=list)

    def joined(self) -> tuple[Mesh, NDArray[np.uint32]]:
        """Return all triangles as one mesh, and the instance id (M,) of each triangle."""
        counts = [len(mesh.faces) for mesh in self.meshes]
        return joined(self.meshes), np.repeat(np.asarray(self.instances, np.uint32), counts)


def in_world(mesh: Mesh, world_from_part: NDArray[np.float64], uv_scale: float) -> Mesh:
    """Transform a part by :meth:`Mesh.placed`, multiply its UVs by ``uv_scale``, and flip v."""
    world = mesh.placed(world_from_part)
    if mesh.uv is None:
        return world
    scaled = mesh.uv.astype(np.float64) * uv_scale
    return replace(world, uv=np.stack([scaled[:, 0], 1.0 - scaled[:, 1]], axis=1).astype(np.float32))


def split_by_uv_handedness(mesh: Mesh) -> list[tuple[bool, Mesh]]:
    """Split ``mesh`` (v downwards) by UV handedness into pairs (is mirrored, non-empty mesh)."""
    assert mesh.uv is not None
    corners = mesh.uv.astype(np.float64)[mesh.faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    is_mirrored = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0] > 0  # reversed, since v is downwards
    kinds = []
    for kind in (False, True):
        chosen = is_mirrored == kind
        if chosen.all():
            return [(kind, mesh)]
        kinds.append((kind, Mesh(mesh.positions, mesh.faces[chosen], mesh.normals, mesh.uv)))
    return kinds


def make_shape(name: str, mesh: Mesh, bsdf: Any, emission: tuple[float, float, float] | None = None) -> Any:
    """Create a Mitsuba mesh of world-space triangles with a BSDF and, given ``emission``, an area emitter."""
    import mitsuba as mi

    props = mi.Properties()
    props["mesh_bsdf"] = bsdf
    props.set_id(name)
    if mesh.normals is None:
        props["face_normals"] = True
    if emission is not None:
        radiance = {"type": "rgb", "value": [float(c) for c in emission]}
        props["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
    has_normals, has_uv = mesh.normals is not None, mesh.uv is not None
    shape = mi.Mesh(name, len(mesh.positions), len(mesh.faces), props, has_normals, has_uv)
    parameters = mi.traverse(shape)
    arrays = {"positions": mesh.positions, "normals": mesh.normals, "texcoords": mesh.uv}
    for kind, array in arrays.items():
        if array is not None:
            parameters[f"vertex_{kind}"] = mi.Float(np.ascontiguousarray(array, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(mesh.faces, np.uint32).ravel())
    parameters.update()
    return shape
