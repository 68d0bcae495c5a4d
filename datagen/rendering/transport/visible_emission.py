# SPDX-License-Identifier: MIT
"""Visible emission: light that reaches the camera from emitters and background without a bounce.

It has no noise except at edges, where it is traced with more samples. It is not denoised but added to the
denoised reflected light.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.rendering.transport.emitters import SceneEmitters
from datagen.rendering.transport.vertex import MAX_CROSSINGS
from mitsuba_plugins.lattice import generator, lattice_point

Array = Any


def render_visible_emission(
    emitters: SceneEmitters, sensor: Any, pixels: NDArray[np.uint32], num_samples: int, seed: int
) -> NDArray[np.float32]:
    """Visible emission (P, 3) of ``pixels``, flat indices (P,), from ``num_samples`` rays each."""
    width, height = (int(v) for v in sensor.film().crop_size())
    with dr.suspend_grad():
        radiance = _summed(emitters, sensor, mi.UInt32(pixels), (width, height), num_samples, seed)
        dr.eval(radiance)
    return np.ascontiguousarray((np.array(radiance) / num_samples).T.astype(np.float32))


@dr.syntax
def _summed(
    emitters: Any, sensor: Any, pixel: Array, size: tuple[int, int], num_samples: int, seed: int
) -> Array:
    width, height = size
    # opaque: one compiled kernel serves all counts and seeds
    count: Any = dr.opaque(mi.UInt32, num_samples)
    step_x, step_y = (dr.opaque(mi.UInt32, step) for step in generator(num_samples))
    key: Any = dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)
    shift_x, shift_y = mi.sample_tea_32(pixel, key)
    row: Any = pixel // width
    left, top = mi.Float(pixel - row * width), mi.Float(row)
    result = dr.zeros(mi.Color3f, dr.width(pixel))
    i = dr.zeros(mi.UInt32, dr.width(pixel))
    while i < count:
        x, y = lattice_point(i, shift_x, step_x), lattice_point(i, shift_y, step_y)
        position = mi.Point2f((left + x) / width, (top + y) / height)
        ray, _ = sensor.sample_ray(mi.Float(0.0), mi.Float(0.5), position, mi.Point2f(0.5))
        result += _emission_ahead(emitters, ray)
        i += 1
    return result


@dr.syntax
def _emission_ahead(emitters: Any, ray: Array) -> Array:
    """Emitted radiance along a camera ray, attenuated by surfaces with partial opacity."""
    scene = emitters.scene
    result = mi.Color3f(0.0)  # emitted radiance so far
    throughput = mi.Color3f(1.0)  # transmittance of the surfaces passed through so far
    num_crossed = mi.UInt32(0)  # number of those surfaces
    active = mi.Bool(True)  # lanes whose ray continues
    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        is_seen = active & ~emitters.is_hidden(si, mi.UInt32(0))
        result += throughput * si.emitter(scene).eval(si, is_seen)
        active &= si.is_valid()
        if dr.hint(emitters.has_transparency, mode="scalar"):
            transmission = si.bsdf().eval_null_transmission(si, active & is_seen)
            throughput *= dr.select(is_seen, transmission, 1.0)
        else:
            active &= ~is_seen
        num_crossed += 1
        active &= (dr.max(throughput) > 0.0) & (num_crossed < MAX_CROSSINGS)
        ray = si.spawn_ray(ray.d)
    return result
