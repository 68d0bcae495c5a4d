# SPDX-License-Identifier: MIT
"""Recovered lights of a photographed room, for exports and reports.

A *lamp* is an emissive surface: triangles, or *panels*, rectangles just in front of a partly emissive
surface. *Windows* are openings through which rays leave the mesh; light from outside is represented by their
rectangles if it is near, by an image of the *sky* if it is far, and by the *sun* if there are sunlit patches.
*Holes* are openings no brighter than white paint, hence gaps of the mesh; they do not emit in exports.
Radiance is in the photographs' unit; power is in that unit times m^2 sr, hence W for radiance in W/(m^2 sr).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Color = tuple[float, float, float]
ENVIRONMENT_FILE = "environment.exr"
SKY, SUN = "sky", "sun"
"""Slots of the recovered sky and sun."""


@dataclass(frozen=True)
class Rectangle:
    """A rectangle with the points ``origin_m + s edge_u_m + t edge_v_m``, s and t in [0, 1], that emits on
    the side of the normal cross(edge_u_m, edge_v_m).
    """

    origin_m: Color
    edge_u_m: Color
    edge_v_m: Color
    radiance: Color

    @property
    def area_m2(self) -> float:
        return float(np.linalg.norm(np.cross(self.edge_u_m, self.edge_v_m)))

    def corners(self) -> NDArray[np.float64]:
        """Corners (4, 3), counter-clockwise from the emitting side."""
        origin, u, v = (np.array(part) for part in (self.origin_m, self.edge_u_m, self.edge_v_m))
        return np.stack([origin, origin + u, origin + u + v, origin + v])


@dataclass(frozen=True)
class FoundLamp:
    """A lamp: emissive triangles with indices ``faces`` (K,) and centroid ``place_m``.

    ``side``: 1 if the triangles emit from their front (counter-clockwise winding), -1 if from their back.
    ``radiance`` is 0 if unknown. ``is_named``: whether the capture's geometry declares this lamp.
    """

    slot: str
    faces: NDArray[np.int32]
    side: int
    radiance: Color
    place_m: Color
    area_m2: float
    is_named: bool

    @property
    def is_lit(self) -> bool:
        """True if the recovered radiance is above 0 in any channel."""
        return max(self.radiance) > 0


@dataclass(frozen=True)
class FoundPatch:
    """A window, panel or hole covered by ``rectangles``, its centre ``place_m`` and mean ``radiance``."""

    slot: str
    rectangles: tuple[Rectangle, ...]
    place_m: Color
    area_m2: float
    radiance: Color

    def times(self, gain: Color | None) -> FoundPatch:
        """The patch with its radiance multiplied by ``gain`` (R, G, B), or unchanged if ``gain`` is None."""
        rectangles = tuple(replace(r, radiance=_product(r.radiance, gain)) for r in self.rectangles)
        return replace(self, rectangles=rectangles, radiance=_product(self.radiance, gain))


@dataclass(frozen=True)
class FoundSun:
    """The sun: unit ``direction`` to it, ``irradiance`` of a surface that faces it, and angular diameter."""

    direction: Color
    irradiance: Color
    angular_diameter_rad: float


@dataclass(frozen=True)
class RadianceSamples:
    """Photographed ``radiance`` (N, 3) of N pixels, with the camera's position ``origin_m`` (N, 3) and the
    unit ``direction`` (N, 3) from the camera to the surface.
    """

    origin_m: NDArray[np.float32]
    direction: NDArray[np.float32]
    radiance: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.radiance)


@dataclass(frozen=True)
class FoundLights:
    """All recovered lights.

    ``environment`` (H, W, 3): image of the sky if light from outside is distant, in the convention of
    :class:`~datagen.formats.lights.EnvironmentLight`; None if the windows' rectangles emit this light.
    ``sun``: None if none was found.
    """

    lamps: tuple[FoundLamp, ...] = ()
    panels: tuple[FoundPatch, ...] = ()
    windows: tuple[FoundPatch, ...] = ()
    environment: NDArray[np.float32] | None = None
    holes: tuple[FoundPatch, ...] = ()
    sun: FoundSun | None = None

    @property
    def is_dark(self) -> bool:
        """True if none of the lights emits."""
        return not (self.windows or self.panels or self.sun or any(lamp.is_lit for lamp in self.lamps))

    def with_gains(self, gains: Mapping[str, Color]) -> FoundLights:
        """The lights with their radiance multiplied by ``gains``, RGB factors by slot (1 if missing)."""
        sky = self.environment
        if sky is not None and SKY in gains:
            sky = sky * np.array(gains[SKY], np.float32)
        sun = self.sun
        if sun is not None:
            sun = replace(sun, irradiance=_product(sun.irradiance, gains.get(SUN)))
        lamps = (replace(lamp, radiance=_product(lamp.radiance, gains.get(lamp.slot))) for lamp in self.lamps)
        panels, windows = (
            tuple(patch.times(gains.get(patch.slot)) for patch in patches)
            for patches in (self.panels, self.windows)
        )
        return FoundLights(tuple(lamps), panels, windows, sky, self.holes, sun)

    @property
    def emitting_patches(self) -> tuple[FoundPatch, ...]:
        """The panels, and the windows unless the sky replaces them."""
        return self.panels if self.environment is not None else (*self.panels, *self.windows)

    def described(self) -> list[dict[str, Any]]:
        """The lights as rows of a report.

        A row has ``kind`` (lamp, window, sky, sun), the ``slot`` in exports and ``radiance``; lamps and
        windows also have ``place_m``, ``area_m2`` and the diffusely emitted ``power`` = pi area radiance. The
        sun has ``direction`` and ``irradiance`` instead.
        """
        rows = [
            _row("lamp", lamp.slot, lamp.place_m, lamp.area_m2, lamp.radiance)
            for lamp in self.lamps
            if lamp.is_lit
        ]
        rows += [_row("lamp", p.slot, p.place_m, p.area_m2, p.radiance) for p in self.panels]
        rows += [_row("window", w.slot, w.place_m, w.area_m2, w.radiance) for w in self.windows]
        if self.environment is not None and self.windows:
            area = sum(window.area_m2 for window in self.windows)
            mean = sum(window.area_m2 * np.array(window.radiance) for window in self.windows) / area
            rows.append({"kind": "sky", "slot": SKY, "radiance": _rounded(mean, 5)})
        if self.sun is not None:
            direction, irradiance = _rounded(self.sun.direction, 4), _rounded(self.sun.irradiance, 5)
            rows.append({"kind": "sun", "slot": SUN, "direction": direction, "irradiance": irradiance})
        return rows

    def described_holes(self) -> list[dict[str, Any]]:
        """The mesh's holes as rows like those of :meth:`described`, with the kind ``hole``."""
        return [_row("hole", h.slot, h.place_m, h.area_m2, h.radiance) for h in self.holes]


def as_color(values: NDArray) -> Color:
    """Convert an array (3,) of R, G and B to a tuple of floats."""
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _product(radiance: Color, gain: Color | None) -> Color:
    if gain is None:
        return radiance
    return radiance[0] * gain[0], radiance[1] * gain[1], radiance[2] * gain[2]


def _row(
    kind: Literal["lamp", "window", "hole"], slot: str, place: Color, area: float, radiance: Color
) -> dict[str, Any]:
    return {
        "kind": kind,
        "slot": slot,
        "place_m": _rounded(place, 4),
        "area_m2": round(area, 6),
        "radiance": _rounded(radiance, 5),
        "power": _rounded(np.pi * area * np.array(radiance), 5),
    }


def _rounded(values: Any, digits: int) -> list[float]:
    return [round(float(value), digits) for value in values]


def light_cells(row: dict[str, Any]) -> tuple[str, str, str, str, str]:
    """Format place, area, radiance (irradiance of the sun), power and gain of a row; '' for missing ones."""
    emission = row.get("radiance") or row["irradiance"]
    colors = (emission, row.get("power", ()), row.get("gain", ()))
    radiance, power, gain = (" ".join(f"{v:.3g}" for v in values) for values in colors)
    place = " ".join(f"{v:.2f}" for v in row.get("place_m", ()))
    return place, f"{row['area_m2']:.3f}" if "area_m2" in row else "", radiance, power, gain


def lights_text(rows: list[dict[str, Any]]) -> str:
    """Format the rows of :meth:`FoundLights.described` and their optional ``gain`` as a text table."""
    if not rows:
        return "no light was found"
    lines = [
        f"{'light':<12}{'centre (m)':>20}{'area (m2)':>11}{'radiance (R G B)':>24}{'power (R G B)':>24}"
        f"{'gain (R G B)':>20}"
    ]
    for row in rows:
        place, area, radiance, power, gain = light_cells(row)
        lines.append(f"{row['slot']:<12}{place:>20}{area:>11}{radiance:>24}{power:>24}{gain:>20}")
    if any("irradiance" in row for row in rows):
        lines.append("sun: irradiance of a surface that faces it instead of radiance")
    return "\n".join(lines)
