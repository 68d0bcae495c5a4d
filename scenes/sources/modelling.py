# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts shapes to Blender's data: materials with tags, meshes with UVs and normals, and markers."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import bpy
import numpy as np

from datagen.foundation.axes import affine, rotation
from scenes.sources.materials.catalogue import MATERIALS, Slot
from scenes.sources.materials.graph import Graph
from scenes.sources.shapes import Shape

SMOOTH_DEGREES = 42.0  # edges with larger angles stay sharp; a two-step bevel has 30 degrees per step
AUTHOR = "the scene-materials authors"
LICENSE = "CC0-1.0"


def new_file() -> None:
    """Open an empty file with metres as its unit."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.unit_settings.system = "METRIC"
    bpy.context.scene.unit_settings.scale_length = 1.0


@dataclass(frozen=True)
class Pieces:
    """The (slot, shape) pairs of a part; ``+=`` appends one or several shapes with the slot ``slot``."""

    shapes: list[tuple[str, Shape]]
    slot: str

    def __iadd__(self, added: Shape | Iterable[Shape]) -> Pieces:
        self.shapes.extend((self.slot, shape) for shape in ([added] if isinstance(added, Shape) else added))
        return self


@dataclass
class PartBuilder:
    """Collects shapes by part and slot and converts them to tagged Blender objects.

    A part becomes one object at the origin, or one object per transform in ``places``, with a common mesh.
    """

    slots: dict[str, Slot]
    parts: dict[str, list[tuple[str, Shape]]] = field(default_factory=dict)
    places: dict[str, list[np.ndarray]] = field(default_factory=dict)
    _materials: dict[str, bpy.types.Material] = field(default_factory=dict)
    _count: int = 0

    def __getitem__(self, place: tuple[str, str]) -> Pieces:
        """The pieces of a (part, slot), for ``builder["radio", "knob"] += shape`` or ``+= shapes``.

        Raises ``KeyError`` if the slot does not exist.
        """
        part, slot = place
        if slot not in self.slots:
            raise KeyError(f"no slot {slot!r}")
        return Pieces(self.parts.setdefault(part, []), slot)

    def __setitem__(self, place: tuple[str, str], pieces: Pieces) -> None:
        """Do nothing: ``+=`` calls this method after adding the shapes."""

    def place(self, part: str, x: float, y: float, z: float = 0.0, degrees: float = 0.0) -> None:
        """Place a part at (x, y, z) [m], rotated about z; a part that is never placed is at the origin."""
        matrix = affine(rotation("z", math.radians(degrees)), (x, y, z))
        self.places.setdefault(part, []).append(matrix)

    def material(self, name: str) -> bpy.types.Material:
        """The Blender material of a slot, created on first use."""
        if name not in self._materials:
            slot = self.slots[name]
            graph = Graph(name)
            if slot.source:
                material = MATERIALS[slot.source].build(graph)
                material["sm_tile_size_m"] = MATERIALS[slot.source].tile_size_m
            elif slot.graph is not None:
                material = slot.graph(graph)
            else:
                material = graph.finish(slot.color, slot.roughness, slot.metallic, slot.ior)
            material["sm_class"] = ", ".join(slot.classes)
            if slot.replaceable_by:
                material["sm_replaceable_by"] = ", ".join(slot.replaceable_by)
            self._materials[name] = material
        return self._materials[name]

    def mesh(self, part: str) -> bpy.types.Mesh:
        """Create the Blender mesh of a part's shapes, with one material per slot."""
        pieces = self.parts[part]
        names = list(dict.fromkeys(slot for slot, _ in pieces))
        points, faces, uvs, indices, offset = [], [], [], [], 0
        for slot, shape in pieces:
            uv = shape.uvs
            if not shape.unit_uv:
                # a low-discrepancy shift, so that each shape has a different section of the pattern
                self._count += 1
                shift = np.array([0.6180339887, 0.7548776662]) * self._count % 1.0
                source = self.slots[slot].source
                uv = uv * (1.0 / MATERIALS[source].tile_size_m if source else 1.0) + shift
                uv = uv - np.floor(uv.min(axis=0))
            points.append(shape.points)
            faces += [tuple(i + offset for i in face) for face in shape.faces]
            uvs.append(uv)
            indices += [names.index(slot)] * len(shape.faces)
            offset += len(shape.points)
        mesh = bpy.data.meshes.new(part)
        mesh.from_pydata(np.concatenate(points).tolist(), [], faces)
        layer = mesh.uv_layers.new(name="UVMap")
        layer.uv.foreach_set("vector", np.concatenate(uvs).astype(np.float32).ravel())
        for name in names:
            mesh.materials.append(self.material(name))
        mesh.polygons.foreach_set("material_index", np.array(indices, dtype=np.int32))
        mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), dtype=bool))
        mesh.set_sharp_from_angle(angle=math.radians(SMOOTH_DEGREES))
        mesh.update()
        return mesh

    def build(self, collection: bpy.types.Collection) -> None:
        """Create the objects of all parts in ``collection``."""
        for part in self.parts:
            mesh = self.mesh(part)
            for matrix in self.places.get(part, [np.eye(4)]):
                thing = bpy.data.objects.new(part, mesh)
                thing.matrix_world = matrix.T.tolist()
                collection.objects.link(thing)
                weighted = thing.modifiers.new("Normals", "WEIGHTED_NORMAL")
                weighted.keep_sharp = True


def tag(data: bpy.types.ID, **tags: object) -> None:
    """Set custom properties of an object, collection or material, which the add-on reads."""
    for key, value in tags.items():
        data[key] = value


def _identify(data: bpy.types.ID, role: str, identity: str, title: str) -> None:
    tag(data, sm_role=role, sm_id=identity, sm_title=title, sm_license=LICENSE, sm_author=AUTHOR)


def tagged_collection(role: str, identity: str, title: str, **tags: object) -> bpy.types.Collection:
    """Create a collection that the add-on exports as one package."""
    collection = bpy.data.collections.new(identity)
    bpy.context.scene.collection.children.link(collection)
    _identify(collection, role, identity, title)
    tag(collection, **tags)
    return collection


def tag_material(material: bpy.types.Material, identity: str) -> None:
    """Tag a material for export as a separate package."""
    source = MATERIALS[identity]
    _identify(material, "material", identity, source.title)
    tag(material, sm_class=", ".join(source.classes), sm_tile_size_m=source.tile_size_m)
    if source.surfaces:
        tag(material, sm_surfaces=", ".join(source.surfaces))
