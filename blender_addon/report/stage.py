# SPDX-License-Identifier: GPL-3.0-or-later
"""Small scenes for comparing renderers: each material on a sphere and a plane, each light on a square.

All data-blocks belong to a :class:`~blender_addon.bake.execute.BakeSession` and are removed with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from ..bake.execute import BakeSession

PICTURE_PX = 112
SAMPLES = 48
_SPACING = 40.0  # neighbours change a material's light by less than a thousandth
_PREFIX = ".sm_report"
SPHERE_ROWS, SPHERE_COLUMNS = 48, 96


def _prepare(session: BakeSession, identity: str) -> bpy.types.Scene:
    scene = session.scene
    scene["sm_id"], scene["sm_license"] = identity, "CC0-1.0"
    scene.render.resolution_x = scene.render.resolution_y = PICTURE_PX
    scene.render.resolution_percentage = 100
    scene.render.use_persistent_data = True
    scene.cycles.samples = SAMPLES
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 1.0
    scene.cycles.max_bounces = 7
    return scene


def sphere_mesh(session: BakeSession, radius: float) -> bpy.types.Mesh:
    """Create a smooth sphere about (0, 0, radius); u is the longitude, v the latitude, both in [0, 1]."""
    rows, columns = SPHERE_ROWS, SPHERE_COLUMNS
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns + 1), indexing="ij"
    )
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 1], axis=-1)
    uv = np.stack([phi / (2 * np.pi), 1 - theta / np.pi], axis=-1).reshape(-1, 2)
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)[None, :]).ravel()
    faces = np.stack([first, first + columns + 1, first + columns + 2, first + 1], axis=1)
    mesh = session.own(bpy.data.meshes, bpy.data.meshes.new(f"{_PREFIX}_sphere"))
    mesh.from_pydata((radius * points.reshape(-1, 3)).tolist(), [], faces.tolist())
    layer = mesh.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", uv[faces.ravel()].astype(np.float32).ravel())
    normals = points.reshape(-1, 3) - [0, 0, 1]
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
    mesh.normals_split_custom_set_from_vertices(normals.tolist())
    return mesh


def plane_mesh(session: BakeSession, side: float) -> bpy.types.Mesh:
    """Create a square of side length ``side`` in the XY plane about the origin, with UVs from 0 to 1."""
    mesh = session.own(bpy.data.meshes, bpy.data.meshes.new(f"{_PREFIX}_plane"))
    h = side / 2
    mesh.from_pydata([(-h, -h, 0), (h, -h, 0), (h, h, 0), (-h, h, 0)], [], [(0, 1, 2, 3)])
    layer = mesh.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.array([0, 0, 1, 0, 1, 1, 0, 1], np.float32))
    return mesh


def _camera(
    session: BakeSession, eye: np.ndarray, target: np.ndarray, lens: float, index: int = 0
) -> bpy.types.Object:
    camera = session.own(bpy.data.cameras, bpy.data.cameras.new(f"{_PREFIX}_camera"))
    camera.lens = lens
    thing = session.own(bpy.data.objects, bpy.data.objects.new(f"{_PREFIX}_camera_{index:06d}", camera))
    back = (eye - target) / np.linalg.norm(eye - target)
    side = np.cross([0.0, 0.0, 1.0] if abs(back[2]) < 0.99 else [0.0, 1.0, 0.0], back)
    side /= np.linalg.norm(side)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = side, np.cross(back, side), back, eye
    thing.matrix_world = matrix.T.tolist()
    session.scene.collection.objects.link(thing)
    return thing


def material_stage(
    session: BakeSession, materials: Sequence[bpy.types.Material], layers: Sequence[Sequence[str]]
) -> list[bpy.types.Object]:
    """Build the scene of all materials under a sun and a uniform sky; returns a camera for each, in order.

    ``layers``: for each material, names of the UV maps that its nodes read; all get the shape's UVs.
    """
    scene = _prepare(session, "report_materials")
    sun = session.own(bpy.data.lights, bpy.data.lights.new(f"{_PREFIX}_sun", "SUN"))
    sun.energy, sun.angle = 2.0, 0.15
    light = session.own(bpy.data.objects, bpy.data.objects.new(f"{_PREFIX}_sun", sun))
    light.rotation_euler = (0.6, 0.5, 0.0)
    scene.collection.objects.link(light)
    scene.world = session.own(bpy.data.worlds, bpy.data.worlds.new(f"{_PREFIX}_sky"))
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.35, 0.35, 0.35, 1.0)
    cameras = []
    for index, material in enumerate(materials):
        place = np.array([(index % 20) * _SPACING, (index // 20) * _SPACING, 0.0])
        for mesh in (sphere_mesh(session, 0.5), plane_mesh(session, 2.4)):
            mesh.materials.append(material)
            for name in layers[index]:
                if name not in mesh.uv_layers:
                    mesh.uv_layers.new(name=name)  # a copy of the active one
            session.object_of(mesh).location = place
        eye, target = place + np.array([0.0, -3.2, 1.9]), place + np.array([0.0, 0.0, 0.36])
        cameras.append(_camera(session, eye, target, lens=60, index=index))
    return cameras


def light_stage(session: BakeSession, light: bpy.types.Object | bpy.types.World) -> None:
    """Build a scene with a camera and a grey square that faces ``light`` or, for a world, a grey sphere."""
    scene = _prepare(session, "report_light")
    grey = session.own(bpy.data.materials, bpy.data.materials.new(f"{_PREFIX}_grey"))
    grey.use_nodes = True
    diffuse = grey.node_tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1.0)
    grey.node_tree.links.new(diffuse.outputs[0], grey.node_tree.nodes["Material Output"].inputs["Surface"])
    if isinstance(light, bpy.types.World):
        scene.world = light
        mesh = sphere_mesh(session, 0.5)
        mesh.materials.append(grey)
        session.object_of(mesh)
        scene.camera = _camera(session, np.array([0.0, -3.0, 0.9]), np.array([0.0, 0.0, 0.5]), lens=75)
        return
    copy = session.own(bpy.data.objects, light.copy())
    copy.parent = None
    copy.constraints.clear()
    copy.animation_data_clear()
    copy.hide_render = False
    copy.matrix_world = light.matrix_world
    scene.collection.objects.link(copy)
    pose = np.array(light.matrix_world, dtype=np.float64)
    axis = pose[:3, 2] / np.linalg.norm(pose[:3, 2])
    if light.data.type == "POINT":
        axis = np.array([0.0, 0.0, 1.0])
    size = max(getattr(light.data, "size", 0.0), 2 * getattr(light.data, "shadow_soft_size", 0.0), 0.5)
    distance = 2.0 * size
    frame = _frame_along(axis)
    mesh = plane_mesh(session, distance)
    mesh.materials.append(grey)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = frame, pose[:3, 3] - distance * axis
    session.object_of(mesh).matrix_world = matrix.T.tolist()
    eye = matrix[:3, 3] + distance * (0.55 * axis + 0.9 * frame[:, 0])
    scene.camera = _camera(session, eye, matrix[:3, 3], lens=60)


def _frame_along(axis: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) whose third column is the unit vector ``axis``."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    side = np.cross(helper, axis)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(axis, side), axis], axis=1)
