# SPDX-License-Identifier: GPL-3.0-or-later
"""The one export behind the operator, the panel and the command line.

:func:`export_steps` is a generator: each step says how far it is, closing it cancels, and whatever happens
nothing is left in the file and no half-written package on disk.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .bake.execute import BakeSession
from .bake.plan import MaterialPlan, force_bake, plan_material
from .bake.textures import UNIT_WINDOW, BakedMaterial, MaterialBaker, padded_window
from .bake.unwrap import bake_layout
from .gather.cameras import gather_camera
from .gather.instances import Gathered, Instance, gather_instances
from .gather.lights import gather_light
from .gather.markers import gather_markers
from .gather.mesh import Submesh, submesh
from .gather.tags import (
    SUPPORT_KINDS,
    check_words,
    material_classes,
    numbers,
    provenance,
    replaceable_by,
    role_of,
    slug,
    words,
)
from .gather.world import gather_world
from .package import box_uv, material_entry, mesh_file, uv_density
from .problems import APPROXIMATION, ERROR, ExportRefused, Problem, ProblemList
from .settings import ExportSettings
from .targets import Target, find_targets
from .write import PackageWriter

FORMAT, VERSION = "scene-materials/asset", 1
_UV_SLACK = 1e-4


@dataclass(frozen=True)
class Progress:
    """``fraction`` of the work done, in [0, 1], and what is being done."""

    fraction: float
    text: str


@dataclass
class ExportResult:
    """Folders written, everything approximated, and counts for the report."""

    packages: list[Path] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    num_triangles: int = 0
    num_instances: int = 0


Steps = Generator[Progress, None, ExportResult]


def export(out_dir: Path, settings: ExportSettings | None = None) -> ExportResult:
    """Export the current file into ``out_dir``, a folder of packages. Raises :class:`ExportRefused`."""
    steps = export_steps(out_dir, settings or ExportSettings())
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            return stop.value


def check(settings: ExportSettings | None = None) -> list[Problem]:
    """Every problem that an export would meet before it bakes or writes anything."""
    problems = ProblemList()
    settings = settings or ExportSettings()
    with BakeSession() as session:
        job = _Job(settings, session, problems)
        for target in find_targets(bpy.context.scene, settings, problems):
            for _ in job.prepare(target):
                pass
    return list(problems)


def export_steps(out_dir: Path, settings: ExportSettings) -> Steps:
    """Export step by step; see :func:`export`."""
    problems = ProblemList()
    targets = find_targets(bpy.context.scene, settings, problems)
    if problems.errors:
        raise ExportRefused(problems)
    result = ExportResult()
    with BakeSession() as session:
        prepared = []
        job = _Job(settings, session, problems)
        for index, target in enumerate(targets):
            yield Progress(0.1 * index / len(targets), f"reading {target.title}")
            steps = job.prepare(target)
            while True:
                try:
                    next(steps)
                except StopIteration as stop:
                    prepared.append(stop.value)
                    break
                yield Progress(0.1 * index / len(targets), f"reading {target.title}")
        if problems.errors:
            raise ExportRefused(problems)
        for index, contents in enumerate(prepared):
            folder = out_dir / contents.target.id
            with PackageWriter(folder) as writer:
                for progress in job.write(contents, writer):
                    done = 0.1 + 0.9 * (index + progress.fraction) / len(prepared)
                    yield Progress(done, progress.text)
                if problems.errors:
                    raise ExportRefused(problems)
            result.packages.append(folder)
            result.num_triangles += contents.num_triangles
            result.num_instances += len(contents.gathered.instances)
    result.problems = list(problems)
    return result


@dataclass
class _Contents:
    """A target with everything read that it holds."""

    target: Target
    gathered: Gathered = field(default_factory=Gathered)
    copies: dict[int, bpy.types.Mesh] = field(default_factory=dict)
    lights: list[dict[str, Any]] = field(default_factory=list)
    images: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)
    num_triangles: int = 0


class _Job:
    """State shared by the targets of one export: plans, bakes that several targets use, problems."""

    def __init__(self, settings: ExportSettings, session: BakeSession, problems: ProblemList):
        self.settings, self.session, self.problems = settings, session, problems
        self.baker = MaterialBaker(session, settings, problems)
        self.metres = bpy.context.scene.unit_settings.scale_length or 1.0
        self._plans: dict[str, MaterialPlan] = {}

    def plan(self, name: str) -> MaterialPlan:
        """A material's plan, made once; its problems join the list."""
        if name not in self._plans:
            self._plans[name] = plan_material(bpy.data.materials[name])
            self.problems.extend(self._plans[name].problems)
        return self._plans[name]

    # ---- reading

    def prepare(self, target: Target) -> Generator[None, None, _Contents]:
        """Read a target and plan its materials, noting every problem."""
        contents = _Contents(target)
        fallback = {
            "license": self.settings.license,
            "author": self.settings.author,
            "source": self.settings.source,
        }
        contents.extra["provenance"] = provenance(target.tagged, fallback, self.problems)
        if target.kind == "material":
            self.plan(target.tagged.name)
            return contents
        depsgraph = bpy.context.evaluated_depsgraph_get()

        def keep(key: int, mesh: bpy.types.Mesh, materials: tuple[str | None, ...]) -> None:
            if key not in contents.copies and any(
                name is not None and self.plan(name).needs_mesh for name in materials
            ):
                copy = self.session.own(bpy.data.meshes, mesh.copy())
                copy.use_auto_texspace = False
                copy.texspace_location = mesh.texspace_location
                copy.texspace_size = mesh.texspace_size
                contents.copies[key] = copy

        for gathered in gather_instances(depsgraph, target.owners.__contains__, keep, self.problems):
            contents.gathered = gathered
            if len(gathered.instances) % 64 == 0:
                yield
        self._check_materials(contents)
        if not contents.gathered.instances:
            self.problems.add(
                ERROR, f"{target.title!r} holds no visible surface", "add a mesh, or correct the tags"
            )
        self._prepare_lights(contents, depsgraph)
        if target.kind == "object":
            self._prepare_object(contents)
        else:
            self._prepare_environment(contents)
        return contents

    def _check_materials(self, contents: _Contents) -> None:
        for instance in contents.gathered.instances:
            mesh = contents.gathered.meshes[instance.mesh_key]
            for slot in np.unique(mesh.triangle_slots):
                name = instance.materials[min(int(slot), len(instance.materials) - 1)]
                if name is None:
                    self.problems.add(
                        ERROR, f"slot {slot} has no material", "assign one", object=instance.owner
                    )
                    continue
                plan = self.plan(name)
                material_classes(bpy.data.materials[name], self.problems)
                replaceable_by(bpy.data.materials[name], self.problems)
                for layer in plan.dependencies.uv_layers if (plan.images or plan.varying) else ():
                    if (layer or mesh.active_uv) not in mesh.uv_layers:
                        wanted = f"the UV map {layer!r}" if layer else "a UV map"
                        self.problems.add(
                            ERROR,
                            f"the material needs {wanted}, which the mesh does not have",
                            "unwrap the mesh",
                            object=instance.owner,
                            material=name,
                        )

    def _prepare_lights(self, contents: _Contents, depsgraph: bpy.types.Depsgraph) -> None:
        for shown in depsgraph.object_instances:
            thing = shown.object
            owner = shown.parent.original if shown.is_instance and shown.parent else thing.original
            if thing.type != "LIGHT" or owner.name not in contents.target.owners or owner.hide_render:
                continue
            if role_of(owner) or not shown.show_self:
                continue
            matrix = np.array(shown.matrix_world, dtype=np.float64)
            light = gather_light(thing, matrix, self.metres, self.problems)
            if light is not None:
                contents.lights.append(light)
        contents.lights.sort(key=lambda light: light["name"])
        names: dict[str, int] = {}
        for light in contents.lights:  # instances of one light share its name
            number = names[light["name"]] = names.get(light["name"], 0) + 1
            if number > 1:
                light["name"] += f" {number}"

    def _prepare_object(self, contents: _Contents) -> None:
        tagged = contents.target.tagged
        category = str(tagged.get("sm_category", ""))
        if not category:
            self.problems.add(ERROR, f"{tagged.name!r} has no category", "set sm_category, for example 'cup'")
        contents.extra["category"] = slug(category) if category else ""
        if tagged.get("sm_supports") is not None:
            kinds = check_words(words(tagged["sm_supports"]), SUPPORT_KINDS, "sm_supports", self.problems)
            contents.extra["supports"] = list(kinds)
        for tag, key in (("sm_scale_range", "scale_range"), ("sm_yaw_range_rad", "yaw_range_rad")):
            if tagged.get(tag) is not None:
                values = numbers(tagged[tag])
                if len(values) != 2 or values[0] > values[1]:
                    self.problems.add(
                        ERROR, f"{tag} = {values} of {tagged.name!r}", "give two numbers, the smaller first"
                    )
                contents.extra[key] = list(values)

    def _prepare_environment(self, contents: _Contents) -> None:
        scene, target = bpy.context.scene, contents.target
        things = [thing for thing in scene.objects if thing.name in target.owners]
        contents.extra.update(gather_markers(things, self.metres, self.problems))
        cameras = [
            gather_camera(thing, scene.render, self.metres, self.problems)
            for thing in sorted(things, key=lambda t: t.name)
            if thing.type == "CAMERA" and not thing.hide_render and role_of(thing) != "ignore"
        ]
        contents.extra["cameras"] = [
            {**vars(camera), "asset_from_camera": camera.asset_from_camera} for camera in cameras if camera
        ]
        light = gather_world(scene, self.session, self.problems, min(self.settings.max_texture_px, 2048))
        if light is not None:
            entry, image = light
            if image is not None:
                contents.images[entry["name"]] = image
            contents.lights.append(entry)

    # ---- writing

    def write(self, contents: _Contents, writer: PackageWriter) -> Generator[Progress, None, None]:
        """Bake what the target needs and write its package."""
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
            description["material"] = self._library_material(target.tagged, writer)
        else:
            assembly = _Assembly(self, contents, writer)
            yield from assembly.run()
            description.update(assembly.description())
        writer.finish(description)

    def _library_material(self, material: bpy.types.Material, writer: PackageWriter) -> dict[str, Any]:
        plan = self.plan(material.name)
        size = float(material.get("sm_tile_size_m", 1.0))
        layers = tuple(sorted(layer for layer in plan.dependencies.uv_layers if layer))
        info = {"Location": (0.0,) * 3, "Color": (1.0,) * 3, "Alpha": (1.0,), "Object Index": (0.0,),
                "Material Index": (0.0,), "Random": (0.5,)}  # fmt: skip
        baked = self.baker.on_plane(
            material, plan, UNIT_WINDOW, info if plan.is_per_instance else None, size, layers
        )
        classes = material_classes(material, self.problems)
        entry = material_entry(
            baked, slug(material.name), classes, self.approximations(material.name), writer,
            self.settings.texture_bits,
        )  # fmt: skip
        return {**entry, "tile_size_m": size}

    def approximations(self, material: str) -> tuple[str, ...]:
        """What of a material is exported otherwise than Blender shows it."""
        return tuple(
            (f"{problem.node}: " if problem.node else "") + problem.message
            for problem in self.problems
            if problem.material == material and problem.severity == APPROXIMATION
        )


class _Assembly:
    """Bakes and writes the parts of one object or environment."""

    def __init__(self, job: _Job, contents: _Contents, writer: PackageWriter):
        self.job, self.contents, self.writer = job, contents, writer
        self.materials: dict[str, dict[str, Any]] = {}
        self.parts: list[dict[str, Any]] = []
        self._baked: dict[tuple[Any, ...], tuple[str, BakedMaterial]] = {}
        self._layouts: dict[tuple[int, int], NDArray[np.float32]] = {}
        self._things: dict[int, bpy.types.Object] = {}
        self._files: dict[tuple[Any, ...], tuple[str, Submesh]] = {}
        self._names: set[str] = set()
        self._boxes: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        self._seen_boxes: set[tuple[str, int, int]] = set()
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)

    def run(self) -> Generator[Progress, None, None]:
        """All instances, in order."""
        instances = self.contents.gathered.instances
        self._find_windows()
        for index, instance in enumerate(instances):
            yield Progress(index / len(instances), f"exporting {instance.name}")
            mesh = self.contents.gathered.meshes[instance.mesh_key]
            slots = np.unique(mesh.triangle_slots)
            for slot in slots:
                yield from self._part(instance, int(slot), len(slots) > 1, index / len(instances))
            self.contents.num_triangles += len(mesh.triangles)

    def _find_windows(self) -> None:
        """The box of texture coordinates in which each material is read, over all meshes that use it."""
        for instance in self.contents.gathered.instances:
            mesh = self.contents.gathered.meshes[instance.mesh_key]
            for slot in np.unique(mesh.triangle_slots):
                name = instance.materials[min(int(slot), len(instance.materials) - 1)]
                assert name is not None
                frame = self.job.plan(name).frame
                seen = (name, instance.mesh_key, int(slot))
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

    def _exceeds_unit(self, name: str) -> bool:
        low, high = self._boxes[name]
        return bool((low < -_UV_SLACK).any() or (high > 1 + _UV_SLACK).any())

    def _part(
        self, instance: Instance, slot: int, is_split: bool, fraction: float
    ) -> Generator[Progress, None, None]:
        name = instance.materials[min(slot, len(instance.materials) - 1)]
        assert name is not None
        mesh = self.contents.gathered.meshes[instance.mesh_key]
        slot_name, baked = self._lookup(instance, slot, name)
        if baked is None:
            yield Progress(fraction, f"baking {name} for {instance.name}")
            slot_name, baked = self._bake(instance, slot, name)
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
        points = part.positions.astype(np.float64) @ metres_from_part[:3, :3].T + metres_from_part[:3, 3]
        if len(points):
            self._low = np.minimum(self._low, points.min(axis=0))
            self._high = np.maximum(self._high, points.max(axis=0))
        entry = {
            "name": self._unique(f"{instance.name}.{name}" if is_split else instance.name),
            "mesh": path,
            "material": slot_name,
            "asset_from_part": metres_from_part,
        }
        density = uv_density(part, metres_from_part)
        if density is not None:
            entry["uv_per_m"] = density
        if len(part.faces):
            self.parts.append(entry)

    def _coordinates(
        self, mesh: Any, baked: BakedMaterial, metres_from_part: NDArray[np.float64], material: str
    ) -> NDArray[np.float32] | None:
        if baked.uv is not None:
            return baked.uv
        layer = (baked.frame.layer if baked.frame is not None else "") or mesh.active_uv
        if layer in mesh.uv_layers:
            return baked.texture_coordinates(mesh.uv_layers[layer])
        if self.job.settings.apply_box_uv and bpy.data.materials[material].get("sm_replaceable_by"):
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
        if any(image.needs_unit_uv for image in plan.images.values()) and self._exceeds_unit(name):
            return force_bake(plan, on_mesh=False)
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

    def _lookup(self, instance: Instance, slot: int, name: str) -> tuple[str, BakedMaterial | None]:
        return self._baked.get(self._key(instance, slot, name), ("", None))

    def _bake(self, instance: Instance, slot: int, name: str) -> tuple[str, BakedMaterial]:
        job, plan = self.job, self._effective_plan(name)
        material = bpy.data.materials[name]
        info = instance.object_info if plan.is_per_instance else None
        slot_name = name
        if plan.needs_mesh:
            thing = self._thing(instance)
            baked = job.baker.on_mesh(material, plan, thing, slot, self._layout(instance, slot), info)
        else:
            window = UNIT_WINDOW
            if plan.varying and plan.frame is not None and not plan.is_periodic:
                window = padded_window(*self._boxes[name])
            baked = job.baker.on_plane(material, plan, window, info)
        number = 1
        if plan.needs_mesh or plan.is_per_instance:
            slot_name = base = f"{name} on {instance.name}"
            while slot_name in self.materials:
                number += 1
                slot_name = f"{base} {number}"
        entry = material_entry(
            baked,
            slug(slot_name),
            material_classes(material, job.problems),
            job.approximations(name),
            self.writer,
            job.settings.texture_bits,
        )
        entry["replaceable_by"] = list(replaceable_by(material, job.problems))
        if material.get("sm_tile_size_m") is not None and baked.uv is None and baked.window == UNIT_WINDOW:
            entry["tile_size_m"] = float(material["sm_tile_size_m"])
        self.materials[slot_name] = entry
        self._baked[self._key(instance, slot, name)] = (slot_name, baked)
        return slot_name, baked

    def _thing(self, instance: Instance) -> bpy.types.Object:
        """The object of the session that shows the instance's mesh, standing where the instance stands."""
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
        """Materials, parts, lights and bounds for ``asset.json``."""
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
        result["parts"] = [
            {**part, "asset_from_part": move @ part["asset_from_part"]} for part in self.parts
        ]
        result["lights"] = [self._moved(light, offset) for light in self.contents.lights]
        return result

    def _moved(self, light: dict[str, Any], offset: NDArray[np.float64]) -> dict[str, Any]:
        light = dict(light)
        for key in ("position_m", "origin_m"):
            if key in light:
                light[key] = np.array(light[key]) + offset
        image = self.contents.images.get(light["name"]) if light["type"] == "environment" else None
        if image is not None:
            from .write import exr_bytes

            light["image"] = self.writer.add("textures", slug(light["name"]), ".exr", exr_bytes(image))
        return light


def _has_textures(baked: BakedMaterial) -> bool:
    return any(not isinstance(channel, tuple) for channel in baked.channels.values())
