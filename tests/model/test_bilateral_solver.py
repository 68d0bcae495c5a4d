# SPDX-License-Identifier: MIT
"""The bilateral solver against a dense solve; its adjoint, batches, and effect on images."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from model.bilateral_solver import SolverConfig, bilateral_solve, build_grid, guide_yuv, solve
from oracles import bilateral_dense

pytestmark = pytest.mark.filterwarnings("ignore:Sparse CSR tensor support is in beta")
EXACT = SolverConfig(sigma_xy=4.0, sigma_luma=16.0, sigma_chroma=12.0, tolerance=1e-13, max_iterations=2000)


def _images(height: int, width: int, channels: int = 2, seed: int = 0, batch: int = 1) -> list[torch.Tensor]:
    """Random float64 guide of a few flat regions with noise, target and confidence."""
    generator = torch.Generator().manual_seed(seed)

    def rand(c: int, h: int, w: int) -> torch.Tensor:
        return torch.rand(batch, c, h, w, generator=generator, dtype=torch.float64)

    guide = torch.nn.functional.interpolate(rand(3, 2, 3), size=(height, width)) + 0.05 * rand(
        3, height, width
    )
    return [guide, rand(channels, height, width), rand(channels, height, width)]


def test_agrees_with_a_dense_solve():
    guide, target, confidence = _images(13, 18)
    grid = build_grid(guide, EXACT)
    got = bilateral_solve(target, confidence, grid, EXACT)
    dense = bilateral_dense.build(guide[0].permute(1, 2, 0).numpy(), 4.0, 16.0, 12.0, 300.0)
    assert dense.splat.shape[0] == grid.num_vertices > 20
    for channel in range(2):
        t, c = (image[0, channel].numpy().ravel() for image in (target, confidence))
        np.testing.assert_allclose(got[0, channel].numpy().ravel(), dense.solve(t, c), atol=1e-9)


def test_a_wrong_smoothness_is_detected():
    guide, target, confidence = _images(13, 18)
    got = bilateral_solve(target, confidence, build_grid(guide, EXACT), EXACT)
    dense = bilateral_dense.build(guide[0].permute(1, 2, 0).numpy(), 4.0, 16.0, 12.0, 300.0 * 1.05)
    t, c = (image[0, 0].numpy().ravel() for image in (target, confidence))
    assert np.abs(got[0, 0].numpy().ravel() - dense.solve(t, c)).max() > 1e-5


def test_adjoint_by_gradcheck():
    guide, target, confidence = _images(5, 7, channels=1)
    grid = build_grid(guide, EXACT)
    inputs = (target.requires_grad_(), (0.2 + confidence).requires_grad_())
    assert torch.autograd.gradcheck(lambda t, c: bilateral_solve(t, c, grid, EXACT), inputs)


def test_one_confidence_for_all_channels_gets_the_sum_of_the_gradients():
    guide, target, confidence = _images(8, 8, channels=3)
    grid = build_grid(guide, EXACT)
    single = confidence[:, :1].clone().requires_grad_()
    bilateral_solve(target, single, grid, EXACT).square().sum().backward()
    tiled = confidence[:, :1].repeat(1, 3, 1, 1).requires_grad_()
    bilateral_solve(target, tiled, grid, EXACT).square().sum().backward()
    torch.testing.assert_close(single.grad, tiled.grad.sum(dim=1, keepdim=True))


def test_a_batch_equals_its_single_images():
    guide, target, confidence = _images(16, 20, batch=3)
    together = bilateral_solve(target, confidence, build_grid(guide, EXACT), EXACT)
    for k in range(3):
        alone = bilateral_solve(
            target[k : k + 1], confidence[k : k + 1], build_grid(guide[k : k + 1], EXACT), EXACT
        )
        torch.testing.assert_close(together[k : k + 1], alone, rtol=0, atol=1e-10)


def test_smooths_within_regions_and_keeps_their_edges():
    """Noise on two flat regions is removed, but the step between them in the guide is kept."""
    generator = torch.Generator().manual_seed(3)
    truth = torch.zeros(1, 1, 64, 64)
    truth[..., 32:] = 0.8
    guide = (0.2 + truth).expand(1, 3, 64, 64)
    noisy = truth + 0.1 * torch.randn(1, 1, 64, 64, generator=generator)
    filtered = bilateral_solve(noisy, torch.ones(1, 1, 64, 64), build_grid(guide))
    before, after = ((image - truth).square().mean().sqrt() for image in (noisy, filtered))
    assert after < 0.1 * before
    assert (filtered[..., 33:].mean() - filtered[..., :31].mean()) > 0.79


def test_uncertain_pixels_take_the_value_of_certain_ones():
    truth = torch.full((1, 1, 32, 32), 0.5)
    target = truth.clone()
    target[..., 8:24, 8:24] = 1.0
    confidence = (target == truth).float()
    filtered = bilateral_solve(target, confidence, build_grid(torch.ones(1, 3, 32, 32)))
    assert (filtered - truth).abs().max() < 1e-3


def test_a_constant_stays_constant_and_zero_confidence_is_finite():
    guide, _, confidence = _images(32, 32)
    grid = build_grid(guide)
    constant = torch.full((1, 2, 32, 32), 0.37)
    for c in (confidence, torch.zeros_like(confidence)):
        filtered = bilateral_solve(constant, c.float(), grid)
        torch.testing.assert_close(filtered, constant, rtol=0, atol=1e-5)
    unsure = torch.zeros(1, 2, 32, 32, requires_grad=True)
    bilateral_solve(torch.rand(1, 2, 32, 32), unsure, grid).sum().backward()
    assert torch.isfinite(unsure.grad).all()


def test_float32_input_gives_the_same_result():
    guide, target, confidence = _images(48, 64)
    grid = build_grid(guide, EXACT)
    double = bilateral_solve(target, confidence, grid, EXACT)
    single = bilateral_solve(target.float(), confidence.float(), grid, EXACT)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), double, rtol=0, atol=1e-6)


def test_more_iterations_come_closer():
    guide, target, confidence = _images(96, 128, channels=1)
    grid = build_grid(guide)
    columns = [image.reshape(-1, 1) for image in (target, confidence)]
    weights, rhs = grid.splat(columns[1]), grid.splat(columns[1] * columns[0])
    residuals = []
    for iterations in (5, 10, 25, 100):
        config = SolverConfig(max_iterations=iterations, tolerance=0.0)
        residuals.append(solve(grid, config, weights, rhs, rhs / weights)[1])
    assert residuals == sorted(residuals, reverse=True)
    assert residuals[2] < 0.2 * residuals[0]


def test_guide_is_scaled_by_its_maximum():
    guide = torch.rand(2, 3, 4, 4, dtype=torch.float64)
    torch.testing.assert_close(guide_yuv(guide), guide_yuv(guide * 7.3))
    white = guide_yuv(torch.ones(1, 3, 1, 1, dtype=torch.float64))
    torch.testing.assert_close(white.flatten(), torch.tensor([255.0, 128.0, 128.0], dtype=torch.float64))
    assert build_grid(torch.zeros(1, 3, 16, 16)).num_vertices == 4


def test_scaling_the_target_scales_the_result():
    """The result is proportional to the target, even for very small values."""
    guide, target, confidence = _images(24, 32)
    grid = build_grid(guide)
    whole = bilateral_solve(target, confidence, grid)
    small = bilateral_solve(1e-12 * target, confidence, grid)
    torch.testing.assert_close(1e12 * small, whole, rtol=0, atol=1e-6)


def test_the_confidence_weighted_sum_is_kept():
    """The confidence-weighted sums of result and target are equal, so that the gradient of this sum with
    respect to the target is the confidence, even after one iteration."""
    guide, target, confidence = _images(24, 32)
    target.requires_grad_()
    filtered = bilateral_solve(target, confidence, build_grid(guide), SolverConfig(max_iterations=1))
    (confidence * filtered).sum().backward()
    torch.testing.assert_close(target.grad, confidence, rtol=0, atol=1e-9)


def test_zero_targets_need_no_iterations():
    grid = build_grid(_images(24, 32)[0])
    zero = torch.zeros(grid.num_vertices, 2, dtype=torch.float64)
    y, residual = solve(grid, SolverConfig(), torch.ones_like(zero), zero, zero)
    assert y is zero and (y == 0).all() and residual == 0.0  # without an iteration


def test_a_target_of_another_size_is_refused():
    grid = build_grid(torch.rand(1, 3, 16, 16))
    with pytest.raises(ValueError, match="does not fit"):
        bilateral_solve(torch.rand(1, 1, 16, 17), torch.ones(1, 1, 16, 17), grid)


def test_warnings_of_torch_are_suppressed():
    """Torch warns about sparse matrices once per process, so this runs in a separate process."""
    code = (
        "import torch; from model.bilateral_solver import SolverConfig, bilateral_solve, build_grid\n"
        "image = torch.rand(1, 3, 8, 8); grid = build_grid(image, SolverConfig())\n"
        "print(bilateral_solve(image, image, grid, SolverConfig()).shape)"
    )
    done = subprocess.run([sys.executable, "-W", "default", "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "torch.Size([1, 3, 8, 8])\n"), done.stderr
    assert "Warning" not in done.stderr
