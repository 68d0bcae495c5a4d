# SPDX-License-Identifier: MIT
"""The progress bars of the commands, on standard error."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class ProgressBar:
    """A progress bar with the rate of this run and the time left; ``before`` was done by earlier runs."""

    def __init__(self, description: str, total: int, unit: str = "views", before: int = 0):
        self.progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(unit),
            TextColumn("{task.fields[rate]}"),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self.before = before
        self.task = self.progress.add_task(description, total=total, completed=before, rate="")

    def __enter__(self) -> ProgressBar:
        self.progress.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if exception[0] is not None:
            self.progress.update(self.task, visible=False)  # a bar that stands still says less than the error
        self.progress.stop()

    def set(self, done: int) -> None:
        """Move the bar to ``done`` of its total."""
        self.progress.update(self.task, completed=done)
        elapsed_s = self.progress.tasks[0].elapsed
        if elapsed_s and done > self.before:
            rate = (done - self.before) / elapsed_s * 3600
            self.progress.update(self.task, rate=f"{rate:,.0f}/h")

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        self.progress.console.print(text, highlight=False)


class Bars:
    """A progress bar with the time left for each stage, on a terminal's standard error."""

    def __init__(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description:<8}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._tasks: dict[str, Any] = {}

    def __enter__(self) -> Bars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def tell(self, stage: str, done: int, total: int) -> None:
        """Show where a stage is."""
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=total)
        self._progress.update(self._tasks[stage], completed=done)
