# SPDX-License-Identifier: MIT
"""Recording of kernels (``dr.freeze``) with Python's garbage collector suspended."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def undisturbed() -> Iterator[None]:
    """Suspend Python's garbage collector in this context.

    Dr.Jit aborts the process ("enqueue_host_func(): this function cannot be recorded") if an array in NumPy's
    memory is freed while a function is recorded. Unlike reference counting, the collector may free arrays of
    an earlier scene at any time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
