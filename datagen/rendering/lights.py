# SPDX-License-Identifier: MIT
"""Converts the lights of a configuration to Mitsuba emitters.

Flat lights are meshes like all other surfaces (a disk is a polygon of equal area), with zero reflectance.
Lights hidden from the camera keep their shape, for reflections and multiple importance sampling, and are
listed in :attr:`LightSetup.hidden`, since camera rays pass through them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from datagen.formats.configuration import Configuration
from datagen.formats.lights import (
    AreaLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
    SkyLight,
    SphereLight,
    SpotLight,
)
from datagen.foundation.axes import MITSUBA_FROM_ENVIRONMENT
from datagen.foundation.errors import InputError, Problem, Problems
from datagen.foundation.images import read_radiance
from datagen.foundation.meshes.mesh import Mesh
from datagen.rendering.geometry import make_shape

if TYPE_CHECKING:
    from datagen.library import Library

DISK_CORNERS = 64
"""Number of corners of the polygon that approximates an elliptic light to within 0.08 % of the radius."""
_MIN_AREA_M2 = 1e-12  # Mitsuba divides by the area


@dataclass
class LightSetup:
    """Lights as ``entries`` of Mitsuba's scene dictionary, and keys of those ``hidden`` from the camera."""

    entries: dict[str, Any] = field(default_factory=dict)
    hidden: set[str] = field(default_factory=set)


def make_lights(
    configuration: Configuration, library: Library, black: Any, problems: list[Problem]
) -> LightSetup:
    """Convert all lights of a configuration except emissive parts. ``black`` is the BSDF of light shapes.

    Faults, such as zero area, two skies or an image with NaN, are added to ``problems``.
    """
    setup = LightSetup()
    skies = [light.name for light in configuration.lights if isinstance(light, EnvironmentLight | SkyLight)]
    if len(skies) > 1:
        where, expected = f"configuration {configuration.id}", "at most one light of type environment or sky"
        problems.append(Problem(where, "lights", ", ".join(skies), expected, "remove the others"))
        return setup
    for index, light in enumerate(configuration.lights):
        name = f"light_{index}"
        faults = Problems(f"configuration {configuration.id}: lights[{index}] ({light.name})")
        entry = _make_light(light, name, library, black, faults)
        problems += faults
        if entry is not None:
            setup.entries[name] = entry
            if isinstance(light, AreaLight) and not light.is_visible:
                setup.hidden.add(name)
    return setup


def _make_light(light: Light, name: str, library: Library, black: Any, problems: Problems) -> Any:
    if isinstance(light, PointLight):
        return {"type": "point", "position": list(light.position_m), "intensity": _rgb(light.intensity)}
    if isinstance(light, SpotLight):
        return _spot(light, problems)
    if isinstance(light, DirectionalLight):
        return _directional(light, problems)
    if isinstance(light, AreaLight):
        mesh = area_light_mesh(light)
        if not mesh.areas().sum() > _MIN_AREA_M2:
            problems.add("edge_u_m x edge_v_m", "no area", "edges that span an area", "correct the light")
            return None
        return make_shape(name, mesh, black, light.radiance)
    if isinstance(light, SphereLight):
        return {
            "type": "sphere",
            "center": list(light.position_m),
            "radius": light.radius_m,
            "bsdf": black,
            "emitter": {"type": "area", "radiance": _rgb(light.radiance)},
        }
    if isinstance(light, EnvironmentLight):
        return _environment(light, library, problems)
    return _sky(light, problems)


def _rgb(value: tuple[float, float, float]) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(c) for c in value]}


def _unit(vector: tuple[float, float, float], field: str, problems: Problems) -> Any:
    array = np.asarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(array))
    if not length > 0:
        problems.add(field, vector, "a direction", "correct the light")
        return None
    return array / length


def _spot(light: SpotLight, problems: Problems) -> Any:
    import mitsuba as mi

    direction = _unit(light.direction, "direction", problems)
    if light.beam_width_rad > light.cutoff_rad:
        got, expected = f"{light.beam_width_rad:g}", f"at most cutoff_rad = {light.cutoff_rad:g}"
        problems.add("beam_width_rad", got, expected, "lower it")
        return None
    if direction is None:
        return None
    up = [0.0, 0.0, 1.0] if abs(direction[2]) < 0.99 else [1.0, 0.0, 0.0]
    origin = np.asarray(light.position_m, dtype=np.float64)
    target = (origin + direction).tolist()
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at(origin=origin.tolist(), target=target, up=up),
        "intensity": _rgb(light.intensity),
        "cutoff_angle": math.degrees(light.cutoff_rad),
        # Mitsuba divides by cutoff - beam width, which must not be 0
        "beam_width": math.degrees(min(light.beam_width_rad, 0.999 * light.cutoff_rad)),
    }


def _directional(light: DirectionalLight, problems: Problems) -> Any:
    direction = _unit(light.direction, "direction", problems)
    if direction is None:
        return None
    sun = {"direction": direction.tolist(), "irradiance": _rgb(light.irradiance)}
    if light.angular_diameter_rad == 0:
        return {"type": "directional", **sun}
    return {"type": "sun_disc", **sun, "angular_diameter_rad": light.angular_diameter_rad}


def area_light_mesh(light: AreaLight) -> Mesh:
    """World-space mesh of an area light, which emits on the side of its normal edge_u x edge_v."""
    origin, u, v = (np.asarray(a, dtype=np.float64) for a in (light.origin_m, light.edge_u_m, light.edge_v_m))
    if light.shape == "rectangle":
        corners = np.stack([origin, origin + u, origin + u + v, origin + v])
        faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    else:
        angle = np.arange(DISK_CORNERS) * (2 * math.pi / DISK_CORNERS)
        # a polygon inscribed in this radius has the area of the unit circle
        radius = math.sqrt(2 * math.pi / (DISK_CORNERS * math.sin(2 * math.pi / DISK_CORNERS)))
        centre = origin + 0.5 * (u + v)
        rim = centre + 0.5 * radius * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v)
        corners = np.concatenate([centre[None], rim])
        step = np.arange(DISK_CORNERS)
        faces = np.stack([np.zeros_like(step), step + 1, (step + 1) % DISK_CORNERS + 1], axis=1)
    return Mesh(corners.astype(np.float32), faces.astype(np.int32))


def _environment(light: EnvironmentLight, library: Library, problems: Problems) -> Any:
    import mitsuba as mi

    if light.image is None:
        return {"type": "constant", "radiance": _rgb(tuple(c * light.scale for c in light.radiance))}  # type: ignore[arg-type]
    if light.asset is None:
        problems.add("asset", "null", "the id of the package that contains the image", "name it")
        return None
    try:
        pixels = read_radiance(library.package(light.asset).local_file(light.image))
    except InputError as error:
        problems.extend(error.problems)
        return None
    world_from_mitsuba = np.asarray(light.world_from_environment, np.float64) @ MITSUBA_FROM_ENVIRONMENT
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(pixels, dtype=np.float32)),
        "scale": light.scale,
        "to_world": mi.ScalarTransform4f(world_from_mitsuba),
    }


def _sky(light: SkyLight, problems: Problems) -> Any:
    direction = _unit(light.sun_direction, "sun_direction", problems)
    if direction is None:
        return None
    return {
        "type": "sunsky",
        "sun_direction": direction.tolist(),
        "turbidity": light.turbidity,
        "albedo": light.ground_albedo,
        "sky_scale": light.sky_scale,
        "sun_scale": light.sun_scale,
    }
