# SPDX-License-Identifier: GPL-3.0-or-later
"""Combines weighted lobes into expressions of the channels D, S, R and opacity.

With lobe weights w, diffuse reflectances r, F0s s and slope widths a = roughness^2:

    S = sum w s        D = sum w r / (1 - S)        R = sqrt(sum w m a / sum w m),  m = mean component of s

D is divided by 1 - S because the diffuse term of the project's BSDF is (1 - S) D / pi: a mix thus preserves
diffusely reflected light rather than D (docs/decisions/0030). A single lobe keeps its D.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from .closures import Closures, Lobe
from .expression import (
    BLACK,
    ONE,
    Expression,
    add,
    clamp,
    complement,
    constant,
    divide,
    is_constant,
    multiply,
    operate,
    reduce_to_scalar,
    unclamped,
    widen,
)

_MIN_DIFFUSE_SHARE: Expression = constant(1e-3)  # D of an entirely specular mix would be 0 / 0
_NO_SPECULAR: Expression = constant(1e-6)  # lobes without F0 get a mean slope width of 1, not 0 / 0


@dataclass(frozen=True)
class Channels:
    """Expressions of a material's channels; None for an ``opacity`` of 1 and for an ``emission`` of 0."""

    diffuse_albedo: Expression
    specular_albedo: Expression
    roughness: Expression
    opacity: Expression | None
    emission: Expression | None

    def baked(self) -> dict[str, Expression]:
        """Expressions, by name in a fixed order, of the channels that are not None."""
        return {name: expression for name, expression in vars(self).items() if expression is not None}


def channels_of(closures: Closures) -> Channels:
    """Combine weighted lobes into the channels of one BSDF; without lobes, it is black with R = 1."""
    opacity: Expression = clamp(complement(closures.transparency))
    lobes = _normalized(closures.lobes, opacity)
    diffuse: Expression = BLACK
    specular: Expression = BLACK
    roughness: Expression = ONE
    if len(lobes) == 1 and is_constant(lobes[0].weight, 1) and lobes[0].albedo is not None:
        diffuse, specular = lobes[0].albedo, lobes[0].specular
        roughness = lobes[0].roughness if lobes[0].roughness is not None else ONE
    elif lobes:
        diffuse, specular, roughness = _mixed(lobes)
    emission = None if is_constant(closures.emission, 0) else widen(closures.emission)
    mask = None if is_constant(opacity, 1) else opacity
    return Channels(widen(diffuse), widen(specular), roughness, mask, emission)


def _normalized(lobes: list[Lobe], opacity: Expression) -> list[Lobe]:
    """Divide the lobes' weights by the opacity, which would otherwise darken the opaque part."""
    if is_constant(opacity, 1):
        return lobes
    bare = unclamped(opacity)
    weights = (ONE if unclamped(lobe.weight) == bare else divide(lobe.weight, opacity) for lobe in lobes)
    return [replace(lobe, weight=weight) for lobe, weight in zip(lobes, weights, strict=True)]


def _mixed(lobes: list[Lobe]) -> tuple[Expression, Expression, Expression]:
    specular = clamp(add(*(multiply(lobe.weight, lobe.specular) for lobe in lobes)))
    reflected = add(*(multiply(lobe.weight, lobe.diffuse) for lobe in lobes))
    diffuse_share = operate("maximum", complement(specular), _MIN_DIFFUSE_SHARE)
    diffuse = clamp(divide(reflected, diffuse_share))
    glossy = [lobe for lobe in lobes if lobe.roughness is not None and not is_constant(lobe.specular, 0)]
    values = {lobe.roughness for lobe in glossy}
    if not values:
        return diffuse, specular, ONE
    if len(values) == 1:
        (only,) = values
        assert only is not None
        return diffuse, specular, only
    total: Expression = _NO_SPECULAR
    width: Expression = _NO_SPECULAR
    for lobe in glossy:
        assert lobe.roughness is not None
        share = multiply(lobe.weight, reduce_to_scalar(lobe.specular, "average"))
        total = add(total, share)
        width = add(width, multiply(share, lobe.roughness, lobe.roughness))
    return diffuse, specular, operate("sqrt", divide(width, total))
