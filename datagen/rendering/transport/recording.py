# SPDX-License-Identifier: MIT
"""Recording of kernels (``dr.freeze``) without Python's garbage collector in between."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def undisturbed() -> Iterator[None]:
    """No garbage is collected inside.

    Dr.Jit ends the process ("enqueue_host_func(): this function cannot be recorded") where an array that
    stands on NumPy's memory comes to its end while a function is recorded. References that fall do not do
    that here; the collector may at any time, for the arrays of a scene that is long out of use.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
