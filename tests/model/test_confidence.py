# SPDX-License-Identifier: MIT
"""Confidence networks: ranges, sizes, and training with wrong predictions."""

from __future__ import annotations

import pytest
import torch

from model.bilateral_solver import SolverConfig
from model.confidence import FILTERED_MAPS, ConfidenceNet, ConfidenceNets, filter_maps
from model.training.losses import confidence_loss

pytestmark = pytest.mark.filterwarnings("ignore:Sparse CSR tensor support is in beta")


def _scene(size: int = 32) -> tuple[torch.Tensor, dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Image, true maps, and predicted maps, which are wrong at two bright highlights."""
    generator = torch.Generator().manual_seed(0)
    diffuse = torch.nn.functional.interpolate(torch.rand(1, 3, 2, 2, generator=generator), size=(size, size))
    truth = {
        "diffuse_albedo": 0.2 + 0.7 * diffuse,
        "specular_albedo": diffuse.flip(1) * 0.3,
        "roughness": 0.3 + 0.4 * diffuse[:, :1],
    }
    highlight = torch.zeros(1, 1, size, size)
    highlight[..., 4:12, 4:12] = 1.0
    highlight[..., 20:26, 18:30] = 1.0
    image = (truth["diffuse_albedo"] - 0.5 + highlight).clamp(-1, 1)
    predicted = {**truth}
    predicted["specular_albedo"] = (truth["specular_albedo"] + 0.5 * highlight).clamp(0, 1)
    predicted["roughness"] = (truth["roughness"] - 0.3 * highlight).clamp(0, 1)
    return image, truth, predicted


@pytest.mark.parametrize("size", [(32, 32), (33, 47), (5, 6)])
def test_confidence_is_in_range_with_maximum_one(size):
    torch.manual_seed(0)
    net = ConfidenceNet(3)
    confidence = net(torch.rand(2, 3, *size), torch.rand(2, 3, *size))
    assert confidence.shape == (2, 1, *size)
    assert (confidence >= 0).all() and (confidence <= 1).all()
    torch.testing.assert_close(confidence.amax(dim=(1, 2, 3)), torch.ones(2))


def test_inputs_are_detached_and_diffuse_albedo_is_not_filtered():
    image, _, predicted = _scene()
    predicted = {n: v.clone().requires_grad_() for n, v in predicted.items()}
    confidences = ConfidenceNets()(image.requires_grad_(), predicted)
    filtered = filter_maps({n: v.detach() for n, v in predicted.items()}, confidences)
    sum(c.sum() for c in confidences.values()).backward()
    assert image.grad is None
    assert all(v.grad is None for v in predicted.values())
    assert torch.equal(filtered["diffuse_albedo"], predicted["diffuse_albedo"])
    assert set(filtered) == {"diffuse_albedo", *FILTERED_MAPS}


def test_training_lowers_confidence_at_highlights():
    """The filtered error falls well below the raw one, and confidence is lower at wrong predictions."""
    torch.manual_seed(1)
    image, truth, predicted = _scene()
    nets = ConfidenceNets()
    mask = torch.ones(1, 1, 32, 32, dtype=torch.bool)
    optimizer = torch.optim.Adam(nets.parameters(), lr=5e-3)
    first = None
    for _ in range(60):
        terms = confidence_loss(nets, image, predicted, truth, mask, SolverConfig())
        optimizer.zero_grad()
        terms.total.backward()
        assert all(torch.isfinite(p.grad).all() for p in nets.parameters() if p.grad is not None)
        optimizer.step()
        first = first if first is not None else float(terms.total.detach())
    for name in FILTERED_MAPS:
        assert terms.parts[f"{name}_filtered_mse"] < 0.2 * terms.parts[f"{name}_raw_mse"]
    assert float(terms.total.detach()) < 0.5 * first
    confidence = nets(image, predicted)["roughness"]
    wrong = (predicted["roughness"] - truth["roughness"]).abs() > 0.1
    assert confidence[wrong].mean() < 0.5 * confidence[~wrong].mean()


def test_pixels_without_surface_do_not_count():
    image, truth, predicted = _scene()
    nets = ConfidenceNets()
    empty = confidence_loss(
        nets, image, predicted, truth, torch.zeros(1, 1, 32, 32, dtype=torch.bool), SolverConfig()
    )
    assert float(empty.total.detach()) == 0.0
