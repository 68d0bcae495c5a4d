# SPDX-License-Identifier: MIT
"""Estimates gains of the recovered lights that make the exported asset as bright as the photographs.

A recovered light has the radiance that was photographed or inferred where it is emitted or enters the room.
The brightness of other surfaces also depends on unphotographed surfaces, on the merged materials, and on
windows that are exported as diffuse rectangles. Therefore the radiance of photographed pixels due to each
light alone is path traced in the exported Mitsuba scene. The gains, one per light and channel, minimise a
robust loss of the differences in log radiance from the photographs, including pixels that show a light.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import write_bytes_atomically
from datagen.foundation.color import luminance
from mitsuba_plugins.arrays import rows_from_vectors, vectors_from_rows
from model.reconstruction.atlas.atlas import MAP_CHANNELS
from model.reconstruction.export.atlas_images import reduced_png, texture_shrink
from model.reconstruction.export.mitsuba_scene import write_mitsuba_scene
from model.reconstruction.export.slots import Reconstruction
from model.reconstruction.found_lights import SKY, SUN, Color, FoundLights, RadianceSamples, as_color

PATHS, MAX_DEPTH = 256, 24
"""Light paths per sampled pixel and light, and their maximum number of segments."""
MAX_LIGHTS = 24
"""Maximum number of gains; the least powerful lights share the last one."""
NOISE, FLOOR = 0.3, 0.1
"""Difference of ln radiance above which the loss is linear, and radiance, relative to the median, that is
added before the logarithm."""
GAIN_SPREAD, COLOR_SPREAD = 2.0, 0.2
"""Prior standard deviations of ln gain and of its deviation from the mean over channels."""
MIN_SAMPLES = 100
_BATCH = 1 << 19  # paths traced at once


@dataclass(frozen=True)
class Balance:
    """Balanced ``lights``, ``gains`` by slot, and mean loss of held-out samples before and after the fit."""

    lights: FoundLights
    gains: dict[str, Color]
    loss_before: float
    loss_after: float


def balanced(reconstruction: Reconstruction, samples: RadianceSamples) -> Balance | None:
    """Balance the recovered lights of ``reconstruction`` against the photographed ``samples``.

    Returns None if no light emits, if there are fewer than :data:`MIN_SAMPLES` samples or most are black, or
    if gains from half of the samples do not reduce the loss of the other half.
    """
    lights = reconstruction.shining_lights
    photographed = samples.radiance.astype(np.float64)
    if lights is None or len(samples) < MIN_SAMPLES:
        return None
    floor = FLOOR * float(np.median(luminance(photographed)))
    if floor == 0:  # the logarithm of black needs a floor
        return None
    groups, names = _groups(lights), _emitters(lights)
    emitters = [[name for slot in slots for name in names.get(slot, ())] for slots in groups]
    transport = _transport(reconstruction, samples, emitters)
    is_fitted = np.random.default_rng(0).permutation(len(photographed)) % 2 == 0
    trial = _solved(transport[is_fitted], photographed[is_fitted], floor)
    before, after = (
        _loss(_differences(transport[~is_fitted], photographed[~is_fitted], floor, gains)).mean()
        for gains in (np.ones_like(trial), trial)
    )
    if after >= before:
        return None
    solved = _solved(transport, photographed, floor).round(4)
    gains = {slot: as_color(gain) for slots, gain in zip(groups, solved, strict=True) for slot in slots}
    return Balance(lights.with_gains(gains), gains, float(before), float(after))


def _groups(lights: FoundLights) -> list[list[str]]:
    """Group the slots that share a gain: sky and windows, the sun, then others by decreasing power."""
    powers = {lamp.slot: lamp.area_m2 * sum(lamp.radiance) for lamp in lights.lamps if lamp.is_lit}
    powers |= {patch.slot: patch.area_m2 * sum(patch.radiance) for patch in lights.emitting_patches}
    groups = [[slot] for slot in sorted(powers, key=lambda slot: (-powers[slot], slot))]
    if lights.sun is not None:
        groups.insert(0, [SUN])
    if lights.environment is not None:
        groups.insert(0, [SKY, *(window.slot for window in lights.windows)])
    alone, shared = groups[: MAX_LIGHTS - 1], groups[MAX_LIGHTS - 1 :]
    return [*alone, [slot for group in shared for slot in group]] if shared else alone


def _emitters(lights: FoundLights) -> dict[str, list[str]]:
    """Return the names of the exported emitters by slot, without dark rectangles."""
    names = {lamp.slot: [lamp.slot] for lamp in lights.lamps if lamp.is_lit}
    for patch in lights.emitting_patches:
        is_lit = (max(rectangle.radiance) > 0 for rectangle in patch.rectangles)
        names[patch.slot] = [f"{patch.slot}-{number}" for number, lit in enumerate(is_lit) if lit]
    far = {SKY: lights.environment is not None, SUN: lights.sun is not None}
    return names | {slot: [slot] for slot, is_found in far.items() if is_found}


def _transport(
    reconstruction: Reconstruction, samples: RadianceSamples, groups: Sequence[Sequence[str]]
) -> NDArray[np.float64]:
    """Compute the radiance (N, K, 3) of the samples due to each of K groups of emitters alone."""
    import drjit as dr

    with tempfile.TemporaryDirectory(prefix="lights-") as folder:
        scene = _load_scene(reconstruction, Path(folder))
        emitters = _Emitters(scene, [name for group in groups for name in group])
        found = []
        for seed, group in enumerate(groups):
            emitters.switch_on(group)
            found.append(_radiance(scene, samples, seed))
    del scene, emitters
    dr.flush_malloc_cache()  # the exports that follow need the memory
    return np.stack(found, axis=1)


def _load_scene(reconstruction: Reconstruction, folder: Path) -> Any:
    """Load the exported scene without sensors, with textures of at most ``MAX_TEXTURE`` texels per side."""
    import mitsuba as mi

    from mitsuba_plugins import register

    register()
    if texture_shrink(reconstruction.atlas) > 1:
        for name in MAP_CHANNELS:
            write_bytes_atomically(folder / f"{name}.png", reduced_png(reconstruction.atlas, name))
        reconstruction = replace(reconstruction, images=folder)
    return mi.load_file(str(write_mitsuba_scene(folder / "scene", reconstruction, has_sensors=False)))


def _rays(samples: RadianceSamples, which: NDArray[np.int64]) -> Any:
    import mitsuba as mi

    origin, direction = (vectors_from_rows(rows[which]) for rows in (samples.origin_m, samples.direction))
    return mi.RayDifferential3f(mi.Ray3f(mi.Point3f(origin), direction))


class _Emitters:
    """Switches emitters of a scene on and off; ``names`` are the ids of emissive shapes, sky and sun."""

    def __init__(self, scene: Any, names: Sequence[str]):
        import mitsuba as mi

        self._parameters = mi.traverse(scene)
        self._keys = {name: _emission_keys(self._parameters, name) for name in names}
        self._emission = {
            name: type(self._parameters[key])(self._parameters[key]) for name, (key, _) in self._keys.items()
        }

    def switch_on(self, chosen: Sequence[str]) -> None:
        """Switch the ``chosen`` emitters on and all others off."""
        for name, (emission, weight) in self._keys.items():
            is_on = float(name in chosen)
            self._parameters[emission] = self._emission[name] * is_on
            self._parameters[weight] = is_on
        self._parameters.update()


def _emission_keys(parameters: Any, name: str) -> tuple[str, str]:
    """Return the names of the scene parameters for an emitter's emission and its weight in light sampling."""
    keys = f"{name}.scale", f"{name}.irradiance.value", f"{name}.emitter.radiance.value"
    emission = next(key for key in keys if key in parameters)
    owner = f"{name}.emitter" if emission == keys[-1] else name
    return emission, f"{owner}.sampling_weight"


def _radiance(scene: Any, samples: RadianceSamples, seed: int) -> NDArray[np.float64]:
    """Path trace the radiance (N, 3) of the samples due to the emitters that are switched on."""
    import mitsuba as mi

    integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH, "rr_depth": MAX_DEPTH // 2})
    found = []
    size = _BATCH // PATHS
    for start in range(0, len(samples), size):
        which = np.repeat(np.arange(start, min(start + size, len(samples))), PATHS)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed * len(samples) + start, len(which))
        radiance, _, _ = integrator.sample(scene, sampler, _rays(samples, which))
        found.append(rows_from_vectors(radiance).astype(np.float64).reshape(-1, PATHS, 3).mean(axis=1))
    return np.concatenate(found)


def _differences(transport: NDArray, photographed: NDArray, floor: float, gains: NDArray) -> NDArray:
    """Compute the difference (N, 3) of ln(radiance + floor) between the asset and the photographs, for
    ``gains`` (K, 3) of K lights; ``transport`` (N, K, 3) is the radiance due to each light at gain 1.
    """
    return np.log((transport * gains).sum(axis=1) + floor) - np.log(photographed + floor)


def _loss(differences: NDArray) -> NDArray[np.float64]:
    """Compute the pseudo-Huber loss: half the squared difference, linear above about :data:`NOISE`."""
    return np.asarray(NOISE**2 * (np.sqrt(1 + (differences / NOISE) ** 2) - 1))


def _solved(transport: NDArray, photographed: NDArray, floor: float) -> NDArray[np.float64]:
    """Compute the gains (K, 3) that minimise the loss plus the squared deviations from the prior."""
    from scipy.optimize import least_squares

    shape = transport.shape[1:]

    def residuals(log_gains: NDArray) -> NDArray:
        gains = log_gains.reshape(shape)
        data = np.sqrt(2 * _loss(_differences(transport, photographed, floor, np.exp(gains))))
        color = (gains - gains.mean(axis=1, keepdims=True)) / COLOR_SPREAD
        return np.concatenate([data.ravel() / NOISE, (gains / GAIN_SPREAD).ravel(), color.ravel()])

    return np.exp(least_squares(residuals, np.zeros(np.prod(shape))).x).reshape(shape)
