# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes the expressions of material channels to arrays, by Cycles' EMIT bake in a separate scene.

All created data (scene, copies of materials and groups, images, meshes) belongs to a :class:`BakeSession` and
is removed when it closes, also after errors.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .expression import Constant, Expression, Operation, SocketValue
from .graph import group_output

BAKE_UV = "sm_bake"
_PREFIX = ".sm_"
_VECTOR_MATH = {
    "add": "ADD", "subtract": "SUBTRACT", "multiply": "MULTIPLY", "divide": "DIVIDE",
    "minimum": "MINIMUM", "maximum": "MAXIMUM",
}  # fmt: skip
_SCALAR_MATH = {**_VECTOR_MATH, "sqrt": "SQRT"}
Array = NDArray[np.float32]
_NOT_BAKED = -1.0
"""Initial value of texels, which EMIT and NORMAL bakes never write. (Alpha does not mark baked texels: a bake
that clears its image sets it to 1 everywhere.)"""


@dataclass(frozen=True)
class WorkingMaterial:
    """A copy of a material; ``outputs`` maps each channel to a socket of its top-level tree or a constant.

    ``emission`` is the Emission node of the channel to bake, ``target`` the Image Texture node of the image
    that receives it; ``surface`` is the output of the original shader, for baking normals, None without one.
    """

    material: bpy.types.Material
    outputs: dict[str, bpy.types.NodeSocket | Constant]
    emission: bpy.types.Node
    target: bpy.types.Node
    surface: bpy.types.NodeSocket | None


class BakeSession:
    """Context manager that owns a temporary scene, and all data created for baking."""

    def __init__(self) -> None:
        self._created: list[tuple[Any, Any]] = []
        self._scene: bpy.types.Scene | None = None

    def __enter__(self) -> BakeSession:
        self._scene = bpy.data.scenes.new(f"{_PREFIX}bake")
        self._scene.render.engine = "CYCLES"
        cycles = self._scene.cycles
        cycles.samples = 1
        cycles.use_adaptive_sampling = False
        cycles.use_denoising = False
        cycles.device = "CPU"
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for collection, block in reversed(self._created):
            collection.remove(block, do_unlink=True)
        self._created.clear()
        if self._scene is not None:
            world = self._scene.world
            bpy.data.scenes.remove(self._scene, do_unlink=True)
            if world is not None and world.users == 0:
                bpy.data.worlds.remove(world)
            self._scene = None

    @property
    def scene(self) -> bpy.types.Scene:
        assert self._scene is not None, "the session is closed"
        return self._scene

    def own(self, collection: Any, block: Any) -> Any:
        """Register a datablock of ``collection`` for removal when the session closes, and return it."""
        self._created.append((collection, block))
        return block

    def discard(self, block: Any) -> None:
        """Remove an owned datablock before exit."""
        for index, (collection, owned) in enumerate(self._created):
            if owned == block:
                del self._created[index]
                collection.remove(block, do_unlink=True)
                return

    # ---- materials

    def working_material(
        self,
        material: bpy.types.Material,
        expressions: dict[str, Expression],
        object_info: dict[str, tuple[float, ...]] | None = None,
    ) -> WorkingMaterial:
        """Copy a material, add nodes for ``expressions`` (by channel), and replace Object Info nodes by the
        values ``object_info`` (by name of the output).
        """
        copy = self.own(bpy.data.materials, material.copy())
        copy.name = f"{_PREFIX}{material.name}"
        tree = copy.node_tree
        builder = _Builder(self, tree, object_info or {})
        if object_info is not None:
            builder.fix_object_info(tree, ())
        outputs = {name: builder.build(expression) for name, expression in expressions.items()}
        emission = tree.nodes.new("ShaderNodeEmission")
        target = tree.nodes.new("ShaderNodeTexImage")
        output = tree.get_output_node("CYCLES")
        for name in ("Displacement", "Volume"):
            for link in list(output.inputs[name].links):
                tree.links.remove(link)
        links = output.inputs["Surface"].links
        surface = links[0].from_socket if links else None
        tree.links.new(emission.outputs[0], output.inputs["Surface"])
        for node in tree.nodes:
            node.select = False
        target.select = True
        tree.nodes.active = target
        return WorkingMaterial(copy, outputs, emission, target, surface)

    # ---- objects

    def plane(
        self, material: bpy.types.Material, uv_layers: dict[str, Array], side: float, active: str
    ) -> bpy.types.Object:
        """Create a square in the XY plane, from 0 to ``side`` (Blender units) along both axes.

        ``uv_layers``: UVs (4, 2) of its corners, by layer. ``active``: the layer of nodes that name none.
        """
        mesh = self.own(bpy.data.meshes, bpy.data.meshes.new(f"{_PREFIX}plane"))
        mesh.from_pydata([(0, 0, 0), (side, 0, 0), (side, side, 0), (0, side, 0)], [], [(0, 1, 2, 3)])
        for name, values in uv_layers.items():
            layer = mesh.uv_layers.new(name=name)
            layer.uv.foreach_set("vector", np.ascontiguousarray(values, np.float32).ravel())
            if name == active:
                layer.active_render = True
        bake = mesh.uv_layers.new(name=BAKE_UV)
        bake.uv.foreach_set("vector", UNIT_SQUARE.ravel())
        mesh.materials.append(material)
        return self.object_of(mesh)

    def object_of(self, mesh: bpy.types.Mesh) -> bpy.types.Object:
        """Add an object with ``mesh`` to the session's scene."""
        thing = self.own(bpy.data.objects, bpy.data.objects.new(f"{_PREFIX}object", mesh))
        self.scene.collection.objects.link(thing)
        return thing

    @contextmanager
    def only(self, thing: bpy.types.Object) -> Iterator[None]:
        """Context for operators in which ``thing`` is the only rendered object, selected and active."""
        layer = self.scene.view_layers[0]
        for other in self.scene.collection.objects:
            other.hide_render = other != thing
        thing.select_set(True, view_layer=layer)
        layer.objects.active = thing
        with bpy.context.temp_override(
            scene=self.scene,
            view_layer=layer,
            active_object=thing,
            object=thing,
            selected_objects=[thing],
            selected_editable_objects=[thing],
        ):
            yield

    # ---- baking

    def bake(
        self, thing: bpy.types.Object, working: WorkingMaterial, channel: str, size: int
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Bake a channel; returns pixels (size, size, 3), row 0 at the bottom, and a mask of baked pixels."""
        tree = working.material.node_tree
        colour = working.emission.inputs["Color"]
        for link in list(colour.links):
            tree.links.remove(link)
        source = working.outputs[channel]
        if isinstance(source, Constant):
            value = source.value * (3 if source.width == 1 else 1)
            return np.full((size, size, 3), value, np.float32), np.ones((size, size), bool)
        tree.links.new(source, colour)
        return self._run("EMIT", thing, working, size)

    def bake_normal(
        self, thing: bpy.types.Object, working: WorkingMaterial, size: int
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Bake tangent-space normals of the original surface, as (n + 1) / 2, +Y up; see :meth:`bake`."""
        tree = working.material.node_tree
        end = tree.get_output_node("CYCLES").inputs["Surface"]
        assert working.surface is not None
        tree.links.new(working.surface, end)
        thing.data.uv_layers.active = thing.data.uv_layers[BAKE_UV]
        try:
            return self._run("NORMAL", thing, working, size)
        finally:
            tree.links.new(working.emission.outputs[0], end)

    def _run(
        self, kind: str, thing: bpy.types.Object, working: WorkingMaterial, size: int
    ) -> tuple[Array, NDArray[np.bool_]]:
        image = bpy.data.images.new(
            f"{_PREFIX}target", size, size, alpha=True, float_buffer=True, is_data=True
        )
        self.own(bpy.data.images, image)
        try:
            pixels = np.full(size * size * 4, _NOT_BAKED, np.float32)
            image.pixels.foreach_set(pixels)
            working.target.image = image
            with self.only(thing):
                bpy.ops.object.bake(type=kind, uv_layer=BAKE_UV, margin=0, use_clear=False)
            image.pixels.foreach_get(pixels)
        finally:
            working.target.image = None
            self.discard(image)
        pixels = pixels.reshape(size, size, 4)
        red, green, blue = (pixels[..., component] != _NOT_BAKED for component in range(3))
        return np.ascontiguousarray(pixels[..., :3]), red | green | blue


UNIT_SQUARE: Array = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


@dataclass
class _Builder:
    """Builds expressions as nodes of the tree of a working material."""

    session: BakeSession
    tree: bpy.types.NodeTree
    object_info: dict[str, tuple[float, ...]]
    _single_user: set[tuple[str, ...]] = field(default_factory=set)
    _built: dict[Expression, bpy.types.NodeSocket | Constant] = field(default_factory=dict)

    def fix_object_info(self, tree: bpy.types.NodeTree, path: tuple[str, ...]) -> None:
        """Replace links from Object Info nodes by values, in ``tree`` at ``path`` and in its groups."""
        for node in list(tree.nodes):
            if node.type == "GROUP" and node.node_tree is not None:
                self._make_single((*path, node.name), node)
                self.fix_object_info(node.node_tree, (*path, node.name))
            elif node.type == "OBJECT_INFO":
                for output in node.outputs:
                    value = self.object_info[output.name]
                    for link in list(output.links):
                        if len(value) == 1:
                            source = tree.nodes.new("ShaderNodeValue")
                            source.outputs[0].default_value = value[0]
                        else:
                            source = tree.nodes.new("ShaderNodeCombineXYZ")
                            for socket, component in zip(source.inputs, value, strict=True):
                                socket.default_value = component
                        tree.links.new(source.outputs[0], link.to_socket)

    def _make_single(self, path: tuple[str, ...], node: bpy.types.Node) -> None:
        """Replace a group node's tree by a copy that no other node uses, unless done before."""
        if path not in self._single_user:
            node.node_tree = self.session.own(bpy.data.node_groups, node.node_tree.copy())
            node.node_tree.name = f"{_PREFIX}group"
            self._single_user.add(path)

    def build(self, expression: Expression) -> bpy.types.NodeSocket | Constant:
        """Build the nodes of an expression; returns their output socket, or a constant unchanged."""
        if isinstance(expression, Constant):
            return expression
        if expression not in self._built:
            if isinstance(expression, SocketValue):
                self._built[expression] = self._expose(expression)
            else:
                self._built[expression] = self._operation(expression)
        return self._built[expression]

    def _expose(self, value: SocketValue) -> bpy.types.NodeSocket | Constant:
        tree, groups = self.tree, []
        for depth, name in enumerate(value.path):
            node = tree.nodes[name]
            self._make_single(value.path[: depth + 1], node)
            groups.append(node)
            tree = node.node_tree
        socket = next(o for o in tree.nodes[value.node].outputs if o.identifier == value.socket)
        if tree.nodes[value.node].type == "OBJECT_INFO" and self.object_info:
            return Constant(self.object_info[socket.name])
        for group in reversed(groups):
            inner = group.node_tree
            end = group_output(inner) or inner.nodes.new("NodeGroupOutput")
            kind = {"VALUE": "NodeSocketFloat", "RGBA": "NodeSocketColor"}.get(
                socket.type, "NodeSocketVector"
            )
            item = inner.interface.new_socket(name="sm_value", in_out="OUTPUT", socket_type=kind)
            inner.links.new(socket, next(i for i in end.inputs if i.identifier == item.identifier))
            socket = next(o for o in group.outputs if o.identifier == item.identifier)
        return socket

    def _operation(self, operation: Operation) -> bpy.types.NodeSocket:
        if operation.name == "luminance":
            node = self.tree.nodes.new("ShaderNodeRGBToBW")
            self._connect(operation.arguments[0], node.inputs[0])
            return node.outputs[0]
        if operation.name == "average":
            node = self.tree.nodes.new("ShaderNodeVectorMath")
            node.operation = "DOT_PRODUCT"
            self._connect(operation.arguments[0], node.inputs[0])
            node.inputs[1].default_value = (1 / 3,) * 3
            return node.outputs["Value"]
        if operation.width == 3:
            node = self.tree.nodes.new("ShaderNodeVectorMath")
            node.operation = _VECTOR_MATH[operation.name]
        else:
            node = self.tree.nodes.new("ShaderNodeMath")
            node.operation = _SCALAR_MATH[operation.name]
        for argument, socket in zip(operation.arguments, node.inputs, strict=False):
            self._connect(argument, socket)
        return node.outputs[0]

    def _connect(self, expression: Expression, socket: bpy.types.NodeSocket) -> None:
        built = self.build(expression)
        if not isinstance(built, Constant):
            self.tree.links.new(built, socket)
        elif hasattr(socket.default_value, "__len__"):
            components = built.value if built.width == 3 else built.value * 3
            socket.default_value = (*components, 1.0)[: len(socket.default_value)]
        else:
            socket.default_value = built.value[0]
