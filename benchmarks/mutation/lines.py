# SPDX-License-Identifier: MIT
"""Records which lines of given files a process executes."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

Lines = set[tuple[str, int]]


class Tracer:
    """Trace function that collects executed lines of ``files`` in ``lines``, and calls ``new`` for each."""

    def __init__(self, files: list[str]):
        self.files = set(files)
        self.lines: Lines = set()
        self.new: Any = None

    def start(self) -> None:
        threading.settrace(self._enter)
        sys.settrace(self._enter)

    def _enter(self, frame: FrameType, event: str, _: Any) -> Any:
        if frame.f_code.co_filename not in self.files:
            return None
        self._note(frame)
        return self._line

    def _line(self, frame: FrameType, event: str, _: Any) -> Any:
        self._note(frame)
        return self._line

    def _note(self, frame: FrameType) -> None:
        place = (frame.f_code.co_filename, frame.f_lineno)
        if place not in self.lines:
            self.lines.add(place)
            if self.new is not None:
                self.new(place)


def trace_child() -> None:
    """Trace this process if a test started it; writes each line at once, as the process may be killed."""
    folder = os.environ.get("MUTATION_CHILDREN")
    if folder:
        file = (Path(folder) / f"{os.getpid()}.txt").open("a")
        tracer = Tracer(os.environ["MUTATION_FILES"].split(":"))

        def write(place: tuple[str, int]) -> None:
            file.write(f"{place[1]}:{place[0]}\n")
            file.flush()

        tracer.new = write
        tracer.start()
