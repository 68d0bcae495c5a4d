# SPDX-License-Identifier: MIT
"""Results that the processes of a test run share."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Barrier, BrokenBarrierError

import numpy as np
import pytest

from tests.once import once


@pytest.mark.skipif(sys.platform == "win32", reason="has no file locks")
def test_a_result_is_made_once(tmp_path: Path) -> None:
    """Of several threads, one makes the result and the others wait; a failed attempt leaves nothing."""
    made, a_second = [], Barrier(2)

    def fail() -> np.ndarray:
        raise OSError("no space")

    def make() -> np.ndarray:
        made.append(1)
        with suppress(BrokenBarrierError):
            a_second.wait(timeout=0.2)
        return np.arange(3.0)

    with pytest.raises(OSError, match="no space"):
        once("numbers", fail, tmp_path)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: once("numbers", make, tmp_path), range(4)))
    assert len(made) == 1
    for numbers in found:
        np.testing.assert_array_equal(numbers, [0, 1, 2])
    once("others", make, tmp_path)
    assert len(made) == 2
