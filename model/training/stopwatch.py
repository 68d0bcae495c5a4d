# SPDX-License-Identifier: MIT
"""Time of a training step by part."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class Stopwatch:
    """Seconds by name. On a GPU every section waits for the device, so use it for measurements only."""

    def __init__(self, device: torch.device | None = None):
        self.seconds: dict[str, float] = {}
        self._synchronize = device is not None and device.type == "cuda"

    @contextmanager
    def section(self, name: str) -> Iterator[None]:
        """Context whose duration is added to ``name``."""
        start = self._now()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + self._now() - start

    def take(self) -> dict[str, float]:
        """The seconds by name since the previous call."""
        taken, self.seconds = self.seconds, {}
        return taken

    def _now(self) -> float:
        if self._synchronize:
            torch.cuda.synchronize()
        return time.perf_counter()
