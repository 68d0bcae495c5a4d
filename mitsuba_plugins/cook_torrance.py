# SPDX-License-Identifier: MIT
"""The BSDF ``cook_torrance``, the project's only material model, as a Mitsuba plugin.

f(wi, wo) = (1 - S) D / pi  +  F(S, wi.h) D_b(h; alpha) G1(wi) G1(wo) / (4 cos_i cos_o)

D is ``diffuse_albedo``, S ``specular_albedo`` (the reflectance F0 at normal incidence), R ``roughness``
(perceptual; alpha = R^2), F Schlick's Fresnel term; D_b and G1 are defined in
:mod:`mitsuba_plugins.beckmann`. ``wi`` points to the viewer, ``wo`` is sampled; both are unit vectors in the
local frame (z is the shading normal). ``eval`` includes cos_o. Component 0 is diffuse, component 1 glossy.

The surface is two-sided unless ``two_sided`` is false: its back is the mirror image of its front.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsuba_plugins import beckmann
from mitsuba_plugins.texture_checks import check_parameter

Array = Any

COLOR_ATTRIBUTES = ("diffuse_albedo", "specular_albedo")
SCALAR_ATTRIBUTES = ("roughness",)
DEFAULTS = {"diffuse_albedo": 0.5, "specular_albedo": 0.04, "roughness": 0.5}
MIN_LOBE_PROBABILITY = 0.1
"""Minimum probability of sampling the specular lobe, which bounds the sample weight by 10 at grazing angles,
where Fresnel reflectance rises."""
INVERSE_PI = 1.0 / math.pi


class CookTorrance(mi.BSDF):
    """BSDF of a Lambertian lobe and a Cook-Torrance lobe with Beckmann distribution.

    Parameters: ``diffuse_albedo``, ``specular_albedo`` (RGB or texture, linear, [0, 1]), ``roughness``
    (number or texture, [0, 1]; RGB textures are converted to luminance), ``two_sided`` (default true).

    Raises :class:`InputError` if a parameter contains NaN, Inf or a value outside its range. Values set later
    through ``mi.traverse`` are clamped at evaluation instead.
    """

    def __init__(self, props: mi.Properties):
        mi.BSDF.__init__(self, props)
        self.diffuse_albedo: Any = props.get_texture("diffuse_albedo", DEFAULTS["diffuse_albedo"])
        self.specular_albedo: Any = props.get_texture("specular_albedo", DEFAULTS["specular_albedo"])
        self.roughness: Any = props.get_texture("roughness", DEFAULTS["roughness"])
        self.two_sided = bool(props.get("two_sided", True))
        for name in (*COLOR_ATTRIBUTES, *SCALAR_ATTRIBUTES):
            check_parameter(props.id() or "cook_torrance", name, getattr(self, name))
        sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide if self.two_sided else mi.BSDFFlags.FrontSide
        self.m_components = [mi.BSDFFlags.DiffuseReflection | sides, mi.BSDFFlags.GlossyReflection | sides]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the three textures; all are differentiable and none moves a discontinuity."""
        for name in (*COLOR_ATTRIBUTES, *SCALAR_ATTRIBUTES):
            callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

    # ---- the material's channels -------------------------------------------------------------------------

    def surface_parameters(self, si: mi.SurfaceInteraction3f, active: Array = True) -> tuple[Any, Any, Any]:
        """Return (D, S, R) as used in rendering: D and S (Color3f) and R (Float) are clamped to [0, 1]."""
        return (
            beckmann.effective_albedo(self.diffuse_albedo.eval(si, active)),
            beckmann.effective_albedo(self.specular_albedo.eval(si, active)),
            beckmann.effective_roughness(self.roughness.eval_1(si, active)),
        )

    def has_attribute(self, name: str, active: Array = True) -> Any:
        """Return whether ``name`` is ``diffuse_albedo``, ``specular_albedo`` or ``roughness``."""
        return name in COLOR_ATTRIBUTES or name in SCALAR_ATTRIBUTES

    def eval_attribute_1(self, name: str, si: mi.SurfaceInteraction3f, active: Array = True) -> Array:
        """Return attribute ``name`` as a Float: a scalar, or the luminance of a colour; 0 if unknown."""
        value = self._attribute(name, si, active)
        return mi.luminance(value) if name in COLOR_ATTRIBUTES else value

    def eval_attribute_3(self, name: str, si: mi.SurfaceInteraction3f, active: Array = True) -> Array:
        """Return attribute ``name`` as a Color3f, with scalars repeated in every channel; 0 if unknown."""
        return mi.Color3f(self._attribute(name, si, active))

    eval_attribute = eval_attribute_3

    def _attribute(self, name: str, si: mi.SurfaceInteraction3f, active: Array) -> Array:
        if name in COLOR_ATTRIBUTES:
            return beckmann.effective_albedo(getattr(self, name).eval(si, active))
        if name in SCALAR_ATTRIBUTES:
            return beckmann.effective_roughness(getattr(self, name).eval_1(si, active))
        # No error, as in Mitsuba's BSDFs: indirect calls also query BSDFs without the attribute.
        return mi.Float(0.0)

    def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: Array = True) -> Array:
        """Return (1 - S) D, the albedo of the diffuse term."""
        diffuse, specular, _ = self.surface_parameters(si, active)
        return (1.0 - specular) * diffuse

    # ---- evaluation and sampling -------------------------------------------------------------------------

    def eval(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: Array, active: Array = True
    ) -> Array:
        """Return the BSDF times the cosine, f(wi, wo) cos_o (Color3f)."""
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: Array, active: Array = True) -> Array:
        """Return the density [1/sr] with which :meth:`sample` samples ``wo``."""
        return self.eval_pdf(ctx, si, wo, active)[1]

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: Array, active: Array = True
    ) -> tuple[Any, Any]:
        """Return the results of :meth:`eval` and :meth:`pdf`, which share most of their computation."""
        return self._lobes(ctx, si, active).eval_pdf(wo)

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: Array,
        sample2: Array,
        active: Array = True,
    ) -> tuple[Any, Any]:
        """Sample ``wo`` by ``sample2`` in [0, 1)^2 from one lobe, chosen by ``sample1`` in [0, 1).

        Returns a BSDFSample3f and the weight f cos_o / pdf, below 10 in each channel (docs/bsdf.md).
        """
        return self._lobes(ctx, si, active).sample(sample1, sample2)

    def eval_pdf_sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: Array,
        sample1: Array,
        sample2: Array,
        active: Array = True,
    ) -> tuple[Any, Any, Any, Any]:
        """Return the results of :meth:`eval_pdf` and :meth:`sample`, evaluating the textures only once."""
        lobes = self._lobes(ctx, si, active)
        return (*lobes.eval_pdf(wo), *lobes.sample(sample1, sample2))

    def _lobes(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, active: Array) -> Lobes:
        return Lobes(
            si.wi,
            *self.surface_parameters(si, active),
            active,
            is_two_sided=self.two_sided,
            has_diffuse=ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0),
            has_specular=ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1),
        )

    def to_string(self) -> str:
        return (
            f"CookTorrance[\n  diffuse_albedo = {self.diffuse_albedo},\n"
            f"  specular_albedo = {self.specular_albedo},\n  roughness = {self.roughness},\n"
            f"  two_sided = {self.two_sided}\n]"
        )


class Lobes:
    """The diffuse and specular lobes of the BSDF for given D, S, R and a direction ``wi`` to the viewer.

    Directions are in a local frame whose z axis is the normal. Terms independent of ``wo`` are computed once.
    """

    def __init__(
        self,
        wi: Array,
        diffuse_albedo: Array,
        specular_albedo: Array,
        roughness: Array,
        active: Array,
        *,
        is_two_sided: bool = True,
        has_diffuse: bool = True,
        has_specular: bool = True,
    ):
        self.has_diffuse, self.has_specular = has_diffuse, has_specular
        self.specular = specular_albedo
        self.alpha = beckmann.alpha_from_roughness(roughness)
        self.diffuse = (1.0 - specular_albedo) * diffuse_albedo
        if is_two_sided:
            self.side = dr.mulsign(mi.Float(1.0), wi.z)  # -1 on the back, where wi and wo are mirrored
            self.wi = mi.Vector3f(wi.x, wi.y, dr.abs(wi.z))
        else:
            self.side = mi.Float(1.0)
            self.wi = mi.Vector3f(wi)
        self.active = mi.Bool(active) & (self.wi.z > 0.0)
        self.specular_probability = self._specular_probability()
        self.masking = beckmann.smith_g1_over_cos(self.wi, self.alpha)

    def _specular_probability(self) -> Array:
        """Return the probability of sampling the specular lobe: its share of the energy, at least a tenth."""
        if not self.has_diffuse:
            return mi.Float(1.0)
        if not self.has_specular:
            return mi.Float(0.0)
        # The sampling density must not add derivatives to eval or to the weights of detached sampling.
        specular, diffuse = dr.detach(self.specular), dr.detach(self.diffuse)
        grazing = _fifth_power(1.0 - dr.maximum(dr.detach(self.wi.z), 0.0))
        specular_energy = dr.sum(specular + (1.0 - specular) * grazing)  # sum over channels, as below
        diffuse_energy = dr.sum(diffuse)
        total = specular_energy + diffuse_energy
        share = specular_energy / dr.select(total > 0.0, total, 1.0)
        # CUDA's division is approximate: a share above 1 would make densities negative, and a share below 1
        # would sample the diffuse lobe of a surface that has none.
        share = dr.select((diffuse_energy == 0.0) & (total > 0.0), 1.0, dr.minimum(share, 1.0))
        return dr.maximum(share, MIN_LOBE_PROBABILITY)

    def eval_pdf(self, wo: Array) -> tuple[Any, Any]:
        """Return the value f cos_o (Color3f) and the density [1/sr] at ``wo``."""
        wo = mi.Vector3f(wo.x, wo.y, wo.z * self.side)
        active = self.active & (wo.z > 0.0)
        value, pdf = mi.Color3f(0.0), mi.Float(0.0)
        if self.has_specular:
            half = self.wi + wo
            # Without cancellation: wi.h = |wi + wo| / 2 for unit vectors, and 1 - wi.h = sin^2 / (1 + wi.h)
            # with sin = |wi - wo| / 2, the sine of the angle between wi and h.
            cos_half = 0.5 * dr.sqrt(dr.maximum(dr.squared_norm(half), 1e-30))
            one_minus_cos = 0.25 * dr.squared_norm(self.wi - wo) / (1.0 + cos_half)
            fresnel = self.specular + (1.0 - self.specular) * _fifth_power(dr.minimum(one_minus_cos, 1.0))
            # D_b G1(wi) / (4 cos_i) is the density of wo for visible normals h, and a factor of the lobe.
            visible = 0.25 * beckmann.beckmann_d(half, self.alpha) * self.masking
            value += fresnel * (visible * beckmann.smith_g1(wo, self.alpha))
            pdf += self.specular_probability * visible
        if self.has_diffuse:
            value += self.diffuse * (INVERSE_PI * wo.z)
            pdf += (1.0 - self.specular_probability) * (INVERSE_PI * wo.z)
        return dr.select(active, value, 0.0), dr.select(active, pdf, 0.0)

    def sample(self, sample1: Array, sample2: Array) -> tuple[Any, Any]:
        """Sample a direction as :meth:`CookTorrance.sample` does; return a BSDFSample3f and its weight."""
        use_specular = sample1 < self.specular_probability
        normal = beckmann.sample_visible_normal(self.wi, self.alpha, sample2)
        reflected = 2.0 * dr.dot(self.wi, normal) * normal - self.wi
        cosine = mi.warp.square_to_cosine_hemisphere(sample2)
        wo = dr.detach(dr.normalize(dr.select(use_specular, reflected, cosine)))
        wo = mi.Vector3f(wo.x, wo.y, wo.z * self.side)
        value, pdf = self.eval_pdf(wo)
        is_valid = self.active & (pdf > 0.0) & dr.isfinite(pdf)
        bs: Any = dr.zeros(mi.BSDFSample3f, dr.width(wo))
        bs.wo = wo
        bs.eta = mi.Float(1.0)
        bs.pdf = dr.select(is_valid, pdf, 0.0)
        bs.sampled_type = dr.select(
            use_specular,
            mi.UInt32(+mi.BSDFFlags.GlossyReflection),
            mi.UInt32(+mi.BSDFFlags.DiffuseReflection),
        )
        bs.sampled_component = dr.select(use_specular, mi.UInt32(1), mi.UInt32(0))
        weight = value / dr.select(is_valid, dr.detach(pdf), 1.0)
        return bs, dr.select(is_valid, weight, 0.0)


def _fifth_power(x: Array) -> Array:
    square = dr.square(x)
    return dr.square(square) * x
