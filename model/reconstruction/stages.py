# SPDX-License-Identifier: MIT
"""What the stages of ``materials infer`` agree on: the run that they are part of, where maps come from, and
what may happen to them before they are merged."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from datagen.geometry.views import TracedCapture
from model.reconstruction.found_lights import FoundLights
from model.reconstruction.infer_options import InferOptions, InferReport, Progress

Maps = dict[str, NDArray]
"""A view's D, S and R by name, (H, W, 3 or 1) in [0, 1], and perhaps ``confidence`` (H, W, 3)."""


@dataclass(frozen=True)
class ViewPicture:
    """A view for the report: its photograph, D, and the confidence of D (H, W, 3), 8 bits."""

    name: str
    photograph: NDArray[np.uint8]
    diffuse_albedo: NDArray[np.uint8]
    confidence: NDArray[np.uint8]


@dataclass
class Found:
    """What stages find beside maps: ``lights``, the ``confidence_at`` points of the surface on the side of
    normals (both (..., 3), the result in bytes of D, S and R), and ``pictures`` of views; ``doubt_at`` points
    (N, 3) with normals (N, 3), the diffuse shading (N,), as luminance, that is not sure because photographs
    clip its source. None and empty where no stage sought them."""

    lights: FoundLights | None = None
    confidence_at: Callable[[NDArray, NDArray], NDArray[np.uint8]] | None = None
    pictures: list[ViewPicture] = field(default_factory=list)
    doubt_at: Callable[[NDArray, NDArray], NDArray[np.float32]] | None = None


@dataclass(frozen=True)
class Run:
    """One run: its folder, what it is told, what it reports, ``tell(stage, done, total)``, and what its
    stages found beside maps."""

    out: Path
    options: InferOptions
    report: InferReport
    tell: Progress
    found: Found = field(default_factory=Found)

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[int, int], None]]:
        """Time a stage, and tell of its begin and end; gives what tells of (done, total) in between."""
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
    """Where the maps of a capture's views come from."""

    @property
    def identity(self) -> str:
        """Tells its maps from those of others: a run in an existing folder continues only with the same."""

    @property
    def is_predicted(self) -> bool:
        """Whether its maps are predictions, which stages before the merge may correct."""

    def prepare(self, options: InferOptions) -> None:
        """Refuse what cannot work, before hours of work. Raises :class:`InputError`."""

    def maps(self, traced: TracedCapture, run: Run) -> list[Maps]:
        """Maps of every view, in the capture's order."""


MapStage = Callable[[TracedCapture, list[Maps], Run], list[Maps]]
"""A stage between prediction and merge: the views' maps in, other maps out; what it is given stays as it
is."""
