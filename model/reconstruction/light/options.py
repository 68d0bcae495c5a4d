# SPDX-License-Identifier: MIT
"""Options and report of the light stage."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from datagen.foundation.peak_memory import peak_mb
from datagen.light.lighting import GatherOptions
from model.reconstruction.light.solve import PriorWeights


@dataclass(frozen=True)
class LightOptions(GatherOptions):
    """Rays an observation of a solved point and level (``solve_rays``), an observation of a surfel
    (``specular_rays``), beside those that gather light; ``max_points`` solved in all, ``num_observations`` of
    each. ``num_rounds``: in a second one, the light has less noise, and rays go on where they meet a metal
    that the first has found. ``has_prior``: whether the network's maps draw the solution where evidence
    lacks. ``is_corrected``: whether the shading gets a smooth correction where its light is not
    photographed."""

    solve_rays: int = 24
    specular_rays: int = 12
    max_points: int = 24_000
    num_observations: int = 8
    num_rounds: int = 2
    prior: PriorWeights = field(default_factory=PriorWeights)
    has_prior: bool = True
    is_corrected: bool = True


STEPS = (
    "surfels", "field", "irradiance", "segments", "solve", "second round", "specular", "correction", "maps",
    "lights",
)  # fmt: skip
"""Of the stage, in their order; with one round the second is left out."""


@dataclass
class LightReport:
    """Findings of the light stage. ``photographed_share``: mean share of the surfels' hemispheres that
    photographs show; ``confidence`` means over surfels for D, S and R; ``seconds`` by step, and
    ``memory_mb``, the peak of the process's resident memory up to the end of each."""

    num_surfels: int = 0
    num_observations: int = 0
    num_segments: int = 0
    num_metal: int = 0
    photographed_share: float = 0.0
    confidence: tuple[float, ...] = (0.0, 0.0, 0.0)
    seconds: dict[str, float] = field(default_factory=dict)
    memory_mb: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.advance: Callable[[int, int], None] = lambda done, total: None

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time a step, and move ``advance`` on after it."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        self.memory_mb[name] = round(peak_mb(), 1)
        self.advance(STEPS.index(name) + 1, len(STEPS))
