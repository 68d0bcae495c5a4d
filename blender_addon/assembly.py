# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes the materials of an asset to export, and writes its package."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .bake.plan import MaterialPlan, force_bake
from .bake.textures import UNIT_WINDOW, BakedMaterial, MaterialBaker, Window, padded_window
from .bake.unwrap import bake_layout
from .gather.instances import Instance
from .gather.mesh import MeshArrays, Submesh, submesh
from .gather.tags import material_classes, replaceable_by, slug, surfaces, tile_size_m
from .package import box_uv, material_entry, mesh_file, uv_density
from .reading import Contents, Reader
from .write import PackageWriter, exr_bytes

FORMAT, VERSION = "scene-materials/asset", 1
_UV_SLACK = 1e-4


@dataclass(frozen=True)
class Progress:
    """Progress of an export: completed ``fraction`` in [0, 1], and the current step as ``text``."""

    fraction: float
    text: str


def write_target(
    reader: Reader, contents: Contents, writer: PackageWriter
) -> Generator[Progress, None, None]:
    """Bake the materials of ``contents`` and write its package with ``writer``; yields the progress."""
    target = contents.target
    description: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "kind": target.kind,
        "id": target.id,
        "title": target.title,
        **contents.extra,
    }
    if target.kind == "material":
        yield Progress(0.0, f"baking {target.title}")
        description["material"] = _library_material(reader, target.tagged, writer)
    else:
        assembly = _Assembly(reader, contents, writer)
        yield from assembly.run()
        description.update(assembly.description())
    writer.finish(description)


def _library_material(reader: Reader, material: bpy.types.Material, writer: PackageWriter) -> dict[str, Any]:
    plan = reader.plan(material.name)
    size = tile_size_m(material, reader.problems) or 1.0
    layers = plan.dependencies.layer_names
    info = {"Location": (0.0,) * 3, "Color": (1.0,) * 3, "Alpha": (1.0,), "Object Index": (0.0,),
            "Material Index": (0.0,), "Random": (0.5,)}  # fmt: skip
    baked = MaterialBaker(reader.session, reader.settings, reader.problems).on_plane(
        material, plan, UNIT_WINDOW, info if plan.is_per_instance else None, size / reader.metres, layers
    )
    classes = material_classes(material, reader.problems)
    entry = material_entry(
        baked, slug(material.name), classes, reader.approximations(material.name), writer,
        reader.settings.texture_bits,
    )  # fmt: skip
    return {**entry, "tile_size_m": size}


class _Assembly:
    """Bakes the materials of one object or environment, and writes its parts."""

    def __init__(self, job: Reader, contents: Contents, writer: PackageWriter):
        self.job, self.contents, self.writer = job, contents, writer
        self.baker = MaterialBaker(job.session, job.settings, job.problems)
        self.materials: dict[str, dict[str, Any]] = {}
        self.parts: list[dict[str, Any]] = []
        self._baked: dict[tuple[Any, ...], tuple[str, BakedMaterial]] = {}
        self._layouts: dict[tuple[int, int], NDArray[np.float32]] = {}
        self._things: dict[int, bpy.types.Object] = {}
        self._files: dict[tuple[Any, ...], tuple[str, Submesh]] = {}
        self._names: set[str] = set()
        self._boxes: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        self._seen_boxes: set[tuple[str, int, int]] = set()
        self._densities: dict[tuple[Any, ...], float | None] = {}
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)

    def run(self) -> Generator[Progress, None, None]:
        """Bake and write the parts of all instances; yields the progress."""
        instances = self.contents.gathered.instances
        self._find_windows()
        for index, instance in enumerate(instances):
            yield Progress(index / len(instances), f"exporting {instance.name}")
            mesh = self.contents.gathered.meshes[instance.mesh_key]
            for slot in mesh.used_slots:
                yield from self._part(instance, slot, len(mesh.used_slots) > 1, index / len(instances))
            self.contents.num_triangles += len(mesh.triangles)

    def _find_windows(self) -> None:
        """Compute, for each material, the bounding box of its texture coordinates over all meshes."""
        for instance in self.contents.gathered.instances:
            mesh = self.contents.gathered.meshes[instance.mesh_key]
            for slot in mesh.used_slots:
                name = instance.materials[min(slot, len(instance.materials) - 1)]
                assert name is not None
                frame = self.job.plan(name).frame
                seen = (name, instance.mesh_key, slot)
                if frame is None or seen in self._seen_boxes:
                    continue
                self._seen_boxes.add(seen)
                uv = mesh.uv_layers[frame.layer or mesh.active_uv]
                points = frame.apply(uv[mesh.triangles[mesh.triangle_slots == slot].ravel()])
                low, high = points.min(axis=0).astype(float), points.max(axis=0).astype(float)
                if name in self._boxes:
                    low = np.minimum(low, self._boxes[name][0])
                    high = np.maximum(high, self._boxes[name][1])
                self._boxes[name] = (low, high)

    def _part(
        self, instance: Instance, slot: int, is_split: bool, fraction: float
    ) -> Generator[Progress, None, None]:
        name = instance.materials[min(slot, len(instance.materials) - 1)]
        assert name is not None
        mesh = self.contents.gathered.meshes[instance.mesh_key]
        material_key = self._key(instance, slot, name)
        if material_key not in self._baked:
            yield Progress(fraction, f"baking {name} for {instance.name}")
            self._baked[material_key] = self._bake(instance, slot, name)
        slot_name, baked = self._baked[material_key]
        metres_from_part = np.diag([self.job.metres] * 3 + [1.0]) @ instance.matrix
        key = (instance.mesh_key, slot, instance.is_mirrored, id(baked) if _has_textures(baked) else 0)
        if key not in self._files:
            uv = self._coordinates(mesh, baked, metres_from_part, name)
            part = submesh(mesh, slot, uv, instance.is_mirrored)
            stem = slug(f"{instance.name}_{slot}" if is_split else instance.name)
            self._files[key] = (mesh_file(part, stem, self.writer), part)
        path, part = self._files[key]
        if instance.is_mirrored:
            metres_from_part = metres_from_part @ np.diag([-1.0, 1.0, 1.0, 1.0])
        if self.contents.target.kind == "object" and len(part.positions):
            points = part.positions.astype(np.float64) @ metres_from_part[:3, :3].T + metres_from_part[:3, 3]
            self._low = np.minimum(self._low, points.min(axis=0))
            self._high = np.maximum(self._high, points.max(axis=0))
        entry: dict[str, Any] = {
            "name": self._unique(f"{instance.name}.{name}" if is_split else instance.name),
            "mesh": path,
            "material": slot_name,
            "asset_from_part": metres_from_part,
        }
        size = (key, tuple(np.round(metres_from_part[:3, :3], 9).ravel()))
        if size not in self._densities:
            self._densities[size] = uv_density(part, metres_from_part)
        density = self._densities[size]
        if density is not None:
            entry["uv_per_m"] = density
        if len(part.faces):
            self.parts.append(entry)

    def _coordinates(
        self, mesh: MeshArrays, baked: BakedMaterial, metres_from_part: NDArray[np.float64], material: str
    ) -> NDArray[np.float32] | None:
        if baked.uv is not None:
            return baked.uv
        layer = (baked.frame.layer if baked.frame is not None else "") or mesh.active_uv
        if layer in mesh.uv_layers:
            return baked.texture_coordinates(mesh.uv_layers[layer])
        if bpy.data.materials[material].get("sm_replaceable_by"):  # its replacements may need UVs
            return box_uv(mesh, np.linalg.norm(metres_from_part[:3, :3], axis=0))
        return None

    def _unique(self, name: str) -> str:
        candidate, number = name, 1
        while candidate in self._names:
            number += 1
            candidate = f"{name}.{number}"
        self._names.add(candidate)
        return candidate

    def _effective_plan(self, name: str) -> MaterialPlan:
        plan = self.job.plan(name)
        if any(image.needs_unit_uv for image in plan.images.values()):
            low, high = self._boxes[name]
            if (low < -_UV_SLACK).any() or (high > 1 + _UV_SLACK).any():
                return force_bake(plan)
        return plan

    def _key(self, instance: Instance, slot: int, name: str) -> tuple[Any, ...]:
        plan = self._effective_plan(name)
        key: tuple[Any, ...] = (name,)
        if plan.needs_mesh:
            key = (*key, instance.mesh_key, slot)
        if plan.is_per_instance:
            info = tuple(sorted(instance.object_info.items()))
            place = tuple(instance.matrix.ravel()) if plan.dependencies.world else ()
            key = (*key, info, place)
        return key

    def _bake(self, instance: Instance, slot: int, name: str) -> tuple[str, BakedMaterial]:
        job, plan = self.job, self._effective_plan(name)
        material = bpy.data.materials[name]
        info = instance.object_info if plan.is_per_instance else None
        slot_name = name
        if plan.needs_mesh:
            thing = self._thing(instance)
            baked = self.baker.on_mesh(material, plan, thing, slot, self._layout(instance, slot), info)
        else:
            window = UNIT_WINDOW
            repeats = plan.dependencies.is_periodic or material.get("sm_tile_size_m") is not None
            if (plan.varying or plan.bakes_normal) and plan.frame is not None and not repeats:
                window = padded_window(*self._boxes[name])
            side = self._window_side(instance, slot, plan, window) if plan.bakes_normal else 1.0
            layers = plan.dependencies.layer_names
            baked = self.baker.on_plane(material, plan, window, info, side, layers)
        number = 1
        if plan.needs_mesh or plan.is_per_instance:
            slot_name = base = f"{name} on {instance.name}"
            while slot_name in self.materials:
                number += 1
                slot_name = f"{base} {number}"
        classes, texts = material_classes(material, job.problems), job.approximations(name)
        bits = job.settings.texture_bits
        entry = material_entry(baked, slug(slot_name), classes, texts, self.writer, bits)
        entry["replaceable_by"] = list(replaceable_by(material, job.problems))
        origin = material.get("sm_baked_from") or (name if slot_name != name else None)
        if origin is not None:
            entry["baked_from"] = str(origin)
        for surface in surfaces(material, "sm_surface", job.problems)[:1]:
            entry["surface"] = surface
        tile_size = tile_size_m(material, job.problems)
        if tile_size is not None and baked.uv is None and baked.window == UNIT_WINDOW:
            entry["tile_size_m"] = tile_size
        self.materials[slot_name] = entry
        return slot_name, baked

    def _window_side(self, instance: Instance, slot: int, plan: MaterialPlan, window: Window) -> float:
        """Side (Blender units) of the square of surface under the window, on which bump slopes depend."""
        mesh = self.contents.gathered.meshes[instance.mesh_key]
        frame = plan.frame
        layer = (frame.layer if frame is not None else "") or mesh.active_uv
        if layer not in mesh.uv_layers:
            return 1.0
        placed = BakedMaterial(frame=frame, window=window)
        part = submesh(mesh, slot, placed.texture_coordinates(mesh.uv_layers[layer]))
        density = uv_density(part, instance.matrix)
        return 1.0 / density if density else 1.0

    def _thing(self, instance: Instance) -> bpy.types.Object:
        """The object to bake, shared by all instances of a mesh, moved to the instance's transform."""
        if instance.mesh_key not in self._things:
            self._things[instance.mesh_key] = self.job.session.object_of(
                self.contents.copies[instance.mesh_key]
            )
        thing = self._things[instance.mesh_key]
        thing.matrix_world = instance.matrix.T.tolist()
        return thing

    def _layout(self, instance: Instance, slot: int) -> NDArray[np.float32]:
        key = (instance.mesh_key, slot)
        if key not in self._layouts:
            arrays = self.contents.gathered.meshes[instance.mesh_key]
            self._layouts[key] = bake_layout(self.job.session, self._thing(instance), arrays, slot)
        layer = self._thing(instance).data.uv_layers["sm_bake"]
        layer.uv.foreach_set("vector", np.ascontiguousarray(self._layouts[key]).ravel())
        return self._layouts[key]

    def description(self) -> dict[str, Any]:
        """The fields materials, parts, lights and bounds of ``asset.json``, available after :meth:`run`."""
        offset = np.zeros(3)
        result: dict[str, Any] = {"materials": self.materials}
        tagged = self.contents.target.tagged
        if self.contents.target.kind == "object":
            offset[2] = -self._low[2]
            if not tagged.get("sm_keep_origin"):
                offset[:2] = -(self._low[:2] + self._high[:2]) / 2
            result["minimum_m"], result["maximum_m"] = self._low + offset, self._high + offset
        move = np.eye(4)
        move[:3, 3] = offset
        result["parts"] = [{**part, "asset_from_part": move @ part["asset_from_part"]} for part in self.parts]
        result["lights"] = [self._moved(light, offset) for light in self.contents.lights]
        return result

    def _moved(self, light: dict[str, Any], offset: NDArray[np.float64]) -> dict[str, Any]:
        light = dict(light)
        for key in ("position_m", "origin_m"):
            if key in light:
                light[key] = np.array(light[key]) + offset
        image = self.contents.images.get(light["name"]) if light["type"] == "environment" else None
        if image is not None:
            light["image"] = self.writer.add("textures", slug(light["name"]), ".exr", exr_bytes(image))
        return light


def _has_textures(baked: BakedMaterial) -> bool:
    has_channel = any(not isinstance(channel, tuple) for channel in baked.channels.values())
    return has_channel or baked.normal is not None
