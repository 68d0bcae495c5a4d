# SPDX-License-Identifier: MIT
"""What a run of ``materials infer`` is told, and what it tells."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from datagen.foundation.errors import input_error
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
    alone, or both, the network's as the prior (``light``)."""

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

    def __post_init__(self) -> None:
        if self.atlas != "auto" and not 16 <= self.atlas <= 16384:
            raise input_error("infer", "atlas", self.atlas, "auto, or a side in [16, 16384]", "correct it")


@dataclass
class InferReport:
    """What was done. ``seconds`` by stage; ``warnings`` name views where they concern one;
    ``albedo_level`` is a :class:`~model.reconstruction.level.albedo_level.LevelReport`, empty where none was
    sought."""

    name: str = ""
    num_views: int = 0
    num_triangles: int = 0
    atlas_size: int = 0
    seen_share: float = 0.0
    exposure: float = 0.0
    unwrap: dict[str, Any] = field(default_factory=dict)
    precision: str = ""
    is_filtered: bool = False
    albedo_level: dict[str, Any] = field(default_factory=dict)
    light: dict[str, Any] = field(default_factory=dict)
    gltf_error: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time inside to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def table(self) -> str:
        """The stages and their seconds, for the end of a run."""
        total = sum(self.seconds.values())
        rows = [*self.seconds.items(), ("total", total)]
        return "\n".join(
            f"{name:<12}{seconds:>9.1f} s{seconds / max(total, 1e-9):>8.0%}" for name, seconds in rows
        )
