# SPDX-License-Identifier: MIT
"""relMSE: its definition, its unbiased estimate from two references, and its independence of exposure."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.rendering.error import EPSILON, relative_mse, relative_mse_of_parts


def images(noise: float, count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(4)
    truth = rng.uniform(0.0, 2.0, (256, 256, 3))
    return [truth, *(truth + noise * rng.standard_normal(truth.shape) for _ in range(count))]


def test_rel_mse_follows_its_definition() -> None:
    reference = np.array([[[0.0, 1.0, 2.0]]])
    image = reference + 0.1
    expected = np.mean([0.01 / (r * r + EPSILON) for r in (0.0, 1.0, 2.0)])
    assert relative_mse(image, reference) == pytest.approx(expected)
    assert relative_mse(reference, reference) == 0.0


def test_two_noisy_references_leave_no_bias() -> None:
    truth, first, second, image = images(0.02, 3)
    exact = relative_mse(image, truth)
    assert relative_mse(image, first, second) == pytest.approx(exact, rel=0.05)
    assert relative_mse(image, first) > 1.5 * exact  # a single reference adds its noise


def test_exposed_error_does_not_depend_on_the_brightness_of_the_lights() -> None:
    truth, image = images(0.1, 1)
    dim = relative_mse(0.01 * image, 0.01 * truth, exposed=True)
    assert dim == pytest.approx(relative_mse(image, truth, exposed=True), rel=1e-6)
    assert relative_mse(0.01 * image, 0.01 * truth) < 0.1 * dim


@pytest.mark.parametrize("probability", [0.5, 0.05], ids=["dense", "fireflies"])
def test_standard_error_is_the_spread_of_the_estimates(probability: float) -> None:
    rng = np.random.default_rng(6)
    truth = rng.uniform(0.5, 1.0, (16, 16, 3))
    image = truth + 0.05 * rng.standard_normal(truth.shape)
    estimates = []
    for _ in range(300):
        hits = rng.binomial(1, probability, (4, 16, 16, 1)) / probability
        estimates.append(relative_mse_of_parts(image, list(truth * (0.7 + 0.3 * hits))))
    errors, standard_errors = np.array(estimates).T
    assert np.sqrt(np.mean(standard_errors**2)) == pytest.approx(errors.std(), rel=0.15)
