# SPDX-License-Identifier: MIT
"""Sets the intensity of each group of lights by path tracing in the furnished room.

The path tracer computes each group's contribution to the mean irradiance at camera positions. Each group's
share is drawn log-uniformly; shares are normalised and multiplied by a mean irradiance in the recipe's range.
Groups without contribution are dropped and counted. If the recipe has panoramas, lamps are white-balanced.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.assembly.daylight import environment_radiance, sky_radiance, sun_of
from datagen.assembly.geometry import Floats, Hits
from datagen.assembly.light_probe import LUMINANCE, Emitters, LightGroup, LightProbe, Rectangle
from datagen.assembly.lights import PlannedGroup, RoomToLight, plan_lights, plan_panels
from datagen.assembly.white_balance import NO_TINT, Tint, tint_of_lamps
from datagen.formats.base import quantized
from datagen.formats.lights import AreaLight, EnvironmentLight, Light, SkyLight, scaled
from datagen.formats.recipe import LightRecipe
from datagen.foundation.errors import input_error
from datagen.foundation.random import Draws
from datagen.library import Library

_NEGLIGIBLE = 1e-9  # nominal irradiance relative to the strongest group, below which a group is dropped


@dataclass(frozen=True)
class Lighting:
    """Lights at final intensity and, for each asset, the radiance of its emissive slots in W/(m² sr).

    ``gains`` are the intensities of the groups of ``probe``, relative to their nominal values;
    ``mean_irradiance`` is at the camera positions, in W/m².
    """

    lights: tuple[Light, ...]
    emission: tuple[dict[str, tuple[float, float, float]], ...]
    probe: LightProbe
    gains: tuple[float, ...]
    mean_irradiance: float

    def shows_light(self, origins: Floats, directions: Floats, hits: Hits) -> NDArray[np.bool_]:
        """Mask (R,) of rays (R, 3) whose first hit is on an emissive triangle or visible area light."""
        shown = np.zeros(len(directions), dtype=bool)
        for group, gain in zip(self.probe.groups, self.gains, strict=True):
            if gain > 0 and group.emitters is not None:
                shown |= np.isin(hits.face, group.emitters.faces)
        for light in self.lights:
            if isinstance(light, AreaLight) and light.is_visible:
                shown |= Rectangle.of(light).is_crossed(origins, directions, hits.distance_m)
        return shown

    def luminance(self, origins: Floats, directions: Floats, draws: Draws) -> Floats:
        """Luminance (R,) of reflected light along rays (R, 3), in W/(m² sr)."""
        radiance = self.probe.radiance(origins, directions, draws)
        return np.einsum("rgc,g,c->r", radiance, np.array(self.gains), LUMINANCE)


def light_room(
    room: RoomToLight,
    recipe: LightRecipe,
    library: Library,
    key: tuple[int | str, ...],
    rejections: Counter[str],
) -> Lighting:
    """Choose the lights of a room and set their intensities; ``key`` seeds the random draws.

    Lights that do not reach the camera positions are dropped, and counted in ``rejections``; if none is left,
    ceiling panels replace them. Raises :class:`InputError` if these do not reach the positions either.
    """
    groups = plan_lights(room, recipe, library, key, rejections)
    probe, irradiance = _probe(room, groups, library, key)
    arriving = (irradiance @ LUMINANCE).mean(axis=0)
    useful = arriving > _NEGLIGIBLE * max(float(arriving.max(initial=0.0)), 1e-12)
    if not useful.any():
        rejections["light.no_effect"] += len(groups)
        groups = plan_panels(room, recipe, 2, Draws(*key, "panel"), rejections)
        probe, irradiance = _probe(room, groups, library, key)
        arriving = (irradiance @ LUMINANCE).mean(axis=0)
        useful = arriving > 0
    if not useful.any():
        counts = ", ".join(
            f"{k} {v}" for k, v in sorted(rejections.items()) if k.startswith(("light.", "probe."))
        )
        raise input_error(
            f"environment {room.environment.id}",
            "lights",
            f"no light reaches the camera positions ({counts or 'no light at all'})",
            "at least one light that reaches them",
            "add light slots, openings or lights to the room's asset.json, or correct its camera regions",
        )
    rejections["light.no_effect"] += int((~useful).sum())
    draws = Draws(*key, "intensity")
    target = draws.log_uniform(*recipe.mean_irradiance)
    shares = [draws.log_uniform(*group.share) for group in groups]
    total = sum(share for share, is_useful in zip(shares, useful, strict=True) if is_useful)
    gains = [
        quantized(target * share / total / float(e), 4) if is_useful else 0.0
        for share, e, is_useful in zip(shares, arriving, useful, strict=True)
    ]
    seen = np.einsum("pgc,g->c", irradiance, np.array(gains))
    tint = NO_TINT if recipe.panoramas is None else tint_of_lamps(seen)
    lit = [(group, g) for group, g in zip(groups, gains, strict=True) if g > 0]
    lights = [scaled(light, g, tint) for group, g in lit for light in group.lights]
    emission = _emission(room, groups, gains, tint)
    return Lighting(_named(lights), emission, probe, tuple(gains), float(np.dot(gains, arriving)))


def _named(lights: list[Light]) -> tuple[Light, ...]:
    """Make the names of lights unique by appending a number to repeated names."""
    seen: Counter[str] = Counter()
    named = []
    for light in lights:
        seen[light.name] += 1
        name = light.name if seen[light.name] == 1 else f"{light.name}-{seen[light.name]}"
        named.append(light.model_copy(update={"name": name}))
    return tuple(named)


def _emission(
    room: RoomToLight, groups: list[PlannedGroup], gains: list[float], tint: Tint
) -> tuple[dict[str, tuple[float, float, float]], ...]:
    """Map the emissive slots of each placed asset to their radiance; slots outside all groups are off (0)."""
    gain_of = {slot: gain for group, gain in zip(groups, gains, strict=True) for slot in group.slots}
    emission = []
    for item, asset in enumerate(room.assets):
        found = {}
        for slot in sorted(asset.materials):
            own = asset.materials[slot].emission
            if own is not None:
                gain = gain_of.get((item, slot), 0.0)
                red, green, blue = (quantized(gain * t * c, 6) for t, c in zip(tint, own, strict=True))
                found[slot] = (red, green, blue)
        emission.append(found)
    return tuple(emission)


def _probe(
    room: RoomToLight, groups: list[PlannedGroup], library: Library, key: tuple[int | str, ...]
) -> tuple[LightProbe, Floats]:
    """Return the path tracer of a room and the irradiance (P, G, 3) of each group at camera positions."""
    probe = LightProbe(
        room.scene,
        _albedo_of_faces(room),
        [_probe_group(room, group, library) for group in groups],
        room.environment.openings,
    )
    if not groups or not len(room.eyes):
        return probe, np.zeros((1, len(groups), 3))
    return probe, probe.irradiance(room.eyes, Draws(*key, "probe"))


def _probe_group(room: RoomToLight, group: PlannedGroup, library: Library) -> LightGroup:
    sky, suns, lights = None, [], []
    for light in group.lights:
        if isinstance(light, SkyLight):
            sky = sky_radiance(light)
            suns.append(sun_of(light))
        elif isinstance(light, EnvironmentLight):
            sky = environment_radiance(light, library)
        else:
            lights.append(light)
    return LightGroup(tuple(lights), _emitters(room, group), sky, tuple(suns))


def _emitters(room: RoomToLight, group: PlannedGroup) -> Emitters | None:
    faces, radiance = [], []
    for item, slot in group.slots:
        asset = room.assets[item]
        parts = [k for k, part in enumerate(asset.parts) if part.material == slot]
        found = np.flatnonzero((room.scene.item_of_face == item) & np.isin(room.scene.part_of_face, parts))
        faces.append(found)
        radiance.append(np.repeat([asset.materials[slot].emission], len(found), axis=0))
    if not faces or not sum(len(f) for f in faces):
        return None
    return Emitters(np.concatenate(faces), np.concatenate(radiance).astype(np.float64))


def _albedo_of_faces(room: RoomToLight) -> Floats:
    """Return the albedo (M, 3), D (1 - S) + S, of the material assigned to each triangle, at most 0.95."""
    tables = []
    for asset, assigned in zip(room.assets, room.assigned, strict=True):
        rows = []
        for part in asset.parts:
            diffuse = np.array(assigned[part.material].diffuse_albedo)
            specular = np.array(assigned[part.material].specular_albedo)
            rows.append(np.minimum(diffuse * (1 - specular) + specular, 0.95))
        tables.append(np.array(rows))
    return room.scene.rows_of_faces(tables)
