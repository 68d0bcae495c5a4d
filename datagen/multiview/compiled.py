# SPDX-License-Identifier: MIT
"""Numba-compiled loops.

Compiled functions release Python's global interpreter lock, and a thread pool runs them in parallel on
separate parts of the data; Numba thus needs no threading layer in addition to torch's and Mitsuba's.
Compilation takes seconds. Its result is cached next to the source or, if that folder is read-only, in the
user's cache (``NUMBA_CACHE_DIR`` sets another folder). Numba recompiles a function if its module changes, but
not if a function that it calls in another module changes; in that case, remove ``__pycache__``.
"""

from __future__ import annotations

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
