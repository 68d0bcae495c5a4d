# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that model shoes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenes.sources.modelling import PartBuilder
from scenes.sources.shapes import Shape, join, loft, tube


def _sole(length: float, width: float) -> np.ndarray:
    """Outline (36, 2) of a right shoe's sole about its centre, toe towards -y."""
    angle = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    y = -length / 2 * np.sin(angle)
    t = (y + length / 2) / length  # 0 at the toe
    half = (
        width
        / 2
        * (
            0.80
            + 0.20 * np.cos(2 * np.pi * np.clip((t - 0.28) / 1.25, -0.5, 0.5))
            - 0.16 * np.exp(-(((t - 0.62) / 0.16) ** 2))
        )
    )
    x = half * np.cos(angle) + 0.006 * np.sin(np.pi * t)
    return np.column_stack([x, y])


def _upper(
    length: float, width: float, base: float, heights: tuple[float, float, float], opening: float
) -> list[np.ndarray]:
    """Rings (36, 3) of the upper, from sole to collar; ``heights``: heights of toe, instep and heel [m]."""
    rings = []
    outline = _sole(length, width)
    t = (outline[:, 1] + length / 2) / length
    top = np.interp(t, [0.0, 0.25, 0.5, 1.0], [heights[0] * 0.75, heights[0], heights[1], heights[2]])
    for s in (0.0, 0.2, 0.45, 0.7, 0.88, 1.0):
        lean = 1 - 0.62 * s**2.2 * np.interp(t, [0.0, 0.3, 0.55, 1.0], [0.55, 0.9, 0.35, 0.12])
        y_in = outline[:, 1] + (opening - outline[:, 1]) * s**3 * np.interp(
            t, [0, 0.45, 0.75, 1.0], [0.86, 0.55, 0.06, 0.05]
        )
        rings.append(np.column_stack([outline[:, 0] * lean, y_in, base + top * s]))
    return rings


@dataclass(frozen=True)
class _Shoe:
    """A right shoe in metres; ``heights`` of toe, instep and heel; ``thick``: thickness of the sole."""

    length: float = 0.285
    width: float = 0.102
    heights: tuple[float, float, float] = (0.05, 0.085, 0.075)
    thick: float = 0.024
    is_laced: bool = True

    def rings(self) -> list[np.ndarray]:
        """Rings (36, 3) of the upper, from the sole to the collar."""
        collar = self.length * 0.2
        return _upper(self.length * 0.985, self.width * 0.97, self.thick - 0.002, self.heights, collar)

    def pieces(self) -> list[tuple[str, Shape]]:
        """Pairs of slot and shape of the sole, upper and lining."""
        base, thick, rings = _sole(self.length, self.width), self.thick, self.rings()
        rim = [
            np.column_stack([base * s, np.full(len(base), z)])
            for s, z in ((0.95, 0.0), (1.0, 0.004), (1.02, thick * 0.7), (1.0, thick), (0.97, thick))
        ]
        collar, centre = rings[-1], rings[-1].mean(axis=0)

        def shrunk(share: float, z: np.ndarray | float) -> np.ndarray:
            """The collar scaled by ``share`` about its centre, at height ``z``."""
            flat = centre[:2] + (collar[:, :2] - centre[:2]) * share
            return np.column_stack([flat, np.broadcast_to(z, len(collar))])

        inner = [
            collar + np.array([0, 0, 0.002]),
            shrunk(0.95, collar[:, 2]),
            shrunk(0.93, collar[:, 2] - 0.012),
        ]
        floor = [shrunk(s, z) for s, z in ((0.9, thick + 0.02), (0.5, thick + 0.006), (0.05, thick + 0.005))]
        return [
            ("sole", loft(rim)),
            ("upper", loft([*rings, *inner[:2]], capped=False)),
            ("lining", loft([*inner[1:], *floor], capped=False)),
        ]

    def laces(self) -> Shape:
        """Five laces across the instep."""
        front = self.rings()[-1][:, 1].min()
        bars = []
        for k in range(5):
            y = front - 0.008 - 0.0135 * k
            z = self.thick + self.heights[1] * (0.97 - 0.105 * k) + 0.001
            half = 0.017 + 0.002 * k
            ends = (-half, y, z - 0.008), (half, y, z - 0.008)
            path = [ends[0], (-half * 0.4, y - 0.002, z), (half * 0.4, y + 0.002, z), ends[1]]
            bars.append(tube(path, 0.0022, 6, smooth=2))
        return join(bars)

    def add_pair(self, w: PartBuilder, gap: float) -> None:
        """Add a pair of shoes with the distance ``gap`` between centres and toes turned outwards."""
        for part, side in (("right", -1), ("left", 1)):
            for slot, shape in self.pieces():
                own = shape.bent(lambda p: p * [-1, 1, 1]).flipped() if part == "left" else shape
                w[part, slot] += own.turned("z", 4.0 * side, (side * gap / 2, 0.012 * side, 0))
            if self.is_laced:
                laces = self.laces().turned("z", 4.0 * side)
                w[part, "lace"] += laces.moved(x=side * gap / 2, y=0.012 * side)


def shoes_trainers(w: PartBuilder) -> None:
    _Shoe(thick=0.03).add_pair(w, 0.13)


def shoes_leather(w: PartBuilder) -> None:
    _Shoe(0.295, 0.096, (0.042, 0.078, 0.066), 0.014).add_pair(w, 0.125)


def shoes_slippers(w: PartBuilder) -> None:
    _Shoe(0.27, 0.105, (0.052, 0.06, 0.036), 0.012, is_laced=False).add_pair(w, 0.13)
