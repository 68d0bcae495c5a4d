# SPDX-License-Identifier: MIT
"""Results that one process of a test run computes and the other processes read from a file."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

_Result = TypeVar("_Result")
_FOLDERS: list[Path] = []


def keep_in(folder: Path) -> None:
    """Keep results in ``folder``, which must be the same for all processes of the test run."""
    folder.mkdir(exist_ok=True)
    _FOLDERS[:] = [folder]


def once(name: str, make: Callable[[], _Result], folder: Path | None = None) -> _Result:
    """Return ``make()``, called by the first process that requests ``name``; others wait and read a copy.

    ``folder`` defaults to that of :func:`keep_in`. Outside a test run, or without file locks (Windows), each
    process calls ``make``.
    """
    folder = folder or next(iter(_FOLDERS), None)
    if sys.platform == "win32" or folder is None:
        return make()
    import fcntl

    path = folder / f"{name}.pickle"
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if path.is_file():
            return pickle.loads(path.read_bytes())  # type: ignore[no-any-return]
        result = make()
        part = path.with_suffix(".part")
        part.write_bytes(pickle.dumps(result))
        part.replace(path)
    return result
