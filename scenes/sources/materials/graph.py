# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds node graphs that are periodic over the UV unit square (the tile), for seamless baked textures.

The tile is mapped to a torus in four dimensions, (cos 2πu, sin 2πu, cos 2πv, sin 2πv), on which 4D noise is
evaluated; lattices (planks, tiles, threads) have a whole number of cells per tile and wrap. Scales are in
cells per tile. A value is an :class:`Output` of a node or a constant: a number or a linear RGB tuple.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeAlias

import bpy

Color = tuple[float, float, float]
Value: TypeAlias = "Output | float"
ColorValue: TypeAlias = "Output | Color"


def srgb(code: str) -> Color:
    """Linear Rec.709 colour of the sRGB code ``rrggbb``."""
    parts = [int(code[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    r, g, b = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return (r, g, b)


def _operator(operation: str) -> Callable[..., Output]:
    return lambda output, other=0.0: output.graph.math(operation, output, other)


def _reflected(operation: str) -> Callable[[Output, float], Output]:
    return lambda output, other: output.graph.math(operation, other, output)


@dataclass(frozen=True, eq=False)
class Output:
    """The output ``socket`` of a node. Operators add Math nodes; ``>`` and ``<`` give 1 if true, else 0."""

    graph: Graph
    socket: bpy.types.NodeSocket

    __add__, __radd__ = _operator("ADD"), _reflected("ADD")
    __sub__, __rsub__ = _operator("SUBTRACT"), _reflected("SUBTRACT")
    __mul__, __mod__, __pow__ = map(_operator, ("MULTIPLY", "MODULO", "POWER"))
    __gt__, __lt__, __abs__ = map(_operator, ("GREATER_THAN", "LESS_THAN", "ABSOLUTE"))


@dataclass(frozen=True)
class Cells:
    """Outputs of a lattice: ``number`` of the cell, position ``x`` and ``y`` in [0, 1) inside the cell, and
    ``edge``, the distance to the cell's border as a share of the tile's side.
    """

    number: Output
    x: Output
    y: Output
    edge: Output


class Graph:
    """Builds the node tree of one material."""

    def __init__(self, name: str) -> None:
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.tree.nodes.clear()
        self.output = self.tree.nodes.new("ShaderNodeOutputMaterial")
        self._uv: tuple[Output, Output] | None = None

    # nodes and links -------------------------------------------------------------------------------------
    def node(self, kind: str, **settings: object) -> bpy.types.Node:
        """Add a node of Blender's type ``kind``; keyword arguments set its properties."""
        node = self.tree.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        return node

    def feed(self, target: bpy.types.NodeSocket, value: Value | ColorValue) -> None:
        """Link an output to the input ``target``, or set the input to a constant."""
        if isinstance(value, Output):
            self.tree.links.new(value.socket, target)
        elif isinstance(value, tuple) and len(target.default_value) == 4:
            target.default_value = (*value, 1.0)
        else:
            target.default_value = value

    def out(self, node: bpy.types.Node, key: int | str = 0) -> Output:
        """The output of a node with this index or name."""
        return Output(self, node.outputs[key])

    # arithmetic ------------------------------------------------------------------------------------------
    def math(self, operation: str, a: Value, b: Value = 0.0, c: Value = 0.0) -> Output:
        node = self.node("ShaderNodeMath", operation=operation)
        for target, value in zip(node.inputs, (a, b, c), strict=True):
            self.feed(target, value)
        return self.out(node)

    def length(self, parts: Iterable[Value]) -> Output:
        """Compute the length of the vector with the two components ``parts``."""
        a, b = (part**2.0 for part in parts)
        return self.math("SQRT", a + b)

    def fit(self, value: Value, low: float, high: float, to_low: float = 0.0, to_high: float = 1.0) -> Output:
        """Map [low, high] to [to_low, to_high] by a smooth step, clamped."""
        return self._mapped("SMOOTHSTEP", value, low, high, to_low, to_high)

    def line(
        self, value: Value, low: float, high: float, to_low: float = 0.0, to_high: float = 1.0
    ) -> Output:
        """Map [low, high] to [to_low, to_high] linearly, clamped."""
        return self._mapped("LINEAR", value, low, high, to_low, to_high)

    def _mapped(self, interpolation: str, *values: Value) -> Output:
        node = self.node("ShaderNodeMapRange", interpolation_type=interpolation)
        for name, item in zip(("Value", "From Min", "From Max", "To Min", "To Max"), values, strict=True):
            self.feed(node.inputs[name], item)
        return self.out(node, "Result")

    def mix(self, factor: Value, a: ColorValue, b: ColorValue) -> Output:
        node = self.node("ShaderNodeMix", data_type="RGBA", clamp_factor=True)
        self.feed(node.inputs[0], factor)
        self.feed(node.inputs[6], a)
        self.feed(node.inputs[7], b)
        return self.out(node, 2)

    def shade(self, color: ColorValue, factor: Value) -> Output:
        """Multiply a colour by a factor."""
        node = self.node("ShaderNodeVectorMath", operation="SCALE")
        self.feed(node.inputs[0], color)
        self.feed(node.inputs["Scale"], factor)
        return self.out(node)

    def ramp(self, factor: Value, *stops: tuple[float, Color]) -> Output:
        node = self.node("ShaderNodeValToRGB")
        node.color_ramp.interpolation = "EASE" if len(stops) > 2 else "LINEAR"
        elements = node.color_ramp.elements
        while len(elements) < len(stops):
            elements.new(1.0)
        for element, (position, color) in zip(elements, stops, strict=True):
            element.position, element.color = position, (*color, 1.0)
        self.feed(node.inputs[0], factor)
        return self.out(node)

    def components(self, color: ColorValue) -> list[Output]:
        """The red, green and blue component of a colour."""
        node = self.node("ShaderNodeSeparateColor")
        self.feed(node.inputs[0], color)
        return [self.out(node, index) for index in range(3)]

    # patterns --------------------------------------------------------------------------------------------
    def uv(self) -> tuple[Output, Output]:
        """The output sockets for u and v of the tile."""
        if self._uv is None:
            split = self.node("ShaderNodeSeparateXYZ")
            self.tree.links.new(self.node("ShaderNodeTexCoord").outputs["UV"], split.inputs[0])
            self._uv = (self.out(split, 0), self.out(split, 1))
        return self._uv

    def torus(self, cells_u: float, cells_v: float, seed: Value = 0.0) -> tuple[Output, Output]:
        """4D noise coordinates, (vector, w), on the torus for the given numbers of cells along u and v."""
        u, v = self.uv()
        join = self.node("ShaderNodeCombineXYZ")
        ru, rv = cells_u / (2 * math.pi), cells_v / (2 * math.pi)
        au, av = u * (2 * math.pi), v * (2 * math.pi)
        self.feed(join.inputs[0], self.math("COSINE", au) * ru)
        self.feed(join.inputs[1], self.math("SINE", au) * ru)
        self.feed(join.inputs[2], self.math("MULTIPLY_ADD", self.math("COSINE", av), rv, seed))
        return self.out(join), self.math(
            "MULTIPLY_ADD", self.math("SINE", av), rv, self.math("MULTIPLY", seed, 1.7)
        )

    def noise(
        self, cells_u: float, cells_v: float | None = None, detail: float = 3.0, seed: Value = 0.0,
        roughness: float = 0.5, spread: float = 0.22,
    ) -> Output:  # fmt: skip
        """Periodic fractal noise, with [0.5 - spread, 0.5 + spread] mapped to [0, 1] and clamped."""
        vector, w = self.torus(cells_u, cells_u if cells_v is None else cells_v, seed)
        node = self.node("ShaderNodeTexNoise", noise_dimensions="4D")
        self.feed(node.inputs["Vector"], vector)
        self.feed(node.inputs["W"], w)
        node.inputs["Scale"].default_value = 1.0
        node.inputs["Detail"].default_value = detail
        node.inputs["Roughness"].default_value = roughness
        return self.line(self.out(node), 0.5 - spread, 0.5 + spread)

    def voronoi(
        self, cells_u: float, cells_v: float | None = None, feature: str = "F1", seed: Value = 0.0,
        warp: Value | None = None,
    ) -> dict[str, Output]:  # fmt: skip
        """Return the outputs of a periodic Voronoi texture by name (Distance, ...); ``warp`` distorts it."""
        vector, w = self.torus(cells_u, cells_u if cells_v is None else cells_v, seed)
        node = self.node("ShaderNodeTexVoronoi", voronoi_dimensions="4D", feature=feature)
        self.feed(node.inputs["Vector"], vector)
        self.feed(node.inputs["W"], w if warp is None else w + warp)
        node.inputs["Scale"].default_value = 1.0
        return {socket.name: Output(self, socket) for socket in node.outputs}

    def random(self, number: Value, seed: float = 0.0) -> Output:
        """A random value in [0, 1) that depends on ``number`` and ``seed``."""
        node = self.node("ShaderNodeTexWhiteNoise", noise_dimensions="2D")
        join = self.node("ShaderNodeCombineXYZ")
        self.feed(join.inputs[0], number)
        self.feed(join.inputs[1], seed + 0.5)
        self.tree.links.new(join.outputs[0], node.inputs["Vector"])
        return self.out(node, "Value")

    def cells(self, columns: int, rows: int, shift: str = "none", jitter_seed: float = 0.0) -> Cells:
        """A lattice of ``columns`` x ``rows`` cells. ``shift``: ``half`` moves odd rows by half a cell,
        ``random`` each row by a random amount seeded by ``jitter_seed``.
        """
        u, v = self.uv()
        y = v * rows
        # wrapped, so the pattern continues across the tile's border
        row = self.math("WRAP", self.math("FLOOR", y), rows, 0.0)
        x = u * columns
        if shift == "half":
            x = self.math("MULTIPLY_ADD", row % 2.0, 0.5, x)
        elif shift == "random":
            x = self.math("MULTIPLY_ADD", self.random(row, jitter_seed), float(columns), x)
        column = self.math("WRAP", self.math("FLOOR", x), columns, 0.0)
        fx, fy = self.math("FRACT", x), self.math("FRACT", y)
        number = self.math("MULTIPLY_ADD", row, float(columns), column)
        ex = self.math("MINIMUM", fx, 1.0 - fx) * (1.0 / columns)
        ey = self.math("MINIMUM", fy, 1.0 - fy) * (1.0 / rows)
        return Cells(number, fx, fy, self.math("MINIMUM", ex, ey))

    def wave(self, u_turns: int, v_turns: int, phase: Value = 0.0, amount: float = 0.0) -> Output:
        """0.5 + 0.5 sin(2π(u_turns u + v_turns v) + amount phase)."""
        u, v = self.uv()
        angle = u * (2 * math.pi * u_turns) + v * (2 * math.pi * v_turns)
        angle = self.math("MULTIPLY_ADD", phase, amount, angle)
        return self.math("MULTIPLY_ADD", self.math("SINE", angle), 0.5, 0.5)

    def periodic_distance(self, centre: tuple[float, float], stretch: float = 1.0) -> Output:
        """Distance to the nearest periodic copy of ``centre``; ``stretch`` scales distances along v."""

        def along(coordinate: Output, c: float, factor: float) -> Output:
            away = abs(self.math("WRAP", coordinate + (0.5 - c), 1.0, 0.0))
            return (away - 0.5) * factor

        return self.length(map(along, self.uv(), centre, (1.0, stretch)))

    def fingerprints(self, count: int = 7, size: float = 0.05, seed: int = 0) -> Output:
        """Mask of ``count`` fingerprints; ``size`` is their radius as a share of the tile's side."""
        rng = random.Random(seed)
        warp = self.noise(9, detail=1.0, seed=seed + 3.1)
        mask: Value = 0.0
        for _ in range(count):
            centre = (rng.random(), rng.random())
            distance = self.periodic_distance(centre, rng.uniform(0.65, 0.9))
            lines = self.math("MULTIPLY_ADD", distance, 2 * math.pi * 9 / size, warp * 9.0)
            lines = self.math("MULTIPLY_ADD", self.math("SINE", lines), 0.5, 0.5)
            print_mask = self.fit(distance, 0.35 * size, size, 1.0, 0.0) * self.line(
                lines, 0.2, 0.8, 0.25, 1.0
            )
            mask = self.math("MAXIMUM", mask, print_mask * rng.uniform(0.5, 1.0))
        return mask

    def scratches(self, seed: float = 0.0, density: float = 0.5) -> Output:
        """Mask in [0, 1] of fine curved scratches in two directions."""
        first = self.noise(3, 160, detail=1.0, seed=seed, spread=0.3)
        second = self.noise(140, 4, detail=1.0, seed=seed + 5, spread=0.3)
        where = self.noise(5, detail=2.0, seed=seed + 9)
        both = self.math("MAXIMUM", self.fit(first, 0.78, 0.9), self.fit(second, 0.82, 0.92))
        return both * self.fit(where, 1.0 - density, 1.0)

    # closures --------------------------------------------------------------------------------------------
    def finish(
        self, base: ColorValue, roughness: Value, metallic: Value = 0.0, ior: float = 1.5, level: Value = 0.5
    ) -> bpy.types.Material:
        """Link a Principled BSDF with these inputs to the output; return the material."""
        node = self.node("ShaderNodeBsdfPrincipled")
        for name, value in (
            ("Base Color", base), ("Roughness", roughness), ("Metallic", metallic), ("IOR", ior),
            ("Specular IOR Level", level),
        ):  # fmt: skip
            self.feed(node.inputs[name], value)
        self.tree.links.new(node.outputs[0], self.output.inputs["Surface"])
        return self.material
