# SPDX-License-Identifier: MIT
"""Options and report of the light stage."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from datagen.foundation.peak_memory import peak_mb
from datagen.foundation.progress import Advance, no_advance
from datagen.light.lighting import GatherOptions
from model.reconstruction.light.solve import PriorWeights


@dataclass(frozen=True)
class LightOptions(GatherOptions):
    """Options of the light stage.

    ``solve_rays``: rays per roughness level and observation of a solved surfel; ``specular_rays``: rays per
    observation of any surfel for its specular part; ``max_points``: maximum number of surfels to be solved
    (see ``points``); ``num_observations``: maximum number of observations of each; ``num_rounds``: 1, or 2
    for a second round with less noise, reflections at metals and the mean outgoing radiance of dielectrics;
    ``prior``: weights of the priors; ``has_prior``: whether the network's maps are a prior;
    ``unmixes_edges``: whether the radiance of other surfaces is removed from pixels at depth edges;
    ``is_corrected``: whether ``shading_correction`` is applied.
    """

    finds_sun: bool = True
    solve_rays: int = 24
    specular_rays: int = 12
    max_points: int = 24_000
    num_observations: int = 8
    num_rounds: int = 2
    prior: PriorWeights = field(default_factory=PriorWeights)
    has_prior: bool = True
    unmixes_edges: bool = True
    is_corrected: bool = True


STEPS = (
    "edges", "surfels", "field", "irradiance", "segments", "solve", "second round", "specular", "correction",
    "maps", "lights",
)  # fmt: skip
"""Steps of the stage in order; "edges" and "second round" are optional."""


@dataclass
class LightReport:
    """Statistics of the light stage.

    ``photographed_share``: mean photographed share of the surfels' hemispheres; ``confidence``: mean
    confidence of D, S and R over surfels; ``seconds``: time of each step; ``memory_mb``: peak resident memory
    at the end of each step.
    """

    num_surfels: int = 0
    num_observations: int = 0
    num_segments: int = 0
    num_metal: int = 0
    photographed_share: float = 0.0
    confidence: tuple[float, ...] = (0.0, 0.0, 0.0)
    seconds: dict[str, float] = field(default_factory=dict)
    memory_mb: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.advance: Advance = no_advance

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Record a step's time and the peak memory, and call ``advance`` after it."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        self.memory_mb[name] = round(peak_mb(), 1)
        self.advance(STEPS.index(name) + 1, len(STEPS))
