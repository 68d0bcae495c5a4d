# SPDX-License-Identifier: MIT
"""Interleaves the rendering of views: one is traced while another is denoised."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from typing import Generic, TypeVar

MAX_IN_FLIGHT = 2
"""Maximum number of views in progress, of which one is traced and one denoised."""

Result = TypeVar("Result")
Steps = Generator[Future, None, Result]
"""Generator that runs a view's steps on the calling thread and yields the future that the next step needs."""


@dataclass
class _InFlight(Generic[Result]):
    """A view in progress and the future that its next step waits for."""

    steps: Steps[Result]
    future: Future
    result: Result | None = None

    def advance(self) -> None:
        """Run the next step; the future must be done."""
        try:
            self.future = next(self.steps)
        except StopIteration as stop:
            self.result = stop.value


def interleaved(views: Iterable[Steps[Result]]) -> Iterator[Result]:
    """Run ``views``, up to ``MAX_IN_FLIGHT`` at a time, and yield their results in order."""
    waiting = iter(views)
    in_flight: list[_InFlight[Result]] = []
    while True:
        steps = next(waiting, None) if len(in_flight) < MAX_IN_FLIGHT else None
        if steps is not None:
            in_flight.append(_InFlight(steps, next(steps)))
            continue
        if not in_flight:
            return
        running = [view for view in in_flight if view.result is None]
        wait([view.future for view in running], return_when=FIRST_COMPLETED)
        next(view for view in running if view.future.done()).advance()
        while in_flight and (result := in_flight[0].result) is not None:
            in_flight.pop(0)
            yield result
