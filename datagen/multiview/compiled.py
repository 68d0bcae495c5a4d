# SPDX-License-Identifier: MIT
"""Numba-compiled loops and the threads that run them.

Compiled functions release Python's global interpreter lock: pool threads run them in parallel on separate
tiles, so that Numba needs no threading layer in addition to torch's and Mitsuba's. Compilation takes seconds.
The result is cached beside the source or, if that folder is read-only, in the user's cache
(``NUMBA_CACHE_DIR`` sets another folder). A function's cache is renewed when its own module changes, but not
when it calls a changed function of another module; in that case, remove the ``__pycache__``.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile ``function`` to machine code; float32 stays float32, and x / 0 is Inf as in NumPy."""
    made: Any
    try:
        made = numba.njit(function, cache=True, nogil=True, error_model="numpy")
    except RuntimeError:  # no writable cache folder: each process compiles for itself
        made = numba.njit(function, nogil=True, error_model="numpy")
    return made


def num_threads() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
