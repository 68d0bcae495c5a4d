# SPDX-License-Identifier: GPL-3.0-or-later
"""Traces values of a shader graph to their sources, without changing the graph.

A *stack* is the tuple of group nodes from the material's tree to the current tree. Reroutes, muted nodes and
group boundaries are passed through; muted links are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy

from .expression import Constant, Expression, SocketValue, constant, reduce_to_scalar, widen

Stack = tuple[bpy.types.Node, ...]
_WIDTH = {"VALUE": 1, "INT": 1, "BOOLEAN": 1, "RGBA": 3, "VECTOR": 3, "ROTATION": 3}
_MAX_HOPS = 10_000  # a cycle of reroutes would otherwise be followed forever


@dataclass(frozen=True)
class Source:
    """Source of an input's value: an output ``socket`` of ``node``, or an unlinked input without ``node``.

    Both are None for a muted node without an internal link.
    """

    stack: Stack
    node: bpy.types.Node | None
    socket: bpy.types.NodeSocket | None

    @property
    def is_linked(self) -> bool:
        return self.node is not None


def group_output(tree: bpy.types.NodeTree) -> bpy.types.Node | None:
    """The active output node of a group, or None."""
    outputs = [node for node in tree.nodes if node.bl_idname == "NodeGroupOutput"]
    return next((node for node in outputs if node.is_active_output), outputs[0] if outputs else None)


def _by_identifier(sockets: bpy.types.bpy_prop_collection, identifier: str) -> bpy.types.NodeSocket | None:
    return next((socket for socket in sockets if socket.identifier == identifier), None)


def source_of(stack: Stack, socket: bpy.types.NodeSocket) -> Source:
    """Trace an input socket to its source. Raises ``RuntimeError`` if links form a cycle."""
    for _ in range(_MAX_HOPS):
        link = next((link for link in socket.links if not link.is_muted and link.is_valid), None)
        if link is None:
            return Source(stack, None, socket)
        node, output = link.from_node, link.from_socket
        if node.bl_idname == "NodeReroute":
            socket = node.inputs[0]
        elif node.mute:
            passage = next((inner for inner in node.internal_links if inner.to_socket == output), None)
            if passage is None:
                return Source(stack, None, None)
            socket = passage.from_socket
        elif node.bl_idname == "NodeGroupInput":
            outer = _by_identifier(stack[-1].inputs, output.identifier)
            if outer is None:
                return Source(stack, None, None)
            stack, socket = stack[:-1], outer
        elif node.bl_idname == "ShaderNodeGroup":
            inner = group_output(node.node_tree) if node.node_tree else None
            inner_socket = _by_identifier(inner.inputs, output.identifier) if inner else None
            if inner_socket is None:
                return Source(stack, None, None)
            stack, socket = (*stack, node), inner_socket
        else:
            return Source(stack, node, output)
    raise RuntimeError(f"links around node {socket.node.name!r} form a cycle")


def path_of(stack: Stack) -> tuple[str, ...]:
    """Names of a stack's group nodes, outermost first."""
    return tuple(node.name for node in stack)


def input_of(node: bpy.types.Node, *names: str) -> bpy.types.NodeSocket | None:
    """The first input whose identifier or name is one of ``names``, or None."""
    for name in names:
        socket = _by_identifier(node.inputs, name) or node.inputs.get(name)
        if socket is not None:
            return socket
    return None


def socket_width(socket: bpy.types.NodeSocket) -> int:
    """Number of components: 1 for values, 3 for colours and vectors."""
    return _WIDTH[socket.type]


def default_of(socket: bpy.types.NodeSocket) -> Constant:
    """The default value of an input socket, without the alpha of a colour."""
    value = socket.default_value
    return constant(*tuple(value)[:3]) if hasattr(value, "__len__") else constant(float(value))


_OF_IMAGES = ("TEX_IMAGE", "SEPARATE_COLOR", "SEPRGB")
LIGHT_PATH_VALUES = {"Is Camera Ray": 1.0}  # of a camera ray; all other outputs are 0


def value_of(stack: Stack, socket: bpy.types.NodeSocket) -> Expression:
    """The value of an input socket as an expression, which is scalar if the socket is."""
    source = source_of(stack, socket)
    if source.socket is None:
        value: Expression = constant(0.0)
        kind = "VALUE"
    elif source.node is None:
        value, kind = default_of(source.socket), source.socket.type
    elif source.node.type == "VALUE":
        value, kind = constant(source.node.outputs[0].default_value), "VALUE"
    elif source.node.type == "RGB":
        value, kind = constant(*source.node.outputs[0].default_value[:3]), "RGBA"
    elif (folded := _known_product(source)) is not None:
        value, kind = folded, "VALUE"
    elif source.node.type == "LIGHT_PATH":
        value, kind = constant(LIGHT_PATH_VALUES.get(source.socket.name, 0.0)), "VALUE"
    else:
        kind = source.socket.type
        value = SocketValue(
            path_of(source.stack), source.node.name, source.socket.identifier, socket_width(source.socket)
        )
    if socket_width(socket) == 1:
        return reduce_to_scalar(value, "average" if kind == "VECTOR" else "luminance")
    return widen(value)


def _known_product(source: Source) -> Constant | None:
    """0 if a Math node multiplies an image's component by 0, as importers do to disable a texture; else None.

    A bake would detect this constant too, but then all images of the material would be baked.
    """
    node = source.node
    if node is None or node.type != "MATH" or node.operation != "MULTIPLY":
        return None
    factors = [source_of(source.stack, socket) for socket in node.inputs[:2]]
    known = [default_of(f.socket) for f in factors if f.node is None and f.socket is not None]
    is_of_image = any(f.node is not None and f.node.type in _OF_IMAGES for f in factors)
    return constant(0.0) if constant(0.0) in known and is_of_image else None


def node_at(tree: bpy.types.NodeTree, path: tuple[str, ...], name: str) -> tuple[Stack, bpy.types.Node]:
    """Find the node ``name`` inside the nested groups ``path``; returns its stack and the node."""
    stack: Stack = ()
    for group in path:
        stack = (*stack, tree.nodes[group])
        tree = stack[-1].node_tree
    return stack, tree.nodes[name]
