# SPDX-License-Identifier: MIT
"""Loops compiled by Numba, and the threads that run them.

Compiled functions release Python's lock: threads of a pool run them side by side on tiles of their own, so
that Numba needs no threading layer beside those of torch and Mitsuba. Compiling takes seconds; the result is
kept beside the source or, where that cannot be written, in the user's cache (``NUMBA_CACHE_DIR`` names
another place). A function's cache is renewed when its own module changes; after a change of a
function that another module's loop calls, remove the ``__pycache__``.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """``function`` as machine code; float32 stays float32, and x / 0 is Inf as in NumPy."""
    made: Any
    try:
        made = numba.njit(function, cache=True, nogil=True, error_model="numpy")
    except RuntimeError:  # no folder for a cache can be written: each process compiles for itself
        made = numba.njit(function, nogil=True, error_model="numpy")
    return made


def num_threads() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
