# SPDX-License-Identifier: MIT
"""A process that has imported what takes long, and runs each call of pytest in a fork of itself.

Reads one JSON object a line: ``arguments`` of pytest, ``environment`` to add, ``timeout_s`` and the file for
its ``output``; answers with the exit code, negative where a signal ended it. Modules of the project are
imported by the fork alone.
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

# Nothing here starts threads when it is imported, which a fork would lose.
LIBRARIES = (
    "pytest", "hypothesis", "numpy", "scipy.ndimage", "scipy.sparse", "pydantic", "yaml", "torch", "numba",
    "trimesh", "psutil", "OpenEXR",
)  # fmt: skip
_LOOK_S = 0.02


def serve() -> None:
    """Answer until the input ends."""
    for name in LIBRARIES:
        with suppress(ImportError):  # an optional one
            importlib.import_module(name)
    for line in sys.stdin:
        request = json.loads(line)
        process = os.fork()
        if process == 0:
            _run(request)
        print(_wait(process, request["timeout_s"]), flush=True)


def _run(request: dict[str, Any]) -> None:
    os.setsid()
    output = os.open(request["output"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for descriptor in (1, 2):
        os.dup2(output, descriptor)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.environ.update(request["environment"])
    sys.dont_write_bytecode = True
    import pytest

    code = int(pytest.main(request["arguments"]))
    sys.stdout.flush()
    os._exit(code)


def _wait(process: int, timeout_s: float) -> int:
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(_LOOK_S)
    os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return -int(signal.SIGKILL)


if __name__ == "__main__":
    serve()
