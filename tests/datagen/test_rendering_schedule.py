# SPDX-License-Identifier: MIT
"""The schedule of views: order of results, concurrent views, and failures; without rendering."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from datagen.rendering.schedule import MAX_IN_FLIGHT, Steps, interleaved


def job(
    index: int, num_waits: int, pool: ThreadPoolExecutor, log: list[str], fails: bool = False
) -> Steps[int]:
    log.append(f"begin {index}")
    for _ in range(num_waits):
        future = pool.submit(lambda: 1)
        yield future
        future.result()
    if fails:
        raise ValueError(f"view {index}")
    log.append(f"end {index}")
    return index


@pytest.mark.parametrize("waits", [[1, 1, 1, 1], [5, 1, 1, 1], [1, 4, 1, 2]])
def test_results_come_in_order_and_few_views_are_in_flight(waits: list[int]) -> None:
    log: list[str] = []
    with ThreadPoolExecutor(1) as pool:
        assert list(interleaved(job(k, n, pool, log) for k, n in enumerate(waits))) == [0, 1, 2, 3]
    in_flight = 0
    for entry in log:
        in_flight += 1 if entry.startswith("begin") else -1
        assert in_flight <= MAX_IN_FLIGHT


def test_a_view_is_traced_while_another_waits() -> None:
    """The first view waits for the second to begin, which times out if views run one at a time."""
    has_begun = threading.Event()

    def first(pool: ThreadPoolExecutor) -> Steps[str]:
        future = pool.submit(has_begun.wait, 10.0)
        yield future
        return "in time" if future.result() else "late"

    def second(pool: ThreadPoolExecutor) -> Steps[str]:
        has_begun.set()
        yield pool.submit(lambda: None)
        return "second"

    with ThreadPoolExecutor(1) as pool:
        assert list(interleaved([first(pool), second(pool)])) == ["in time", "second"]


def test_a_failure_ends_the_schedule_after_earlier_results() -> None:
    with ThreadPoolExecutor(1) as pool:
        views = interleaved(job(k, 1, pool, [], fails=k == 1) for k in range(3))
        assert next(views) == 0
        with pytest.raises(ValueError, match="view 1"):
            next(views)


def test_no_views_give_no_results() -> None:
    assert list(interleaved(())) == []
