# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts a graph of closures to weighted lobes, each with a diffuse reflectance, an F0 and a roughness.

Mix Shader weights its inputs, Add Shader sums them, and groups are traversed. A closure without a counterpart
in the project's BSDF is approximated, with the error stated, or refused; docs/blender.md lists the policies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import bpy

from ..problems import APPROXIMATION, ERROR, NOTE, ProblemList
from .expression import (
    BLACK,
    ONE,
    ZERO,
    Constant,
    Expression,
    add,
    clamp,
    complement,
    constant,
    divide,
    fresnel_f0,
    is_constant,
    lerp,
    multiply,
    operate,
    reduce_to_scalar,
    subtract,
    widen,
)
from .graph import Stack, input_of, source_of, value_of

TRANSMISSION_POLICIES = ("refuse", "opaque", "mask")
"""Values of ``sm_transmission``: report an error, absorb the transmitted light, or let it pass straight."""
_SMALL_TRANSMISSION = 0.1


@dataclass(frozen=True)
class _LeftOut:
    """A node input that is not exported: names by version of Blender, effect, and resulting error."""

    names: tuple[str, ...]
    effect: str
    error: str


_SUBSURFACE = _LeftOut(
    ("Subsurface Weight", "Subsurface"),
    "subsurface scattering",
    "light leaves the surface where it enters: the albedo is the same, but shadow edges are not softened",
)
_SHEEN = _LeftOut(
    ("Sheen Weight", "Sheen"), "sheen", "the surface is darker at grazing angles by up to this value"
)
_ANISOTROPY = _LeftOut(
    ("Anisotropic", "Anisotropy"),
    "anisotropy",
    "the highlight is round, with the same area: roughness^2 is the geometric mean of the slope widths",
)
_DIFFUSE_ROUGHNESS = _LeftOut(
    ("Diffuse Roughness", "Roughness"),
    "diffuse roughness (Oren-Nayar)",
    "the diffuse part is Lambertian, up to 20 % darker at grazing angles of view and light",
)


@dataclass(frozen=True)
class Lobe:
    """A weighted closure, such as a BSDF node.

    ``diffuse`` is the diffuse reflectance, (1 - S) D if ``albedo`` D is given; ``specular`` is F0;
    ``roughness`` is perceptual, None without a specular part.
    """

    weight: Expression
    diffuse: Expression
    specular: Expression
    roughness: Expression | None
    albedo: Expression | None = None


@dataclass
class Closures:
    """Sum of the closures of a surface graph.

    ``transparency`` is the weight of straight transmission; ``emission`` is the emitted radiance; ``normals``
    are the linked Normal inputs as pairs of group-node stack and socket.
    """

    lobes: list[Lobe] = field(default_factory=list)
    transparency: Expression = ZERO
    emission: Expression = BLACK
    normals: list[tuple[Stack, bpy.types.NodeSocket]] = field(default_factory=list)


class ClosureWalk:
    """Collects the closures of one material; ``policy`` is one of :data:`TRANSMISSION_POLICIES`."""

    def __init__(self, material: str, problems: ProblemList, policy: str = "refuse"):
        self.material, self.problems, self.policy = material, problems, policy
        self.result = Closures()

    def walk(self, tree: bpy.types.NodeTree) -> Closures:
        """Sum the closures that reach the surface output, and report those that are not exported exactly."""
        output = tree.get_output_node("CYCLES")
        if output is None:
            self._report(
                ERROR, None, "has no material output node", "add a Material Output and link a shader"
            )
            return self.result
        self._check_volume_and_displacement(output)
        self._closure((), output.inputs["Surface"], ONE)
        return self.result

    # ---- helpers

    def _report(self, severity: str, node: bpy.types.Node | None, message: str, remedy: str = "") -> None:
        name = (node.label or node.name) if node is not None else ""
        self.problems.add(severity, message, remedy, material=self.material, node=name)

    def _check_volume_and_displacement(self, output: bpy.types.Node) -> None:
        if source_of((), output.inputs["Volume"]).is_linked:
            remedy = "unlink Volume, or tag the object sm_role = ignore"
            self._report(ERROR, output, "volumes cannot be exported", remedy)
        if source_of((), output.inputs["Displacement"]).is_linked:
            message = "displacement by the material is left out: the surface is the mesh itself"
            self._report(APPROXIMATION, output, message, "use a Displace modifier, which is exported")

    def _value(self, stack: Stack, node: bpy.types.Node, *names: str) -> Expression:
        socket = input_of(node, *names)
        if socket is None:
            raise KeyError(f"{node.bl_idname} has no input {names}")
        return value_of(stack, socket)

    def _normal(self, stack: Stack, node: bpy.types.Node) -> None:
        for name in ("Normal", "Coat Normal"):
            socket = node.inputs.get(name)
            if socket is not None and source_of(stack, socket).is_linked:
                self.result.normals.append((stack, socket))

    def _lobe(
        self, weight: Expression, albedo: Expression, specular: Expression, roughness: Expression | None
    ) -> None:
        """Add a lobe with the diffuse ``albedo`` D, whose diffuse reflectance is (1 - S) D."""
        diffuse = multiply(albedo, complement(specular)) if not is_constant(specular, 0) else albedo
        self.result.lobes.append(Lobe(weight, diffuse, specular, roughness, albedo))

    def _closure(self, stack: Stack, socket: bpy.types.NodeSocket, weight: Expression) -> None:
        if is_constant(weight, 0):
            return
        source = source_of(stack, socket)
        if source.node is None:
            return  # Blender renders an empty shader input as black
        node = source.node
        handler = _HANDLERS.get(node.type)
        if handler is None:
            if source.socket is not None and source.socket.type != "SHADER":
                # Cycles treats a colour linked to a shader input as emission
                remedy = "put a shader node between them"
                self._report(ERROR, node, "a colour is linked to a shader input", remedy)
                return
            remedy = "replace it by Principled, Diffuse, Glossy or a mix of them"
            self._report(ERROR, node, f"the {node.bl_label} node cannot be exported", remedy)
            return
        handler(self, source.stack, node, weight)

    def _drop(self, stack: Stack, node: bpy.types.Node, *inputs: _LeftOut) -> None:
        """Report that the ``inputs`` with values other than 0 are not exported."""
        for left_out in inputs:
            value = self._value(stack, node, *left_out.names)
            if not is_constant(value, 0):
                amount = f" (= {value.value[0]:.3g})" if isinstance(value, Constant) else ""
                self._report(APPROXIMATION, node, f"{left_out.effect}{amount} is left out: {left_out.error}")

    # ---- closures

    def mix_shader(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        factor = clamp(value_of(stack, node.inputs[0]))
        self._closure(stack, node.inputs[1], multiply(weight, complement(factor)))
        self._closure(stack, node.inputs[2], multiply(weight, factor))

    def add_shader(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        self._closure(stack, node.inputs[0], weight)
        self._closure(stack, node.inputs[1], weight)

    def principled(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        get = lambda *names: self._value(stack, node, *names)  # noqa: E731
        base, metallic = clamp(get("Base Color")), clamp(get("Metallic"))
        roughness = clamp(get("Roughness"))
        transmission = multiply(clamp(get("Transmission Weight", "Transmission")), complement(metallic))
        alpha = clamp(get("Alpha"))
        f0 = multiply(fresnel_f0(get("IOR")), constant(2.0), get("Specular IOR Level", "Specular"))
        f0 = operate("minimum", multiply(f0, get("Specular Tint")), ONE)
        specular = widen(lerp(f0, base, metallic))
        passed = self._transmit(node, transmission)
        albedo = multiply(base, complement(metallic), complement(transmission))
        self._drop(stack, node, _SUBSURFACE, _SHEEN, _ANISOTROPY, _DIFFUSE_ROUGHNESS)
        film = input_of(node, "Thin Film Thickness")
        if film is not None and not is_constant(value_of(stack, film), 0):
            self._report(ERROR, node, "thin film interference cannot be exported", "set its thickness to 0")
        self._normal(stack, node)
        strength = get("Emission Strength")
        if not is_constant(strength, 0):
            self._emit(multiply(weight, alpha), multiply(get("Emission Color", "Emission"), strength))
        opaque = multiply(weight, alpha)
        self._pass_through(multiply(weight, complement(alpha)))
        self._pass_through(multiply(opaque, passed))
        opaque = multiply(opaque, complement(passed))
        coat = clamp(get("Coat Weight", "Clearcoat"))
        if is_constant(coat, 0):
            self._lobe(opaque, albedo, specular, roughness)
            return
        coat_f0 = multiply(coat, fresnel_f0(get("Coat IOR")))
        under = complement(coat_f0)
        tint = lerp(constant(1, 1, 1), get("Coat Tint"), coat)
        diffuse = multiply(albedo, complement(specular), tint, under)
        self.result.lobes.append(Lobe(opaque, diffuse, multiply(specular, tint, under, under), roughness))
        self.result.lobes.append(Lobe(opaque, BLACK, widen(coat_f0), clamp(get("Coat Roughness"))))
        self._report(
            APPROXIMATION,
            node,
            "the coat and the layer under it become one lobe whose slope width (roughness squared) is their "
            "mean weighted by F0: a sharp highlight on a rough base is blurred",
            "set Coat Weight to 0 and choose Roughness for the highlight that matters",
        )

    def _transmit(self, node: bpy.types.Node, transmission: Expression) -> Expression:
        """Report the treatment of ``transmission``; returns the part that becomes transparency."""
        if is_constant(transmission, 0):
            return ZERO
        amount = transmission.value[0] if isinstance(transmission, Constant) else 1.0
        if self.policy == "mask":
            message = "transmission becomes transparency: light passes straight, without refraction or blur"
            self._report(APPROXIMATION, node, message)
            return transmission
        if self.policy == "opaque" or amount <= _SMALL_TRANSMISSION:
            self._report(
                APPROXIMATION,
                node,
                f"transmission of up to {amount:.3g} is exported as an opaque surface: "
                "that share of the light is absorbed instead of transmitted",
            )
            return ZERO
        remedy = "set the material's sm_transmission to 'opaque' or 'mask', or remove the glass"
        self._report(ERROR, node, "transmission cannot be exported: the BSDF is opaque", remedy)
        return ZERO

    def _pass_through(self, weight: Expression) -> None:
        self.result.transparency = add(self.result.transparency, weight)

    def _emit(self, weight: Expression, radiance: Expression) -> None:
        self.result.emission = add(self.result.emission, multiply(weight, widen(radiance)))

    def diffuse(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        self._drop(stack, node, _DIFFUSE_ROUGHNESS)
        self._normal(stack, node)
        self._lobe(weight, clamp(self._value(stack, node, "Color")), BLACK, None)

    def glossy(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        self._drop(stack, node, _ANISOTROPY)
        self._normal(stack, node)
        colour = clamp(self._value(stack, node, "Color"))
        self._report(
            NOTE, node, "Glossy has no Fresnel effect; the exported surface brightens towards grazing angles"
        )
        self._lobe(weight, BLACK, widen(colour), clamp(self._value(stack, node, "Roughness")))

    def metallic(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        self._drop(stack, node, _ANISOTROPY)
        self._normal(stack, node)
        if node.fresnel_type == "PHYSICAL_CONDUCTOR":
            n, k = self._value(stack, node, "IOR"), self._value(stack, node, "Extinction")
            k2, below, above = multiply(k, k), subtract(n, ONE), add(n, ONE)
            f0 = divide(add(multiply(below, below), k2), add(multiply(above, above), k2))
            self._report(NOTE, node, "the conductor's Fresnel curve is replaced by Schlick's through its F0")
        else:
            f0 = self._value(stack, node, "Base Color")
            edge = self._value(stack, node, "Edge Tint")
            if not is_constant(edge, 1):
                self._report(
                    APPROXIMATION, node, "the edge tint is left out: only angles beyond 60 degrees differ"
                )
        self._lobe(weight, BLACK, widen(clamp(f0)), clamp(self._value(stack, node, "Roughness")))

    def glass(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        self._normal(stack, node)
        passed = self._transmit(node, ONE)
        self._pass_through(multiply(weight, passed))
        if is_constant(passed, 0):
            f0 = ZERO if node.type == "REFRACTION" else fresnel_f0(self._value(stack, node, "IOR"))
            self._lobe(weight, BLACK, widen(f0), clamp(self._value(stack, node, "Roughness")))

    def translucent(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        self._normal(stack, node)
        message = "translucency is exported as diffuse reflection: light leaves on the lit side only"
        self._report(APPROXIMATION, node, message, "use Diffuse where the surface is seen from its lit side")
        self._lobe(weight, clamp(self._value(stack, node, "Color")), BLACK, None)

    def subsurface(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        self._normal(stack, node)
        message = "subsurface scattering becomes diffuse reflection of the same albedo where light enters"
        self._report(APPROXIMATION, node, message)
        self._lobe(weight, clamp(self._value(stack, node, "Color")), BLACK, None)

    def transparent(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        colour = self._value(stack, node, "Color")
        scalar = reduce_to_scalar(colour)
        if isinstance(colour, Constant) and len(set(colour.value)) > 1:
            self._report(APPROXIMATION, node, "coloured transparency becomes grey of the same luminance")
        self._pass_through(multiply(weight, scalar))
        absorbed = complement(scalar)
        if not is_constant(absorbed, 0):
            self._lobe(multiply(weight, absorbed), BLACK, BLACK, None)

    def emission(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        colour, strength = self._value(stack, node, "Color"), self._value(stack, node, "Strength")
        self._emit(weight, multiply(colour, strength))

    def sheen(self, stack: Stack, node: bpy.types.Node, weight: Expression) -> None:
        remedy = "remove it, or use a Diffuse BSDF with the cloth's colour"
        self._report(ERROR, node, "the Sheen BSDF cannot be exported: D, S and R cannot represent it", remedy)


_HANDLERS: dict[str, Callable[[ClosureWalk, Stack, bpy.types.Node, Expression], None]] = {
    "MIX_SHADER": ClosureWalk.mix_shader,
    "ADD_SHADER": ClosureWalk.add_shader,
    "BSDF_PRINCIPLED": ClosureWalk.principled,
    "BSDF_DIFFUSE": ClosureWalk.diffuse,
    "BSDF_GLOSSY": ClosureWalk.glossy,
    "BSDF_METALLIC": ClosureWalk.metallic,
    "BSDF_GLASS": ClosureWalk.glass,
    "BSDF_REFRACTION": ClosureWalk.glass,
    "BSDF_TRANSLUCENT": ClosureWalk.translucent,
    "SUBSURFACE_SCATTERING": ClosureWalk.subsurface,
    "BSDF_TRANSPARENT": ClosureWalk.transparent,
    "EMISSION": ClosureWalk.emission,
    "BSDF_SHEEN": ClosureWalk.sheen,
}
