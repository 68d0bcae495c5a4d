# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders quick previews of sources with Cycles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

from scenes.sources.build import make


def render_preview(
    name: str, out: Path, samples: int = 24, width: int = 480, camera: Sequence[float] | None = None
) -> None:
    """Render an asset to the PNG file ``out``; ``camera`` (6,): position and target [m] in an environment."""
    kind = make(name)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.max_bounces = samples, True, 6
    scene.render.resolution_x, scene.render.resolution_y = width, width * 3 // 5
    scene.view_settings.view_transform = "AgX"
    world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    scene.world = world
    background = world.node_tree.nodes["Background"]
    if kind == "environment":
        background.inputs[0].default_value, background.inputs[1].default_value = (0.75, 0.87, 1.0, 1.0), 6.0
        _sun(4.0, (52, 8, 25))
        for thing in [t for t in scene.objects if t.get("sm_role")]:
            if thing["sm_role"] == "light_slot":
                _lamp(thing)
            thing.hide_render = True
        eye, target = (camera[:3], camera[3:]) if camera else ((2.2, -1.6, 1.5), (-0.8, 1.0, 0.9))
        lens = 20.0
    else:
        background.inputs[1].default_value = 0.7
        _sun(3.0, (40, 10, 40))
        low, high = _bounds()
        centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
        _ground(low[2], size)
        eye = centre + np.array([0.45, -1.2, 0.6]) * size * 1.35
        target, lens = centre, 50.0
    data = bpy.data.cameras.new("Camera")
    data.lens, data.clip_start = lens, 0.001
    viewer = bpy.data.objects.new("Camera", data)
    scene.collection.objects.link(viewer)
    viewer.location = eye
    viewer.rotation_euler = (Vector(target) - Vector(eye)).to_track_quat("-Z", "Y").to_euler()
    scene.camera = viewer
    scene.render.filepath = str(out.resolve())
    bpy.ops.render.render(write_still=True)


def _sun(strength: float, degrees: tuple[float, float, float]) -> None:
    data = bpy.data.lights.new("Sun", "SUN")
    data.energy, data.angle = strength, math.radians(2)
    thing = bpy.data.objects.new("Sun", data)
    thing.rotation_euler = [math.radians(d) for d in degrees]
    bpy.context.scene.collection.objects.link(thing)


def _lamp(marker: bpy.types.Object) -> None:
    corners = np.array([marker.matrix_world @ v.co for v in marker.data.vertices])
    data = bpy.data.lights.new("Lamp", "POINT")
    data.energy, data.shadow_soft_size = 60, 0.05
    thing = bpy.data.objects.new("Lamp", data)
    normal = np.array(marker.matrix_world)[:3, 2]
    thing.location = corners.mean(axis=0) + 0.06 * normal
    bpy.context.scene.collection.objects.link(thing)


def _bounds() -> tuple[np.ndarray, np.ndarray]:
    meshes = [t for t in bpy.context.scene.objects if t.type == "MESH"]
    if not meshes:
        bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5, segments=64, ring_count=32)
        ball = bpy.context.object
        ball.data.materials.append(next(m for m in bpy.data.materials if m.get("sm_role")))
        meshes = [ball]
    points = np.concatenate([[t.matrix_world @ v.co for v in t.data.vertices] for t in meshes])
    return points.min(axis=0), points.max(axis=0)


def _ground(z: float, size: float) -> None:
    bpy.ops.mesh.primitive_plane_add(size=20 * size, location=(0, 0, z))
    material = bpy.data.materials.new("Ground")
    material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.45, 0.43, 0.4, 1)
    bpy.context.object.data.materials.append(material)
