# SPDX-License-Identifier: MIT
"""Interfaces of the stages of ``materials infer``: the run, sources of maps, and stages before the merge."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.progress import Advance
from datagen.geometry.views import TracedCapture
from model.reconstruction.found_lights import FoundLights, RadianceSamples
from model.reconstruction.infer_options import InferOptions, InferReport, Progress

Maps = dict[str, NDArray]
"""Maps of a view by name, in [0, 1]: D and S (H, W, 3), R (H, W, 1), optionally ``confidence`` (H, W, 3)."""


@dataclass(frozen=True)
class ViewPicture:
    """Images (H, W, 3) of a view for the report: its photograph, D, and the confidence of D."""

    name: str
    photograph: NDArray[np.uint8]
    diffuse_albedo: NDArray[np.uint8]
    confidence: NDArray[np.uint8]


DoubtAt = Callable[[NDArray, NDArray], NDArray[np.float32]]
"""Function from points and normals (both (N, 3)) to the luminance (N,) of the diffuse shading, irradiance /
pi, that is uncertain because photographs clip its source."""


@dataclass(frozen=True)
class Found:
    """Results of the stages in addition to maps, None or empty if no stage provides them.

    ``samples``: photographed radiance to which the gains of ``lights`` are fitted; ``confidence_at``:
    function from surface points and normals (..., 3) to the confidence (..., 3) of D, S and R, 255 for 1;
    ``pictures``: views for the report.
    """

    lights: FoundLights | None = None
    samples: RadianceSamples | None = None
    confidence_at: Callable[[NDArray, NDArray], NDArray[np.uint8]] | None = None
    pictures: tuple[ViewPicture, ...] = ()


@dataclass(frozen=True)
class Estimate:
    """The maps of every view, in the capture's order, and further results."""

    maps: list[Maps]
    doubt_at: DoubtAt | None = None
    found: Found = Found()


@dataclass(frozen=True)
class Run:
    """A run of ``materials infer``; ``tell(stage, done, total)`` is the callback for its progress."""

    out: Path
    options: InferOptions
    report: InferReport
    tell: Progress

    @contextmanager
    def stage(self, name: str) -> Iterator[Advance]:
        """Time a stage and report its start and end; yield a callback for its progress (done, total)."""
        last = (0, 1)

        def advance(done: int, total: int) -> None:
            nonlocal last
            last = (done, total)
            self.tell(name, done, total)

        with self.report.stage(name):
            advance(*last)
            yield advance
        if last[0] < last[1]:
            advance(last[1], last[1])


class MapSource(Protocol):
    """Source of the maps of a capture's views."""

    @property
    def identity(self) -> str:
        """Hash or name that identifies the maps: a run resumes in its folder only if this is the same."""

    @property
    def is_predicted(self) -> bool:
        """True if the maps are predictions, which stages before the merge may correct."""

    def prepare(self, options: InferOptions) -> None:
        """Check the source before work starts. Raises :class:`InputError` if it is unusable."""

    def maps(self, traced: TracedCapture, run: Run) -> list[Maps]:
        """Return the maps of every view, in the capture's order."""


MapStage = Callable[[TracedCapture, Estimate, Run], Estimate]
"""A stage between prediction and merge: returns a new estimate and leaves its input unchanged."""
