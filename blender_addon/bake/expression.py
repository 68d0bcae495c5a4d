# SPDX-License-Identifier: GPL-3.0-or-later
"""Values of a shader graph as expressions: constants, sockets of the graph, and arithmetic on them.

Each channel of the project's BSDF is an expression. Constants are folded during construction, which reveals
expressions that are constant or a single socket; all other expressions are built from math nodes and baked.
``width``: 1 for a scalar, 3 for a linear Rec.709 colour or a vector. A scalar combined with a colour is
repeated to three components.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce

LUMINANCE = (0.2126729, 0.7151522, 0.0721750)
"""Weights of the linear Rec.709 components in Blender's conversion of a colour to a value."""


@dataclass(frozen=True)
class Constant:
    """A constant with 1 or 3 components."""

    value: tuple[float, ...]

    @property
    def width(self) -> int:
        return len(self.value)


@dataclass(frozen=True)
class SocketValue:
    """Value of the output ``socket`` of ``node``; ``path`` names the nested group nodes around it."""

    path: tuple[str, ...]
    node: str
    socket: str
    width: int


@dataclass(frozen=True)
class Operation:
    """An operation of :data:`OPERATIONS` by component, or the ``luminance`` or ``average`` of a vector."""

    name: str
    arguments: tuple[Expression, ...]
    width: int


Expression = Constant | SocketValue | Operation

OPERATIONS: dict[str, Callable[..., float]] = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / b if b else 0.0,  # Blender's math nodes return 0 for a division by 0
    "minimum": min,
    "maximum": max,
    "sqrt": lambda a: math.sqrt(max(a, 0.0)),
}


def constant(*value: float) -> Constant:
    """Create a constant of one or three components."""
    return Constant(tuple(float(v) for v in value))


ZERO, ONE, BLACK = constant(0), constant(1), constant(0, 0, 0)


def is_constant(expression: Expression, value: float | None = None) -> bool:
    """True if the expression is constant and, if ``value`` is given, equals it in every component."""
    return isinstance(expression, Constant) and (
        value is None or all(component == value for component in expression.value)
    )


def _is_complement(expression: Expression) -> bool:
    return (
        isinstance(expression, Operation)
        and expression.name == "subtract"
        and is_constant(expression.arguments[0], 1)
    )


def operate(name: str, *arguments: Expression) -> Expression:
    """Apply an operation of :data:`OPERATIONS`, folding constants and dropping neutral elements."""
    width = max(argument.width for argument in arguments)
    if all(isinstance(argument, Constant) for argument in arguments):
        values = [a.value * (width // a.width) for a in arguments]  # type: ignore[union-attr]
        return Constant(tuple(float(OPERATIONS[name](*row)) for row in zip(*values, strict=True)))
    if len(arguments) == 2:
        a, b = arguments
        if name == "multiply" and (is_constant(a, 0) or is_constant(b, 0)):
            return ZERO if width == 1 else BLACK
        if name == "add" and is_constant(a, 0) and b.width == width:
            return b
        if name in ("add", "subtract") and is_constant(b, 0) and a.width == width:
            return a
        if name == "multiply" and is_constant(a, 1) and b.width == width:
            return b
        if name in ("multiply", "divide") and is_constant(b, 1) and a.width == width:
            return a
        if name == "divide" and is_constant(a, 0):
            return ZERO if width == 1 else BLACK
        if name in ("minimum", "maximum") and a == b:
            return a
        if name == "divide" and a == b and a.width == width:
            return ONE  # if both are 0 the lobe is invisible, so its value does not matter
        if name == "subtract" and is_constant(a, 1) and _is_complement(b) and b.width == width:
            return b.arguments[1]  # type: ignore[union-attr]
    return Operation(name, arguments, width)


def add(*terms: Expression) -> Expression:
    """Sum of any number of terms."""
    return reduce(lambda a, b: operate("add", a, b), terms) if terms else ZERO


def multiply(*factors: Expression) -> Expression:
    """Product of any number of factors."""
    return reduce(lambda a, b: operate("multiply", a, b), factors) if factors else ONE


def subtract(a: Expression, b: Expression) -> Expression:
    """The expression a - b."""
    return operate("subtract", a, b)


def divide(a: Expression, b: Expression) -> Expression:
    """The expression a / b, 0 where b is 0."""
    return operate("divide", a, b)


def clamp(expression: Expression) -> Expression:
    """Clamp an expression to [0, 1]."""
    return operate("minimum", operate("maximum", expression, ZERO), ONE)


def unclamped(expression: Expression) -> Expression:
    """Remove the outermost minimum and maximum operations with constants from an expression."""
    while (
        isinstance(expression, Operation)
        and expression.name in ("minimum", "maximum")
        and isinstance(expression.arguments[1], Constant)
    ):
        expression = expression.arguments[0]
    return expression


def complement(expression: Expression) -> Expression:
    """The expression 1 - ``expression``."""
    return subtract(ONE, expression)


def lerp(a: Expression, b: Expression, factor: Expression) -> Expression:
    """The expression a (1 - factor) + b factor."""
    if a == b:
        return a
    return add(multiply(a, complement(factor)), multiply(b, factor))


def reduce_to_scalar(expression: Expression, name: str = "luminance") -> Expression:
    """Reduce to a scalar as Blender does; ``name``: ``luminance`` for colours or ``average`` for vectors."""
    if expression.width == 1:
        return expression
    if isinstance(expression, Constant):
        if len(set(expression.value)) == 1:
            return constant(expression.value[0])  # the weights' sum is not exactly 1
        weights = LUMINANCE if name == "luminance" else (1 / 3,) * 3
        return constant(sum(w * v for w, v in zip(weights, expression.value, strict=True)))
    return Operation(name, (expression,), 1)


def widen(expression: Expression) -> Expression:
    """Repeat a scalar constant to three components; other expressions are unchanged."""
    if isinstance(expression, Constant) and expression.width == 1:
        return Constant(expression.value * 3)
    return expression


def fresnel_f0(ior: Expression) -> Expression:
    """Reflectance at normal incidence of a dielectric, ((ior - 1) / (ior + 1))^2."""
    ratio = divide(subtract(ior, ONE), add(ior, ONE))
    return multiply(ratio, ratio)


def sockets(expression: Expression) -> set[SocketValue]:
    """All sockets of the shader graph on which an expression depends."""
    if isinstance(expression, SocketValue):
        return {expression}
    if isinstance(expression, Operation):
        return set().union(*(sockets(argument) for argument in expression.arguments))
    return set()
