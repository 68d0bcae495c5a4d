# SPDX-License-Identifier: MIT
"""Emitters of a scene: visibility to the camera, shadow rays and MIS weights.

Emitters hidden from the camera are invisible to camera rays but not to rays after a bounce. Surfaces with
partial opacity, such as leaves and curtains, attenuate shadow rays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from datagen.rendering.transport.light_sampler import LightSampler, uniform_sampler
from datagen.rendering.transport.vertex import MAX_CROSSINGS, Walk, power_heuristic

if TYPE_CHECKING:
    from datagen.rendering.scene_builder import BuiltScene

Array = Any


class SceneEmitters:
    """Emitters of a scene, sampled by ``light_sampler`` or, if that is None, uniformly by Mitsuba."""

    def __init__(self, built: BuiltScene):
        self.scene = built.scene
        self.light_sampler: LightSampler | None = uniform_sampler(self.scene, None)
        self.has_transparency = any(
            mi.has_flag(flags, mi.BSDFFlags.Null)
            for flags in (shape.bsdf().flags() for shape in built.scene.shapes() if shape.bsdf() is not None)
        )
        self.has_hidden = bool(built.hidden_shapes)  # whether any emitter is hidden from camera rays
        self._is_hidden_shape = _hidden_table(built) if self.has_hidden else None

    def tables(self) -> list[Any]:
        """Arrays that recorded kernels read in addition to their arguments."""
        return [self._is_hidden_shape, *([] if self.light_sampler is None else self.light_sampler.arrays())]

    def is_hidden(self, si: Any, depth: Array) -> Array:
        """Mask of the hits ``si`` by camera rays (``depth`` 0) that are on emitters hidden from them."""
        if self._is_hidden_shape is None:
            return mi.Bool(False)
        shape: Any = dr.reinterpret_array(mi.UInt32, si.shape)
        return (depth == 0) & dr.gather(mi.Bool, self._is_hidden_shape, shape, si.is_valid())

    def emission(self, si: Any, walk: Walk, active: Array, shown: Array) -> tuple[Any, Any]:
        """Emitted radiance at hit ``si``, 0 unless ``shown``, and its MIS weight against :meth:`sample`."""
        emitter = si.emitter(self.scene)
        ds = mi.DirectionSample3f(self.scene, si, walk.previous)
        pdf = self.scene.pdf_emitter_direction(walk.previous, ds, active & ~walk.previous_is_delta)
        sampler = self.light_sampler
        if sampler is not None:
            index = sampler.index(emitter)
            pdf = sampler.pdf(walk.previous.p, walk.ray.d, pdf, index, walk.previous_record)
        weight = dr.select(walk.previous_is_delta, 1.0, power_heuristic(walk.previous_pdf, pdf))
        return emitter.eval(si, shown), weight

    def sample(self, si: Any, numbers: Any, record: Array, active: Array) -> tuple[Any, Any]:
        """Sample a direction to an emitter; return a DirectionSample3f and the unoccluded radiance / density.

        ``numbers`` is the path's sampler; ``record`` is the irradiance cache record of ``si``, 0 for none.
        """
        if self.light_sampler is None:
            return self.scene.sample_emitter_direction(si, numbers.next_2d(), False, active)
        return self.light_sampler.sample_emitter(si, record, numbers.next_2d(), numbers.next_1d(), active)

    def visible(self, si: Any, ds: Any, radiance: Array, active: Array) -> Array:
        """Attenuate the ``radiance`` of emitter samples ``ds`` on the way to ``si``; 0 unless ``active``."""
        reaches = active & (ds.pdf != 0.0)
        if self.has_transparency:
            return radiance * self._transmittance(si, ds, reaches)
        is_blocked = self.scene.ray_test(si.spawn_ray_to(ds.p), reaches)
        return dr.select(reaches & ~is_blocked, radiance, 0.0)

    @dr.syntax
    def _transmittance(self, si: Any, ds: Any, active: Array) -> Array:
        """Transmittance (Color3f) of the surfaces between ``si`` and the emitter sample ``ds``."""
        ray = si.spawn_ray_to(ds.p)
        transmittance = dr.select(active, mi.Color3f(1.0), mi.Color3f(0.0))
        num_crossed = mi.UInt32(0)  # surfaces passed through so far
        distance = mi.Float(ray.maxt)  # remaining distance to the emitter sample
        while active:
            hit = self.scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
            is_hit = active & hit.is_valid()
            transmittance *= dr.select(is_hit, hit.bsdf().eval_null_transmission(hit, is_hit), 1.0)
            distance -= hit.t
            next_ray = hit.spawn_ray(ray.d)
            next_ray.maxt = distance
            ray = next_ray
            num_crossed += 1
            active = is_hit & (dr.max(transmittance) > 0.0) & (distance > 0.0)
            if active & (num_crossed >= MAX_CROSSINGS):
                transmittance = mi.Color3f(0.0)
                active = mi.Bool(False)
        return transmittance


def _hidden_table(built: BuiltScene) -> Any:
    """Mask (mi.Bool), by registry index, of the shapes hidden from the camera."""
    from mitsuba_plugins.surface_material import registry_indices  # needs a selected variant

    registry = registry_indices(built.scene)
    table = np.zeros(int(registry.max(initial=0)) + 1, bool)
    for shape, index in zip(built.scene.shapes(), registry, strict=True):
        table[index] = shape.id() in built.hidden_shapes
    return mi.Bool(table)
