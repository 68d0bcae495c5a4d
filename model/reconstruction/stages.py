# SPDX-License-Identifier: MIT
"""What the stages of ``materials infer`` agree on: the run that they are part of, where maps come from, and
what may happen to them before they are merged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from numpy.typing import NDArray

from model.reconstruction.geometry.views import TracedCapture
from model.reconstruction.infer_options import InferOptions, InferReport, Progress

Maps = dict[str, NDArray]
"""A view's D, S and R by name, (H, W, 3 or 1) in [0, 1], and perhaps ``confidence`` (H, W, 3)."""


@dataclass(frozen=True)
class Run:
    """One run: its folder, what it is told, what it reports, and ``tell(stage, done, total)``."""

    out: Path
    options: InferOptions
    report: InferReport
    tell: Progress


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
