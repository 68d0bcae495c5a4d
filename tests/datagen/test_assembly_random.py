# SPDX-License-Identifier: MIT
"""Random draws depend only on their key and follow the distribution of the method's name."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from scipy import stats

from datagen.foundation.random import Draws, digest


def test_each_key_has_a_distinct_stream() -> None:
    assert Draws(1, 2, "objects").units(5).tolist() == Draws(1, 2, "objects").units(5).tolist()
    keys: list[tuple[int | str, ...]] = [
        (1, 2, "a"),
        (1, 3, "a"),
        (2, 2, "a"),
        (1, 2, "b"),
        ("1", 2, "a"),
        (1, 2, "a", 0),
    ]
    firsts = {Draws(*key).unit() for key in keys}
    assert len(firsts) == len(keys)
    assert digest("a", "bc") != digest("ab", "c")


def test_streams_are_the_raw_bits_of_philox() -> None:
    key = hashlib.sha256(b"int:1:7;str:5:probe;").digest()[:16]
    raw = np.random.Philox(key=int.from_bytes(key, "little")).random_raw(4)
    assert Draws(7, "probe").units(4).tolist() == [(int(r) >> 11) / 2**53 for r in raw]


def test_splitting_draws_does_not_change_them() -> None:
    one, other = Draws(3), Draws(3)
    assert one.units(6).tolist() == [other.unit() for _ in range(6)]


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_distributions_match_and_a_five_percent_error_is_detected(shift: float) -> None:
    draws = Draws(11, "distributions")
    count = 20000
    uniform = [draws.uniform(2.0, 4.0) + 2.0 * shift for _ in range(count)]
    logs = [np.log(draws.log_uniform(0.1, 10.0)) + np.log(100) * shift for _ in range(count)]
    normals = [draws.normal() + shift for _ in range(count)]
    integers = [draws.integer(0, 4) for _ in range(count)]
    integers = [0 if k < shift * count else i for k, i in enumerate(integers)]
    weighted = [draws.weighted("abc", [1, 2, 0]) for _ in range(count)]
    weighted_b = weighted.count("b") * (1 - shift)
    p_values = [
        stats.kstest(uniform, "uniform", args=(2.0, 2.0)).pvalue,
        stats.kstest(logs, "uniform", args=(np.log(0.1), np.log(100))).pvalue,
        stats.kstest(normals, "norm").pvalue,
        stats.chisquare(np.bincount(integers, minlength=5)).pvalue,
        stats.binomtest(round(weighted_b), count, 2 / 3).pvalue,
    ]
    assert "c" not in weighted
    if shift:
        assert max(p_values) < 1e-4
    else:
        assert min(p_values) > 1e-3


def test_sphere_is_uniform_and_unit() -> None:
    directions = Draws(5).sphere(20000)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    for axis in range(3):  # each coordinate is uniform (Archimedes' hat-box theorem)
        assert stats.kstest(directions[:, axis], "uniform", args=(-1, 2)).pvalue > 1e-3


def test_choice_and_shuffle_keep_the_items() -> None:
    items = list("abcdefg")
    assert sorted(Draws(1).shuffled(items)) == items
    draws = Draws(2)
    assert {draws.choice(items) for _ in range(300)} == set(items)
    with pytest.raises(ValueError, match="positive weight"):
        draws.weighted(items, [0.0] * 7)
