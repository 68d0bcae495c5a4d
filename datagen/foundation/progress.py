# SPDX-License-Identifier: MIT
"""Progress of commands on standard error, durations as text, and the console for tables."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

Progress = Callable[[str, int, int], None]
"""Function of (stage, finished steps, total steps), such as :meth:`Bars.tell`."""

Advance = Callable[[int, int], None]
"""Function of (finished steps, total steps) of one stage."""

SILENCE_S = 30.0
_UNBOUNDED = 100_000  # width in characters; tables and lines use only as much as they need


def no_advance(done: int, total: int) -> None:
    """Show nothing; an :data:`Advance` for callers without a progress display."""


def duration(seconds: float) -> str:
    """Return a duration as text, such as "90 s", "45 min" or "2.5 h"."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def table_console() -> Console:
    """Return a console on standard output that prints square brackets as text, not as styles.

    It is as wide as the terminal; lines to a pipe or a file are neither cut nor wrapped.
    """
    from rich.console import Console

    console = Console(markup=False)
    return console if console.is_terminal else Console(width=_UNBOUNDED, markup=False)


class Bars:
    """Context manager that shows the progress of stages: on a terminal, bars with rate and time left.

    Without a terminal, as in the log of a job, it prints a line every 30 seconds, at each change of stage and
    at the end. ``unit`` names the counted items. With ``is_transient``, the bar of a stage disappears when
    the next one begins; with ``is_quiet``, nothing is shown.
    """

    def __init__(self, unit: str = "", *, is_transient: bool = False, is_quiet: bool = False):
        from rich.console import Console

        self.unit, self.is_transient, self.is_quiet = unit, is_transient, is_quiet
        self._console = Console(stderr=True)
        self._bars: Any = None
        self._tasks: dict[str, Any] = {}
        self._first: dict[str, tuple[int, float]] = {}  # stage -> steps already done at its first report
        self._stage, self._line, self._printed_at = "", "", time.monotonic()

    def __enter__(self) -> Bars:
        if not self.is_quiet and self._console.is_terminal:
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            self._bars = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn(self.unit),
                TextColumn("{task.fields[rate]}"),
                TimeRemainingColumn(elapsed_when_finished=True),
                TextColumn("{task.fields[note]}"),
                console=self._console,
                transient=self.is_transient,
                refresh_per_second=4,
            )
            self._bars.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bars is None:
            if exception[0] is None and self._line:
                self._print_line()
            return
        if exception[0] is not None:  # a stalled bar would distract from the error
            for task in self._bars.tasks:
                self._bars.update(task.id, visible=task.finished)
        self._bars.stop()

    def tell(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Show ``done`` of ``total`` steps of a stage; the rate excludes steps done before the first call."""
        if self.is_quiet:
            return
        now = time.monotonic()
        first, begun = self._first.setdefault(stage, (done, now))
        rate = f"{(done - first) / (now - begun) * 3600:,.0f}/h" if done > first and now > begun else ""
        if self._bars is None:
            counted = f"{done} of {total} {self.unit}".rstrip()
            is_next = self._stage not in ("", stage)
            self._stage = stage
            self._line = f"{stage}: {', '.join(text for text in (counted, rate, note) if text)}"
            if is_next or now - self._printed_at >= SILENCE_S:
                self._print_line()
            return
        if stage not in self._tasks:
            if self.is_transient:
                for task in self._tasks.values():
                    self._bars.remove_task(task)
                self._tasks.clear()
            self._tasks[stage] = self._bars.add_task(stage, total=total, completed=done, rate="", note="")
        self._bars.update(self._tasks[stage], completed=done, total=total, rate=rate, note=note)

    def _print_line(self) -> None:
        self.say(f"{time.strftime('%H:%M:%S')} {self._line}")
        self._line, self._printed_at = "", time.monotonic()

    def say(self, text: str) -> None:
        """Print a line, above any bars, unless ``is_quiet``."""
        if not self.is_quiet:
            self._console.print(text, highlight=False, markup=False, soft_wrap=True)
