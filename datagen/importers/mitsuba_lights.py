# SPDX-License-Identifier: MIT
"""Conversion of Mitsuba emitters to lights of a package.

If the unit of a scene is s metres, radiance is kept and intensity (W/sr) is multiplied by s^2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import matrix4, quantized, vector3
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
from datagen.formats.mitsuba.scene import SceneNode
from datagen.foundation.axes import MITSUBA_FROM_ENVIRONMENT, affine, unit_vector
from datagen.foundation.errors import Problems
from datagen.foundation.naming import unique
from datagen.importers.common import ImportJob
from datagen.importers.mitsuba_values import file_of, rgb_of


@dataclass
class LightConverter:
    """Converter that collects a scene's lights and problems; ``matrix``: ``asset_from_source`` (4, 4)."""

    job: ImportJob
    matrix: NDArray[np.float64]
    lights: list[Light] = field(default_factory=list)
    _names: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.problems = Problems(self.job.where)

    def _name(self, node: SceneNode) -> str:
        name = unique(node.id or node.type, self._names)
        self._names.add(name)
        return name

    def emission_of(self, shape: SceneNode) -> tuple[float, float, float] | None:
        """Return the RGB radiance of a shape's area emitter; None if missing or refused."""
        emitters = shape.children_of("emitter")
        if not emitters:
            return None
        if emitters[0].type != "area":
            got, expected = f"type {emitters[0].type!r}", "an area emitter on a shape"
            self.problems.add(emitters[0].where, got, expected, "replace it")
            return None
        if emitters[0].child("radiance") is not None:
            expected, remedy = "one radiance for the surface", "replace it by its mean"
            self.problems.add(emitters[0].where, "a textured radiance", expected, remedy)
            return None
        return rgb_of(emitters[0].get("radiance", 1.0))

    def add(self, node: SceneNode) -> None:
        """Convert an emitter that is not attached to a shape, and append it to ``lights``."""
        converter = _CONVERTERS.get(node.type)
        if converter is None:
            expected = f"area, {', '.join(_CONVERTERS)}"
            self.problems.add(node.where, f"type {node.type!r}", expected, "replace the emitter")
        elif (light := converter(self, node)) is not None:
            self.lights.append(light)

    def _asset_from_emitter(self, node: SceneNode) -> NDArray[np.float64]:
        return self.matrix @ node.to_world()

    def _constant(self, node: SceneNode) -> Light:
        return EnvironmentLight(name=self._name(node), radiance=rgb_of(node.get("radiance", 1.0)))

    def _envmap(self, node: SceneNode) -> Light | None:
        expected, instead = "an environment map", "environment map replaced by constant radiance 1"
        path = file_of(node, node.where, expected, instead, self.job, self.problems)
        if path is None:
            return None
        if not path.is_file():
            return EnvironmentLight(name=self._name(node))
        rotation = self._asset_from_emitter(node)[:3, :3] @ MITSUBA_FROM_ENVIRONMENT[:3, :3]
        return EnvironmentLight(
            name=self._name(node),
            image=self.job.textures.add_file(path),
            scale=float(node.get("scale", 1.0)),
            world_from_environment=matrix4(affine(rotation / np.cbrt(np.abs(np.linalg.det(rotation))))),
        )

    def _point(self, node: SceneNode) -> Light:
        position = node.get("position")
        matrix = self._asset_from_emitter(node)
        source = np.append(np.asarray(position), 1.0) if position is not None else np.array([0, 0, 0, 1.0])
        point = (self.matrix if position is not None else matrix) @ source
        return PointLight(
            name=self._name(node),
            position_m=vector3(point[:3]),
            intensity=self._intensity(node.get("intensity", 1.0)),
        )

    def _spot(self, node: SceneNode) -> Light:
        matrix = self._asset_from_emitter(node)
        cutoff = math.radians(float(node.get("cutoff_angle", 20.0)))
        beam = node.get("beam_width")
        name = self._name(node)
        if node.child("texture") is not None:
            self.job.findings.approximate(f"{name}: texture of the spot left out")
        return SpotLight(
            name=name,
            position_m=vector3(matrix[:3, 3]),
            direction=vector3(unit_vector(matrix[:3, 2])),
            intensity=self._intensity(node.get("intensity", 1.0)),
            cutoff_rad=quantized(cutoff),
            beam_width_rad=quantized(cutoff * 0.75 if beam is None else math.radians(float(beam))),
        )

    def _directional(self, node: SceneNode) -> Light:
        given = node.get("direction")
        matrix = self._asset_from_emitter(node)
        direction = self.matrix[:3, :3] @ np.asarray(given) if given is not None else matrix[:3, 2]
        return DirectionalLight(
            name=self._name(node),
            direction=vector3(unit_vector(direction)),
            irradiance=rgb_of(node.get("irradiance", 1.0)),
        )

    def _daylight(self, node: SceneNode) -> Light | None:
        """Convert a ``sky``, ``sun`` or ``sunsky``; the first two may state the older parameter ``scale``."""
        scale = None if node.type == "sunsky" else node.get("scale")
        sky_scale, sun_scale = (
            float(node.get(f"{part}_scale", 1.0) if scale is None else scale) if part in node.type else 0.0
            for part in ("sky", "sun")
        )
        if node.get("sun_direction") is None:
            expected, remedy = "sun_direction, not a location and a time", "give the direction of the sun"
            self.problems.add(node.where, "no sun_direction", expected, remedy)
            return None
        direction = self.matrix[:3, :3] @ node.to_world()[:3, :3] @ np.asarray(node.get("sun_direction"))
        albedo = node.get("albedo", 0.3)
        return SkyLight(
            name=self._name(node),
            sun_direction=vector3(unit_vector(direction)),
            turbidity=float(node.get("turbidity", 3.0)),
            ground_albedo=float(np.mean(albedo)),
            sky_scale=sky_scale,
            sun_scale=sun_scale,
        )

    def _intensity(self, value: object) -> tuple[float, float, float]:
        factor = self.job.options.unit_m**2
        red, green, blue = rgb_of(value)
        return red * factor, green * factor, blue * factor


_CONVERTERS: dict[str, Callable[[LightConverter, SceneNode], Light | None]] = {
    "constant": LightConverter._constant,
    "envmap": LightConverter._envmap,
    "point": LightConverter._point,
    "spot": LightConverter._spot,
    "directional": LightConverter._directional,
    "sky": LightConverter._daylight,
    "sun": LightConverter._daylight,
    "sunsky": LightConverter._daylight,
}


def emitter_shape_light(
    node: SceneNode, name: str, asset_from_shape: NDArray[np.float64], radiance: tuple[float, float, float]
) -> Light | None:
    """Return the light of an emitting rectangle, disk or sphere; None if a light cannot represent the shape.

    A rectangle or disk emits along its local +Z (-Z with ``flip_normals``). The edges are swapped if
    necessary so that edge_u x edge_v has this direction, even if ``asset_from_shape`` (4, 4) is a reflection.
    """
    linear, center = asset_from_shape[:3, :3], asset_from_shape[:3, 3]
    if node.type in ("rectangle", "disk"):
        edge_u, edge_v = 2 * linear[:, 0], 2 * linear[:, 1]
        if abs(float(edge_u @ edge_v)) > 1e-3 * float(np.linalg.norm(edge_u) * np.linalg.norm(edge_v)):
            return None  # sheared into a parallelogram
        if (np.linalg.det(linear) < 0) != bool(node.get("flip_normals", False)):
            edge_u, edge_v = edge_v, edge_u
        return AreaLight(
            name=name,
            origin_m=vector3(center - 0.5 * (edge_u + edge_v)),
            edge_u_m=vector3(edge_u),
            edge_v_m=vector3(edge_v),
            radiance=radiance,
            shape="rectangle" if node.type == "rectangle" else "disk",
        )
    if node.type == "sphere":
        scales = np.linalg.svd(linear, compute_uv=False)
        if scales[0] > 1.001 * scales[2] or node.get("flip_normals"):
            return None
        middle = asset_from_shape @ np.append(np.asarray(node.get("center", (0.0, 0.0, 0.0))), 1.0)
        return SphereLight(
            name=name,
            position_m=vector3(middle[:3]),
            radius_m=quantized(float(scales[0]) * float(node.get("radius", 1.0))),
            radiance=radiance,
        )
    return None
