# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads an asset to export: its instances, lights, cameras, world and markers; plans its materials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .bake.execute import BakeSession
from .bake.plan import MaterialPlan, plan_material
from .gather.cameras import gather_camera
from .gather.instances import Gathered, gather_instances
from .gather.lights import gather_light
from .gather.markers import gather_markers
from .gather.tags import (
    SUPPORT_KINDS,
    check_words,
    material_classes,
    numbers,
    provenance,
    replaceable_by,
    role_of,
    slug,
    surfaces,
    tile_size_m,
    words,
)
from .gather.world import gather_world
from .problems import APPROXIMATION, ERROR, ProblemList
from .settings import ExportSettings
from .targets import Target


@dataclass
class Contents:
    """An asset to export, ``target``, with all data read from the scene.

    ``copies``: meshes to bake, by mesh key; ``images``: pixels (H, W, 3) of environment lights, by name;
    ``extra``: further fields of ``asset.json``.
    """

    target: Target
    gathered: Gathered = field(default_factory=Gathered)
    copies: dict[int, bpy.types.Mesh] = field(default_factory=dict)
    lights: list[dict[str, Any]] = field(default_factory=list)
    images: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)
    num_triangles: int = 0


def rendering_layers() -> dict[str, str]:
    """Name of the UV layer active in rendering, by material; only materials whose meshes all share it."""
    found: dict[str, set[str]] = {}
    for thing in bpy.data.objects:
        is_mesh = isinstance(thing.data, bpy.types.Mesh)
        layers = thing.data.uv_layers if is_mesh else ()
        name = next((layer.name for layer in layers if layer.active_render), "")
        for slot in thing.material_slots:
            if slot.material is not None:
                found.setdefault(slot.material.name, set()).add(name)
    return {material: names.pop() for material, names in found.items() if len(names) == 1}


class Reader:
    """Reads the targets of an export from ``scene``; ``depsgraph`` returns its evaluated dependency graph."""

    def __init__(
        self,
        settings: ExportSettings,
        session: BakeSession,
        problems: ProblemList,
        scene: bpy.types.Scene,
        depsgraph: Callable[[], bpy.types.Depsgraph],
    ):
        self.settings, self.session, self.problems = settings, session, problems
        self.scene, self.depsgraph = scene, depsgraph
        self.metres = scene.unit_settings.scale_length or 1.0
        self._plans: dict[str, MaterialPlan] = {}
        self._rendering_layers = rendering_layers()

    def plan(self, name: str) -> MaterialPlan:
        """Plan a material (at most once), and add its problems to the list."""
        if name not in self._plans:
            self._plans[name] = plan_material(
                bpy.data.materials[name], self.settings.bake_normals, self._rendering_layers.get(name, "")
            )
            self.problems.extend(self._plans[name].problems)
        return self._plans[name]

    def uv_layers(self) -> dict[str, tuple[str, ...]]:
        """Names of the UV maps to which the nodes of each planned material refer, by the material's name."""
        return {name: plan.dependencies.layer_names for name, plan in sorted(self._plans.items())}

    # ---- reading

    def prepare(self, target: Target) -> Contents:
        """Read a target and plan its materials; adds every problem to the list."""
        contents = Contents(target)
        fallback = {key: getattr(self.settings, key) for key in ("license", "author", "source")}
        contents.extra["provenance"] = provenance(target.tagged, fallback, self.problems)
        if target.kind == "material":
            material = bpy.data.materials[target.tagged.name]
            self.plan(material.name)
            tile_size_m(material, self.problems)
            found = surfaces(material, "sm_surfaces", self.problems)
            if found:
                contents.extra["surfaces"] = list(found)
            return contents

        def keep(key: int, mesh: bpy.types.Mesh, materials: tuple[str | None, ...]) -> None:
            if key not in contents.copies and any(
                name is not None and self.plan(name).needs_mesh for name in materials
            ):
                copy = self.session.own(bpy.data.meshes, mesh.copy())
                copy.use_auto_texspace = False
                copy.texspace_location = mesh.texspace_location
                copy.texspace_size = mesh.texspace_size
                contents.copies[key] = copy

        depsgraph = self.depsgraph()  # requested again, as steps of an export may re-evaluate it
        contents.gathered = gather_instances(depsgraph, target.owners.__contains__, keep, self.problems)
        self._check_materials(contents)
        if not contents.gathered.instances:
            self.problems.add(
                ERROR, f"{target.title!r} contains no visible surface", "add a mesh, or correct the tags"
            )
        self._prepare_lights(contents, depsgraph)
        if target.kind == "object":
            self._prepare_object(contents)
        else:
            self._prepare_environment(contents)
        return contents

    def _check_materials(self, contents: Contents) -> None:
        seen: set[tuple[int, tuple[str | None, ...]]] = set()
        for instance in contents.gathered.instances:
            if (instance.mesh_key, instance.materials) in seen:
                continue
            seen.add((instance.mesh_key, instance.materials))
            mesh = contents.gathered.meshes[instance.mesh_key]
            for slot in mesh.used_slots:
                name = instance.materials[min(slot, len(instance.materials) - 1)]
                if name is None:
                    self.problems.add(
                        ERROR, f"slot {slot} has no material", "assign one", object=instance.owner
                    )
                    continue
                plan = self.plan(name)
                material_classes(bpy.data.materials[name], self.problems)
                replaceable_by(bpy.data.materials[name], self.problems)
                tile_size_m(bpy.data.materials[name], self.problems)
                has_textures = plan.images or plan.varying or plan.bakes_normal
                for layer in plan.dependencies.uv_layers if has_textures else ():
                    if (layer or mesh.active_uv) not in mesh.uv_layers:
                        wanted = f"the UV map {layer!r}" if layer else "a UV map"
                        message = f"the material needs {wanted}, which the mesh does not have"
                        self.problems.add(
                            ERROR, message, "unwrap the mesh", object=instance.owner, material=name
                        )

    def _prepare_lights(self, contents: Contents, depsgraph: bpy.types.Depsgraph) -> None:
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

    def _prepare_object(self, contents: Contents) -> None:
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
                is_positive = key != "scale_range" or all(value > 0 for value in values)
                if len(values) != 2 or values[0] > values[1] or not is_positive:
                    found = f"{tag} = {values or tagged[tag]!r} of {tagged.name!r}"
                    wanted = "two positive numbers" if key == "scale_range" else "two numbers"
                    self.problems.add(ERROR, found, f"give {wanted}, the smaller first")
                contents.extra[key] = list(values)

    def _prepare_environment(self, contents: Contents) -> None:
        scene, target = self.scene, contents.target
        things = [thing for thing in scene.objects if thing.name in target.owners]
        contents.extra.update(gather_markers(things, self.metres, self.problems))
        cameras = [
            gather_camera(thing, scene.render, self.metres, self.problems)
            for thing in sorted(things, key=lambda t: t.name)
            if thing.type == "CAMERA" and not thing.hide_render and role_of(thing) != "ignore"
        ]
        contents.extra["cameras"] = [dict(vars(camera)) for camera in cameras if camera]
        light = gather_world(scene, self.session, self.problems, min(self.settings.max_texture_px, 2048))
        if light is not None:
            entry, image = light
            if image is not None:
                contents.images[entry["name"]] = image
            contents.lights.append(entry)

    def approximations(self, material: str) -> tuple[str, ...]:
        """Messages on the differences between a material as exported and as rendered by Blender."""
        return tuple(
            (f"{problem.node}: " if problem.node else "") + problem.message
            for problem in self.problems
            if problem.material == material and problem.severity == APPROXIMATION
        )
