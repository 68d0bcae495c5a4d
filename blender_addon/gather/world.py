# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts the world to an environment light: a constant radiance, or an equirectangular image."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..bake.execute import BakeSession
from ..bake.expression import BLACK, Constant, Expression, add, complement, is_constant, multiply, widen
from ..bake.graph import Stack, source_of, value_of
from ..cycles import pixels_of, render_linear
from ..problems import ERROR, ProblemList

# The centre column of an image is +Y in the asset format's environment frame, but +X of Blender's world.
WORLD_FROM_ENVIRONMENT = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], float)


def gather_world(
    scene: bpy.types.Scene, session: BakeSession, problems: ProblemList, size_px: int = 2048
) -> tuple[dict[str, Any], NDArray[np.float32] | None] | None:
    """The entry of the environment light and, unless it is constant, its image (H, W, 3), row 0 at the top.

    None if the world is black or missing. An equirectangular image, rotated at most about Z, keeps its
    pixels; any other graph is rendered as a panorama ``size_px`` wide.
    """
    world = scene.world
    if world is None:
        return None
    name = world.name
    if not world.use_nodes or world.node_tree is None:
        radiance: Expression | None = Constant(tuple(float(v) for v in world.color))
    else:
        output = world.node_tree.get_output_node("CYCLES")
        if output is None:
            return None
        if source_of((), output.inputs["Volume"]).is_linked:
            problems.add(ERROR, f"the volume of the world {name!r} cannot be exported", "unlink it")
        radiance = _background((), output.inputs["Surface"])
    if isinstance(radiance, Constant):
        if is_constant(radiance, 0):
            return None
        values = [max(0.0, v) for v in widen(radiance).value]  # type: ignore[union-attr]
        return {"type": "environment", "name": name, "radiance": values}, None
    entry: dict[str, Any] = {"type": "environment", "name": name}
    direct = _plain_panorama(world)
    if direct is not None:
        image, angle, strength = direct
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        matrix = turn @ WORLD_FROM_ENVIRONMENT
        return {**entry, "scale": strength, "world_from_environment": matrix}, image
    matrix = WORLD_FROM_ENVIRONMENT
    return {**entry, "scale": 1.0, "world_from_environment": matrix}, _panorama(world, session, size_px)


def _background(stack: Stack, socket: bpy.types.NodeSocket) -> Expression | None:
    """Radiance of a graph of background shaders as an expression; None if it must be rendered."""
    source = source_of(stack, socket)
    node = source.node
    if node is None:
        return BLACK
    if node.type in ("BACKGROUND", "EMISSION"):
        colour = value_of(source.stack, node.inputs["Color"])
        return multiply(colour, value_of(source.stack, node.inputs["Strength"]))
    if node.type in ("MIX_SHADER", "ADD_SHADER"):
        first, second = (_background(source.stack, s) for s in node.inputs[-2:])
        if first is None or second is None:
            return None
        if node.type == "ADD_SHADER":
            return add(first, second)
        factor = value_of(source.stack, node.inputs[0])
        return add(multiply(first, complement(factor)), multiply(second, factor))
    return None


def _plain_panorama(world: bpy.types.World) -> tuple[NDArray[np.float32], float, float] | None:
    """Pixels (H, W, 3), angle about Z [rad] and strength of an equirectangular world; None for others."""
    output = world.node_tree.get_output_node("CYCLES")
    if output is None:
        return None
    shader = source_of((), output.inputs["Surface"])
    if shader.node is None or shader.node.type != "BACKGROUND":
        return None
    strength = value_of(shader.stack, shader.node.inputs["Strength"])
    texture = source_of(shader.stack, shader.node.inputs["Color"])
    node = texture.node
    if not isinstance(strength, Constant) or node is None or node.type != "TEX_ENVIRONMENT":
        return None
    image = node.image
    if image is None or node.projection != "EQUIRECTANGULAR" or image.source != "FILE" or not image.is_float:
        return None
    if image.colorspace_settings.name not in ("Linear Rec.709", "Non-Color", "Raw"):
        return None
    angle = _turn_about_z(texture.stack, node.inputs["Vector"])
    if angle is None:
        return None
    return pixels_of(image)[..., :3].copy(), angle, max(0.0, strength.value[0])


def _turn_about_z(stack: Stack, socket: bpy.types.NodeSocket) -> float | None:
    """The angle [rad] by which the image is rotated about Z; None if it is mapped in another way."""
    source = source_of(stack, socket)
    if source.node is None:
        return 0.0
    if source.node.type == "TEX_COORD":
        return 0.0 if source.socket is not None and source.socket.name == "Generated" else None
    if source.node.type != "MAPPING" or source.node.vector_type != "POINT":
        return None
    values = []
    for name in ("Location", "Rotation", "Scale"):
        value = value_of(source.stack, source.node.inputs[name])
        if not isinstance(value, Constant):
            return None
        values.append(value.value)
    location, rotation, scale = values
    if any(location) or rotation[0] or rotation[1] or any(v != 1 for v in scale):
        return None
    before = _turn_about_z(source.stack, source.node.inputs["Vector"])
    if before is None or not source_of(source.stack, source.node.inputs["Vector"]).is_linked:
        return None
    return before - rotation[2]  # the image rotates by the inverse of its coordinates' rotation


def _panorama(world: bpy.types.World, session: BakeSession, size_px: int) -> NDArray[np.float32]:
    """Render the world alone through an equirectangular camera, one sample at each pixel's centre."""
    scene = session.scene
    camera = session.own(bpy.data.cameras, bpy.data.cameras.new(".sm_panorama"))
    camera.type = "PANO"
    settings = camera if hasattr(camera, "panorama_type") else camera.cycles
    settings.panorama_type = "EQUIRECTANGULAR"
    thing = session.own(bpy.data.objects, bpy.data.objects.new(".sm_panorama", camera))
    thing.rotation_euler = (np.pi / 2, 0, -np.pi / 2)  # looks along +X, Z up
    scene.collection.objects.link(thing)
    scene.camera, scene.world = thing, world
    render = scene.render
    render.resolution_x, render.resolution_y = size_px, size_px // 2
    render.resolution_percentage = 100
    scene.cycles.pixel_filter_type = "BLACKMAN_HARRIS"
    scene.cycles.filter_width = 0.01
    hidden = [(other, other.hide_render) for other in scene.collection.objects if other != thing]
    for other, _ in hidden:
        other.hide_render = True
    pixels = render_linear(scene)
    scene.world, scene.camera = None, None
    return pixels
