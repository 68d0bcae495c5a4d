# SPDX-License-Identifier: MIT
"""Signals that stop training."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def stop_signals(request: Callable[[], None]) -> Iterator[None]:
    """Context in which SIGINT and SIGTERM call ``request``; the first one restores SIGINT's old handler."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    try:
        earlier = {number: signal.getsignal(number) for number in numbers}

        def handle(number: int, frame: Any) -> None:
            request()
            signal.signal(signal.SIGINT, earlier[signal.SIGINT])

        for number in numbers:
            signal.signal(number, handle)
    except ValueError:  # not in the main thread, the only one that can set signal handlers
        yield
        return
    try:
        yield
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)
