# SPDX-License-Identifier: MIT
"""A process that imports slow modules once, and runs each call of pytest in a fork.

Reads one JSON object per line: ``arguments`` of pytest, ``timeout_s`` and the file for its ``output``;
answers with the exit code, negative after a signal. Only the fork imports modules of the project.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import time
from contextlib import suppress
from typing import Any

import psutil

# no import here may start threads, as a fork has only the calling thread
LIBRARIES = (
    "pytest", "hypothesis", "numpy", "scipy.ndimage", "scipy.sparse", "pydantic", "yaml", "torch", "numba",
    "trimesh", "psutil", "OpenEXR",
)  # fmt: skip
_LOOK_S = 0.05
CLOCK_SHARE = 10.0


def serve() -> None:
    """Answer requests from standard input until its end."""
    for name in LIBRARIES:
        with suppress(ImportError):  # an optional module
            importlib.import_module(name)
    for line in sys.stdin:
        request = json.loads(line)
        process = os.fork()
        if process == 0:
            _run(request)
        print(outcome_of(process, request["timeout_s"]), flush=True)


def _run(request: dict[str, Any]) -> None:
    os.setsid()
    output = os.open(request["output"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for descriptor in (1, 2):
        os.dup2(output, descriptor)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.dont_write_bytecode = True
    import pytest

    code = int(pytest.main(request["arguments"]))
    sys.stdout.flush()
    os._exit(code)


def outcome_of(process: int, timeout_s: float) -> int:
    """Wait for a child process and return its exit code, negative after a signal.

    It is killed after ``timeout_s`` of processor time, which other processes do not affect, or after ten
    times as much wall time, since tests may sleep.
    """
    end = time.monotonic() + CLOCK_SHARE * timeout_s
    while time.monotonic() < end and _processor_s(process) < timeout_s:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(_LOOK_S)
    os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return -int(signal.SIGKILL)


def _processor_s(process: int) -> float:
    """Processor seconds of the process with this id and of its children."""
    total = 0.0
    with suppress(psutil.Error):  # a child ended meanwhile
        top = psutil.Process(process)
        for one in (top, *top.children(recursive=True)):
            total += sum(one.cpu_times()[:4])  # user and system, own and of finished children
    return total


if __name__ == "__main__":
    serve()
