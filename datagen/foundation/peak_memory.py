# SPDX-License-Identifier: MIT
"""Resources used by this process since a moment: peak memory and processor time."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def forget_peak() -> None:
    """Start anew; where the system cannot, the process's peak stands."""
    with suppress(OSError):
        _CLEAR.write_text("5")


def peak_mb() -> float:
    """Peak of resident memory since then in MB."""
    with suppress(OSError):
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    return process_peak_mb()


def process_peak_mb() -> float:
    """Peak of resident memory since the process began in MB."""
    if sys.platform == "win32":  # has no module `resource`
        import psutil

        return psutil.Process().memory_info().peak_wset / 2**20
    import resource

    unit = 2**20 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def processor_s() -> float:
    """Seconds that cores have worked for this process and for those that it started and that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
