# SPDX-License-Identifier: MIT
"""Shading of surfels in a radiance field: irradiance, and the specular terms of each observation.

With the project's BRDF and Schlick's Fresnel term, the radiance of a point towards a camera is

    L = (1 - S) D Ld + S Ls0(R) + Ls1(R),       Ld = E / pi,
    Ls0 = mean of L_in G1(wo) (1 - f),  Ls1 = mean of L_in G1(wo) f,  f = (1 - wi.h)^5,

over half vectors h drawn from the distribution of visible normals at roughness R (Heitz & d'Eon 2014), with
wo the mirror image of wi about h. Emitters and bright surfaces are also sampled directly, and the techniques
are combined by the balance heuristic (Veach 1997). Each point uses a rank-1 lattice whose shift depends on
the point's index, so its result does not depend on other points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datagen.light.bright_guide import BrightGuide, bright_rectangles
from datagen.light.emitters import EmitterSampler
from datagen.light.radiance_field import (
    MIN_COSINE,
    End,
    RadianceField,
    RayResult,
    lobe_pdf,
    schlick_weight,
)
from mitsuba_plugins.arrays import aligned, rows_from_vectors, vectors_from_rows
from mitsuba_plugins.beckmann import alpha_from_roughness, sample_visible_normal, smith_g1

MIN_KNOWN = 0.1
"""Lower bound on the known share of light; known light is divided by it to extrapolate to all light."""
GOLDEN = 0.6180339887498949
# Fractional parts of square roots. All lattice steps of one path are rationally independent; otherwise, the
# error would not vanish with more rays.
_GUIDE_STEPS = (0.4142135623730951, 0.6457513110645906, 0.3166247903553998)
_METAL_STEPS = (0.4494897427831781, 0.7416573867739413, 0.3851648071345042)
_START = 2e-4  # offset of a ray's origin from the surface, relative to the room's diagonal
_SHADOW = 1e-3  # shortening of shadow rays, relative to the distance to the emitter


@dataclass(frozen=True)
class Irradiance:
    """Diffuse shading of N points.

    ``diffuse`` (N, 3): Ld = E / pi of all known light. Cosine-weighted shares of the hemisphere, in [0, 1]:
    ``known`` (N,), with photographed or estimated radiance, and ``photographed`` (N,).
    """

    diffuse: NDArray[np.float32]
    known: NDArray[np.float32]
    photographed: NDArray[np.float32]

    def extrapolated(self) -> NDArray[np.float32]:
        """Return Ld (N, 3) of all light on the assumption that unknown light is as bright as known light."""
        return self.diffuse / np.maximum(self.known, MIN_KNOWN)[:, None]


@dataclass(frozen=True)
class SpecularShading:
    """Specular shading of K observations: ``ls0`` and ``ls1`` (K, 3), defined in the module's docstring.

    ``known`` and ``photographed`` (K,) are shares as in :class:`Irradiance`, but of the specular lobe.
    """

    ls0: NDArray[np.float32]
    ls1: NDArray[np.float32]
    known: NDArray[np.float32]
    photographed: NDArray[np.float32]

    def extrapolated(self) -> SpecularShading:
        """Return the shading on the assumption that unknown light is as bright as known light."""
        known = np.maximum(self.known, MIN_KNOWN)[:, None]
        return replace(self, ls0=self.ls0 / known, ls1=self.ls1 / known)


class MetalSample(NamedTuple):
    """Random numbers of a reflection at metal: ``half`` in [0, 1)^2 selects the half vector; ``guide`` and
    ``emitter`` are the arguments (number, point) of the sampling methods.
    """

    half: Any
    guide: tuple[Any, Any]
    emitter: tuple[Any, Any]


class Baker:
    """Computes shading at points in a radiance field; ``size_m`` is the diagonal of the room."""

    def __init__(self, field: RadianceField, size_m: float):
        import drjit as dr
        import mitsuba as mi

        self.field = field
        self.size_m = size_m
        self.start_m = _START * size_m
        self._offset = dr.opaque(mi.Float, self.start_m)  # a literal would cause a separate kernel
        self._sampler = EmitterSampler(field.emitters)
        rectangles = bright_rectangles(field.cells)
        self.guide = BrightGuide(rectangles) if rectangles else None

    def cosine_rays(self, position_m: NDArray, normal: NDArray, num_rays: int, seed: int) -> Any:
        """Cosine-distributed rays (``mi.Ray3f``), ``num_rays`` from each of N points in turn."""
        import drjit as dr
        import mitsuba as mi

        n = vectors_from_rows(np.repeat(normal, num_rays, axis=0))
        origin = mi.Point3f(vectors_from_rows(np.repeat(position_m, num_rays, axis=0)))
        sample = np.random.default_rng(seed).random((2, dr.width(n))).astype(np.float32)
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(*(mi.Float(aligned(u)) for u in sample)))
        return mi.Ray3f(origin + n * self._offset, mi.Frame3f(n).to_world(local))

    def irradiance(self, position_m: NDArray, normal: NDArray, num_rays: int, seed: int = 0) -> Irradiance:
        """Irradiance at points (N, 3) with unit normals (N, 3), from ``num_rays`` rays each."""
        import drjit as dr
        import mitsuba as mi

        if not len(position_m):
            empty = np.zeros(0, np.float32)
            return Irradiance(np.zeros((0, 3), np.float32), empty, empty)
        n = vectors_from_rows(normal)
        p = mi.Point3f(vectors_from_rows(position_m)) + n * self._offset
        lane = dr.arange(mi.UInt32, len(position_m))
        total, known, photographed = _irradiance_loop(
            self, p, mi.Frame3f(n), lane, dr.opaque(mi.UInt32, num_rays), dr.opaque(mi.UInt32, seed)
        )
        scale = dr.opaque(mi.Float, 1.0 / num_rays)
        total, known, photographed = total * scale, known * scale, photographed * scale
        dr.eval(total, known, photographed)
        return Irradiance(rows_from_vectors(total), np.array(known.numpy()), np.array(photographed.numpy()))

    def specular(
        self,
        position_m: NDArray,
        normal: NDArray,
        view: NDArray,
        roughness: NDArray,
        num_rays: int,
        seed: int = 0,
    ) -> SpecularShading:
        """Specular shading of K observations, from ``num_rays`` rays each, for points (K, 3), normals (K, 3),
        unit directions to the cameras ``view`` (K, 3) and ``roughness`` (K,)."""
        import drjit as dr
        import mitsuba as mi

        if not len(position_m):
            empty, rows = np.zeros(0, np.float32), np.zeros((0, 3), np.float32)
            return SpecularShading(rows, rows, empty, empty)
        n = vectors_from_rows(normal)
        frame = mi.Frame3f(n)
        p = mi.Point3f(vectors_from_rows(position_m)) + n * self._offset
        wi = frame.to_local(vectors_from_rows(view))
        wi.z = dr.maximum(wi.z, MIN_COSINE)
        wi = dr.normalize(wi)
        alpha = alpha_from_roughness(mi.Float(aligned(roughness, np.float32)))
        lane = dr.arange(mi.UInt32, len(position_m))
        ls0, ls1, known, photographed = _specular_loop(
            self, p, frame, wi, alpha, lane, dr.opaque(mi.UInt32, num_rays), dr.opaque(mi.UInt32, seed)
        )
        scale = dr.opaque(mi.Float, 1.0 / num_rays)
        ls0, ls1, known, photographed = ls0 * scale, ls1 * scale, known * scale, photographed * scale
        dr.eval(ls0, ls1, known, photographed)
        shares = np.array(known.numpy()), np.array(photographed.numpy())
        return SpecularShading(rows_from_vectors(ls0), rows_from_vectors(ls1), *shares)

    def trace(self, ray: Any, active: Any, sample: MetalSample | None) -> RayResult:
        """Trace ``ray`` into the field, and reflect it once at metals.

        Reflections also sample bright surfaces and emitters, combined by the balance heuristic. Where the
        reflected ray's radiance is unknown, the metal keeps its surfel's radiance. ``sample`` may be None in
        a field without metals.
        """
        import drjit as dr

        end = self.field.trace(ray, active)
        if self.field.metals is None:
            return end.result
        assert sample is not None
        is_metal, s, alpha = self.field.metal_at(end)
        # a branch, since few rays hit metal
        radiance, is_photographed = dr.if_stmt(
            (),
            is_metal,
            lambda: self._reflected(ray, end, is_metal, s, alpha, sample),
            lambda: (end.result.radiance, end.result.is_photographed),
            label="reflect_at_metal",
        )
        return end.result._replace(radiance=radiance, is_photographed=is_photographed)

    def _reflected(
        self, ray: Any, end: End, is_metal: Any, s: Any, alpha: Any, sample: MetalSample
    ) -> tuple[Any, Any]:
        """Radiance of ``ray``, reflected at the metal of its ``end``, and whether it is photographed."""
        import drjit as dr
        import mitsuba as mi

        frame = mi.Frame3f(end.normal)
        wi = frame.to_local(-ray.d)
        wi.z = dr.maximum(wi.z, MIN_COSINE)
        wi = dr.normalize(wi)
        origin = end.position + end.normal * self._offset

        def mirrored(wo: Any, half: Any, radiance: Any, pdf: Any, others: Any) -> Any:
            """Light from ``wo`` that the lobe reflects, with MIS weight ``pdf`` / (``pdf`` + ``others``)."""
            albedo = s + (1.0 - s) * schlick_weight(dr.dot(wi, half))
            return radiance * albedo * smith_g1(wo, alpha) * (pdf / dr.maximum(pdf + others, 1e-20))

        half = sample_visible_normal(wi, alpha, sample.half)
        wo = mi.reflect(wi, half)
        is_reflected = is_metal & (wo.z > 0)
        reflected_ray = mi.Ray3f(origin, frame.to_world(wo))
        beyond = self.field.trace(reflected_ray, is_reflected).result
        others = self.guide_pdf(origin, reflected_ray.d) + self.emitter_pdf(beyond, reflected_ray)
        reflected = mirrored(wo, half, beyond.radiance, lobe_pdf(wi, wo, half, alpha), others)
        direct = mi.Color3f(0.0)
        if self.guide is not None:
            toward, guide_pdf = self.guide.sample(origin, *sample.guide)
            wo = frame.to_local(toward)
            half = dr.normalize(wi + wo)
            pdf = lobe_pdf(wi, wo, half, alpha)
            is_valid = is_metal & (pdf > 0) & (guide_pdf > 0)
            guided = mi.Ray3f(origin, toward)
            result = self.field.trace(guided, is_valid).result
            light = mirrored(wo, half, result.radiance, pdf, guide_pdf + self.emitter_pdf(result, guided))
            direct += dr.select(is_valid, light, 0.0)
        if self.samples_emitters:
            wo, radiance, light_pdf, is_valid = self.emitter_sample(origin, frame, *sample.emitter)
            half = dr.normalize(wi + wo)
            pdf = lobe_pdf(wi, wo, half, alpha)
            others = light_pdf + self.guide_pdf(origin, frame.to_world(wo))
            is_valid &= is_metal & (pdf > 0)
            direct += dr.select(is_valid, mirrored(wo, half, radiance, pdf, others), 0.0)
        is_known = is_reflected & beyond.is_known
        radiance = dr.select(
            is_known, reflected, dr.select(is_metal & ~is_reflected, 0.0, end.result.radiance)
        )
        radiance += dr.select(is_known | (is_metal & ~is_reflected), direct, 0.0)
        is_photographed = end.result.is_photographed & (~is_reflected | beyond.is_photographed)
        return radiance, is_photographed

    def emitter_sample(self, p: Any, frame: Any, sample_1: Any, sample_2: Any) -> tuple[Any, Any, Any, Any]:
        """Sample a point of an emitter; return its direction in ``frame``, radiance (0 if occluded), density
        [1/sr], and whether it is visible from ``p``.
        """
        import drjit as dr
        import mitsuba as mi

        point, normal, radiance, area_pdf = self._sampler.sample(sample_1, sample_2)
        toward = point - p
        distance2 = dr.maximum(dr.squared_norm(toward), 1e-12)
        distance = dr.sqrt(distance2)
        d = toward / distance
        facing = -dr.dot(normal, d)
        wo = frame.to_local(d)
        is_valid = (facing > 1e-4) & (wo.z > 0)
        ray = mi.Ray3f(p, d)
        ray.maxt = distance * (1 - _SHADOW)
        is_valid &= ~self.field.scene.ray_test(ray, is_valid)
        pdf = area_pdf * distance2 / dr.maximum(facing, 1e-4)
        return wo, dr.select(is_valid, radiance, 0.0), pdf, is_valid

    def emitter_pdf(self, result: RayResult, ray: Any) -> Any:
        """Density [1/sr] with which :meth:`emitter_sample` samples ``ray``, whose tracing gave ``result``."""
        import drjit as dr
        import mitsuba as mi

        if not self.samples_emitters:
            return mi.Float(0.0)
        is_emitter = result.is_front_of_emitter
        area = dr.gather(mi.Float, self._sampler.area_pdf_of_face, result.face, is_emitter)
        facing = dr.maximum(result.cosine, 1e-4)
        return dr.select(is_emitter, area * dr.square(result.distance_m) / facing, 0.0)

    def lobe_weight(self, pdf: Any, result: RayResult, ray: Any) -> Any:
        """MIS weight (balance heuristic) of a ray sampled from a lobe with density ``pdf`` [1/sr]."""
        import drjit as dr
        import mitsuba as mi

        if self.guide is None and not self.samples_emitters:
            return mi.Float(1.0)
        others = self.emitter_pdf(result, ray) + self.guide_pdf(ray.o, ray.d)
        return pdf / dr.maximum(pdf + others, 1e-20)

    def guide_pdf(self, p: Any, direction: Any) -> Any:
        """Density [1/sr] with which the guide samples ``direction`` from ``p``; 0 without a guide."""
        import mitsuba as mi

        return mi.Float(0.0) if self.guide is None else self.guide.pdf(p, direction)

    @property
    def samples_emitters(self) -> bool:
        """True if there are emitters to sample."""
        return not self._sampler.is_empty


def _lattice(lane: Any, index: Any, count: Any, seed: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Return the five coordinates, in [0, 1), of sample ``index`` of ``count`` in the lattice of a point."""
    import mitsuba as mi

    a, b = mi.sample_tea_32(lane, seed)
    c, d = mi.sample_tea_32(lane, seed + 7919)
    e, _ = mi.sample_tea_32(lane, seed + 104729)
    i = mi.Float(index)
    return (
        _shifted(i / mi.Float(count), a),
        _shifted(i * GOLDEN, b),
        _shifted(i * 0.7548776662466927, c),
        _shifted(i * 0.5698402909980532, d),
        _shifted(i * 0.8191725133961645, e),
    )


def _shifted(step: Any, shift: Any) -> Any:
    """Return ``step`` + ``shift`` / 2^32, modulo 1."""
    import drjit as dr
    import mitsuba as mi

    value = step + mi.Float(shift) * (1.0 / 4294967296.0)
    return dr.minimum(value - dr.floor(value), 1.0 - 6e-8)


def _metal_sample(baker: Baker, lane: Any, index: Any, seed: Any) -> MetalSample | None:
    """Return the argument ``sample`` of :meth:`Baker.trace`; None without metals."""
    import mitsuba as mi

    if baker.field.metals is None:
        return None
    a, b = mi.sample_tea_32(lane, seed + 1299709)
    i = mi.Float(index)
    half = mi.Point2f(_shifted(i * 0.7320508075688772, a), _shifted(i * 0.605551275463989, b))
    of_guide, of_emitter = (
        _light_sample(lane, index, seed + offset, _METAL_STEPS) for offset in (49979687, 86028121)
    )
    return MetalSample(half, of_guide, of_emitter)


def _light_sample(lane: Any, index: Any, seed: Any, steps: tuple[float, float, float]) -> tuple[Any, Any]:
    """Return the arguments ``sample_1`` and ``sample_2`` of a light sampler from a lattice with ``steps``."""
    import mitsuba as mi

    a, b = mi.sample_tea_32(lane, seed + 15485863)
    c, _ = mi.sample_tea_32(lane, seed + 32352991)
    i = mi.Float(index)
    return _shifted(i * steps[0], a), mi.Point2f(_shifted(i * steps[1], b), _shifted(i * steps[2], c))


def _irradiance_loop(baker: Baker, p: Any, frame: Any, lane: Any, count: Any, seed: Any) -> tuple[Any, ...]:
    import drjit as dr
    import mitsuba as mi

    def body(index, total, known, photographed):
        u1, u2, u3, u4, u5 = _lattice(lane, index, count, seed)
        wo = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u1, u2))
        ray = mi.Ray3f(p, frame.to_world(wo))
        result = baker.trace(ray, mi.Bool(True), _metal_sample(baker, lane, index, seed))
        weight = baker.lobe_weight(wo.z * dr.inv_pi, result, ray)
        if baker.samples_emitters:
            direction, radiance, light_pdf, is_valid = baker.emitter_sample(p, frame, u3, mi.Point2f(u4, u5))
            cosine_pdf = dr.maximum(direction.z, 0.0) * dr.inv_pi
            others = light_pdf + baker.guide_pdf(p, frame.to_world(direction))
            light = cosine_pdf / dr.maximum(others + cosine_pdf, 1e-20)
            total = total + dr.select(is_valid, radiance * light, 0.0)
        if baker.guide is not None:
            toward, guide_pdf = baker.guide.sample(p, *_light_sample(lane, index, seed, _GUIDE_STEPS))
            guided = mi.Ray3f(p, toward)
            cosine_pdf = dr.maximum(dr.dot(toward, frame.n), 0.0) * dr.inv_pi
            is_valid = (cosine_pdf > 0) & (guide_pdf > 0)
            guided_result = baker.trace(guided, is_valid, _metal_sample(baker, lane, index, seed + 1))
            share = cosine_pdf / dr.maximum(
                cosine_pdf + guide_pdf + baker.emitter_pdf(guided_result, guided), 1e-20
            )
            total = total + dr.select(is_valid, guided_result.radiance * share, 0.0)
        total = total + result.radiance * weight
        known = known + dr.select(result.is_known, 1.0, 0.0)
        photographed = photographed + dr.select(result.is_photographed, 1.0, 0.0)
        return index + 1, total, known, photographed

    state = (mi.UInt32(0), mi.Color3f(0.0), mi.Float(0.0), mi.Float(0.0))
    _, total, known, photographed = dr.while_loop(
        state, lambda index, *_: index < count, body, label="bake_irradiance"
    )
    return total, known, photographed


def _specular_loop(
    baker: Baker, p: Any, frame: Any, wi: Any, alpha: Any, lane: Any, count: Any, seed: Any
) -> tuple[Any, ...]:
    import drjit as dr
    import mitsuba as mi

    def body(index, ls0, ls1, known, photographed):
        u1, u2, u3, u4, u5 = _lattice(lane, index, count, seed)
        h = sample_visible_normal(wi, alpha, mi.Point2f(u1, u2))
        wo = mi.reflect(wi, h)
        above = wo.z > 0
        ray = mi.Ray3f(p, frame.to_world(wo))
        result = baker.trace(ray, above, _metal_sample(baker, lane, index, seed))
        f = schlick_weight(dr.dot(wi, h))
        value = dr.select(above, smith_g1(wo, alpha), 0.0)
        weight = baker.lobe_weight(lobe_pdf(wi, wo, h, alpha), result, ray)
        if baker.samples_emitters:
            direction, radiance, light_pdf, is_valid = baker.emitter_sample(p, frame, u3, mi.Point2f(u4, u5))
            half = dr.normalize(wi + direction)
            lobe = lobe_pdf(wi, direction, half, alpha)
            others = light_pdf + baker.guide_pdf(p, frame.to_world(direction))
            arriving = dr.select(
                is_valid,
                radiance * smith_g1(direction, alpha) * (lobe / dr.maximum(others + lobe, 1e-20)),
                0.0,
            )
            light_f = schlick_weight(dr.dot(wi, half))
            ls0 = ls0 + arriving * (1.0 - light_f)
            ls1 = ls1 + arriving * light_f
        if baker.guide is not None:
            toward, guide_pdf = baker.guide.sample(p, *_light_sample(lane, index, seed, _GUIDE_STEPS))
            guided, direction = mi.Ray3f(p, toward), frame.to_local(toward)
            half = dr.normalize(wi + direction)
            lobe = lobe_pdf(wi, direction, half, alpha)
            is_valid = (lobe > 0) & (guide_pdf > 0)
            guided_result = baker.trace(guided, is_valid, _metal_sample(baker, lane, index, seed + 1))
            share = lobe / dr.maximum(lobe + guide_pdf + baker.emitter_pdf(guided_result, guided), 1e-20)
            arriving = dr.select(is_valid, guided_result.radiance * smith_g1(direction, alpha) * share, 0.0)
            light_f = schlick_weight(dr.dot(wi, half))
            ls0 = ls0 + arriving * (1.0 - light_f)
            ls1 = ls1 + arriving * light_f
        ls0 = ls0 + result.radiance * (value * weight * (1.0 - f))
        ls1 = ls1 + result.radiance * (value * weight * f)
        known = known + dr.select(result.is_known | ~above, 1.0, 0.0)
        photographed = photographed + dr.select(result.is_photographed | ~above, 1.0, 0.0)
        return index + 1, ls0, ls1, known, photographed

    state = (mi.UInt32(0), mi.Color3f(0.0), mi.Color3f(0.0), mi.Float(0.0), mi.Float(0.0))
    _, ls0, ls1, known, photographed = dr.while_loop(
        state, lambda index, *_: index < count, body, label="bake_specular"
    )
    return ls0, ls1, known, photographed
