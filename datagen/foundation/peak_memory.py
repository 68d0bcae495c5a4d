# SPDX-License-Identifier: MIT
"""Resources of this process: available processors, peak memory and processor time."""

from __future__ import annotations

import os
import resource
import sys
from contextlib import suppress
from pathlib import Path

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def forget_peak() -> None:
    """Reset the peak of :func:`peak_mb`; unsupported systems keep the peak since process start."""
    with suppress(OSError):
        _CLEAR.write_text("5")


def peak_mb() -> float:
    """Return the peak resident memory since :func:`forget_peak`, in MB of 2^20 bytes."""
    with suppress(OSError):
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    return process_peak_mb()


def process_peak_mb() -> float:
    """Return the peak resident memory since process start, in MB of 2^20 bytes."""
    unit = 2**20 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def processor_s() -> float:
    """Return the processor time in seconds of this process and of its finished child processes."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def num_threads() -> int:
    """Return the number of processors that this process may use; batch systems may restrict it."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
