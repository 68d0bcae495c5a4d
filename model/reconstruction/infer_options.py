# SPDX-License-Identifier: MIT
"""What a run of ``materials infer`` is told, and what it tells."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from datagen.foundation.errors import input_error
from datagen.foundation.peak_memory import peak_mb
from model.reconstruction.found_lights import lights_text
from model.reconstruction.merge.merger import Weights

Progress = Callable[[str, int, int], None]
Materials = Literal["network", "light", "both"]


@dataclass(frozen=True)
class InferOptions:
    """``atlas`` is the side in texels, or "auto" from the density of the views' pixels. ``is_checked``:
    whether the mesh is compared with the photographs first. ``weights`` of the medians over views, see
    :class:`MergeOptions`; confidence takes the checkpoint's. ``is_leveled``:
    whether predicted diffuse albedo takes its level from the light between the surfaces
    (``albedo_level``). ``materials``: from the network alone, from the light that the photographs record
    alone, or both, the network's as the prior (``light``). ``has_punctual``: whether the GLB has small lamps
    as point lights, too. ``is_evened``: whether exposures, vignetting and response are found from photographs
    that overlap (``radiometry``). ``mends_poses``: whether small errors of the cameras' poses are sought
    (``geometry.pose_mending``)."""

    atlas: int | Literal["auto"] = "auto"
    visibility: Literal["depth", "trace"] = "depth"
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    batch: int = 4
    is_filtered: bool = True
    device: str = "cpu"
    has_exr: bool = True
    is_checked: bool = True
    jobs: int = 2
    weights: Weights = "none"
    is_leveled: bool = True
    materials: Materials = "both"
    has_punctual: bool = False
    is_evened: bool = True
    mends_poses: bool = False

    def __post_init__(self) -> None:
        if self.atlas != "auto" and not 16 <= self.atlas <= 16384:
            raise input_error("infer", "atlas", self.atlas, "auto, or a side in [16, 16384]", "correct it")


@dataclass
class InferReport:
    """What was done. ``seconds`` by stage, and ``memory_mb``, the peak of the process's resident memory up to
    the end of each; ``light`` is a :class:`~model.reconstruction.light.options.LightReport` with the lights
    that were found, empty where none were sought; ``warnings`` name views where they concern one;
    ``radiometry`` is what :mod:`~model.reconstruction.radiometry` found, ``poses`` how far they were mended,
    empty where that was not asked for; ``albedo_level`` is a
    :class:`~model.reconstruction.level.albedo_level.LevelReport`, empty where none was
    sought."""

    name: str = ""
    num_views: int = 0
    num_triangles: int = 0
    atlas_size: int = 0
    seen_share: float = 0.0
    seen_of_visible: float = 0.0
    exposure: float = 0.0
    unwrap: dict[str, Any] = field(default_factory=dict)
    precision: str = ""
    is_filtered: bool = False
    radiometry: dict[str, Any] = field(default_factory=dict)
    poses: dict[str, Any] = field(default_factory=dict)
    albedo_level: dict[str, Any] = field(default_factory=dict)
    light: dict[str, Any] = field(default_factory=dict)
    gltf_error: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    memory_mb: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time inside to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            self.memory_mb[name] = round(peak_mb(), 1)

    def table(self) -> str:
        """The stages, their seconds and the memory, those of the light stage by step, and the lights that
        were found, for the end of a run."""
        lines = []
        for name, seconds, share, memory in self.costs():
            lines.append(f"{name:<14}{seconds:>8.1f} s{share:>8.0%}{memory:>10.0f} MB")
        if "lights" in self.light:
            lines += ["", lights_text(self.light["lights"])]
        return "\n".join(lines)

    def costs(self) -> list[tuple[str, float, float, float]]:
        """(name, seconds, share of all, peak memory in MB so far) of every stage, of the steps of the light
        stage, indented, and of all."""
        total = sum(self.seconds.values())
        memory = max(self.memory_mb.values(), default=0.0)
        rows = []
        for name, seconds in [*self.seconds.items(), ("total", total)]:
            rows.append((name, seconds, seconds / max(total, 1e-9), self.memory_mb.get(name, memory)))
            if name == "light":
                steps, of_step = self.light.get("seconds", {}), self.light.get("memory_mb", {})
                rows += [(f"  {k}", v, v / max(total, 1e-9), of_step[k]) for k, v in steps.items()]
        return rows
