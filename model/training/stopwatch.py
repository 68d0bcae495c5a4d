# SPDX-License-Identifier: MIT
"""Measurement of the time of each part of a training step."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class Stopwatch:
    """Total seconds by section. With a CUDA ``device``, sections wait for the GPU, which slows training."""

    def __init__(self, device: torch.device | None = None):
        self.seconds: dict[str, float] = {}
        self._synchronize = device is not None and device.type == "cuda"

    @contextmanager
    def section(self, name: str) -> Iterator[None]:
        """Context whose duration is added to the seconds of ``name``."""
        start = self._now()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + self._now() - start

    def take(self) -> dict[str, float]:
        """Return the seconds by section since the previous call."""
        taken, self.seconds = self.seconds, {}
        return taken

    def _now(self) -> float:
        if self._synchronize:
            torch.cuda.synchronize()
        return time.perf_counter()
