# SPDX-License-Identifier: MIT
"""The training loss: zero at the truth, finite gradients, masks, phases and reproducible draws."""

from __future__ import annotations

import pytest
import torch

from model.training.conditions import Geometry, SampleDraws, generator_for
from model.training.losses import LossConfig, MaterialLoss, encode_log_unit
from model.training.perceptual import GradientSsim


def _draws(seed: int) -> SampleDraws:
    return SampleDraws.for_samples(seed, range(2))


@pytest.fixture
def scene() -> tuple[dict[str, torch.Tensor], Geometry]:
    """Two crops of a tilted plane with smooth random materials; the top rows of the second are empty."""
    generator = torch.Generator().manual_seed(0)
    size = 32

    def smooth(channels: int) -> torch.Tensor:
        small = torch.rand(2, channels, 6, 6, generator=generator)
        return torch.nn.functional.interpolate(small, size=(size, size), mode="bilinear")

    truth = {"diffuse_albedo": smooth(3), "specular_albedo": 0.2 * smooth(3), "roughness": smooth(1)}
    y, x = torch.meshgrid(torch.linspace(-0.5, 0.5, size), torch.linspace(-0.5, 0.5, size), indexing="ij")
    normal = torch.nn.functional.normalize(torch.tensor([0.1, -0.2, -1.0]), dim=0).reshape(1, 3, 1, 1)
    z = 3.0 / (1.0 - 0.1 * x + 0.2 * y)
    mask = torch.ones(2, 1, size, size, dtype=torch.bool)
    mask[1, :, :10] = False
    position = torch.stack([x * z, y * z, z]).unsqueeze(0) * mask
    return truth, Geometry(position, normal * mask, mask)


def test_the_truth_has_zero_loss(scene):
    truth, geometry = scene
    terms = MaterialLoss(LossConfig(), GradientSsim())(truth, truth, geometry, _draws(1), generator_for(1))
    assert float(terms.total) == pytest.approx(0.0, abs=1e-5)
    assert set(terms.parts) == {
        "render_l1",
        "render_perceptual",
        *(f"{n}_{kind}" for n in truth for kind in ("l1", "perceptual")),
    }


@pytest.mark.parametrize("name", ["diffuse_albedo", "specular_albedo", "roughness"])
def test_gradients_move_each_map_towards_the_truth(scene, name):
    """Gradients are finite and vanish where there is no surface, and a step against them lowers the loss."""
    truth, geometry = scene
    loss = MaterialLoss(LossConfig(), GradientSsim())
    generator = torch.Generator().manual_seed(4)
    wrong = (
        (truth[name] + 0.2 * torch.rand(truth[name].shape, generator=generator)).clamp(0, 1).requires_grad_()
    )
    before = loss({**truth, name: wrong}, truth, geometry, _draws(2), generator_for(2)).total
    before.backward()
    gradient = wrong.grad
    assert torch.isfinite(gradient).all()
    assert (gradient[~geometry.mask.expand_as(gradient)] == 0).all()
    stepped = (wrong - 0.02 * gradient.sign()).detach()
    after = loss({**truth, name: stepped}, truth, geometry, _draws(2), generator_for(2)).total
    assert after < before


def test_a_phase_predicts_some_maps_and_is_given_the_rest(scene):
    truth, geometry = scene
    diffuse = {"diffuse_albedo": truth["diffuse_albedo"] * 0.5}
    terms = MaterialLoss(LossConfig(), None)(diffuse, truth, geometry, _draws(3), generator_for(3))
    assert set(terms.parts) == {"render_l1", "diffuse_albedo_l1"}
    expected = terms.parts["render_l1"] + 0.1 * terms.parts["diffuse_albedo_l1"]
    torch.testing.assert_close(terms.total, expected)


def test_pixels_without_surface_do_not_count(scene):
    truth, geometry = scene
    loss = MaterialLoss(LossConfig(), GradientSsim())
    spoilt = {n: torch.where(geometry.mask, m, torch.full_like(m, 0.9)) for n, m in truth.items()}
    assert float(loss(spoilt, truth, geometry, _draws(1), generator_for(1)).total) == pytest.approx(
        0.0, abs=1e-5
    )


def test_draws_come_from_the_generator(scene):
    truth, geometry = scene
    predicted = {n: m * 0.8 for n, m in truth.items()}
    loss = MaterialLoss(LossConfig(), GradientSsim())
    totals = [loss(predicted, truth, geometry, _draws(k), generator_for(9)).total for k in (0, 0, 1)]
    assert torch.equal(totals[0], totals[1])
    assert not torch.equal(totals[0], totals[2])


def test_the_loss_has_the_name_of_its_distance():
    assert MaterialLoss(LossConfig(), GradientSsim()).name == "l1+gradient-ssim-3"
    assert MaterialLoss(LossConfig(perceptual_weight=0.0), GradientSsim()).name == "l1+none"


def test_squared_errors_lead_to_the_mean(scene):
    """For rare metal the best constant under L1 is the median, under squared errors the mean."""
    truth, geometry = scene
    metal = torch.rand(truth["roughness"].shape, generator=torch.Generator().manual_seed(3)) < 0.1
    specular = torch.where(metal, 0.9, 0.04).expand(-1, 3, -1, -1)
    truth = {**truth, "specular_albedo": specular}
    nothing = {"num_point_lights": 0, "num_area_lights": 0, "perceptual_weight": 0.0}

    def total(value: float, **weights: float) -> float:
        loss = MaterialLoss(LossConfig(**nothing, **weights), None)
        guess = {"specular_albedo": torch.full_like(specular, value)}
        return float(loss(guess, truth, geometry, _draws(1), generator_for(1)).total)

    median, mean = 0.04, float(specular[geometry.mask.expand_as(specular)].mean())
    assert total(median, map_l1_weight=1.0) < total(mean, map_l1_weight=1.0)
    assert total(mean, map_l1_weight=0.0, map_l2_weight=1.0) < total(
        median, map_l1_weight=0.0, map_l2_weight=1.0
    )
    assert MaterialLoss(LossConfig(**nothing, map_l2_weight=1.0), None).name == "l1+l2+none"


def test_metal_weighs_as_configured(scene):
    """Squared errors of pixels with a true S above 0.2 are scaled, in all maps alike."""
    truth, geometry = scene
    is_metal = torch.arange(32) < 16
    truth = {**truth, "specular_albedo": torch.where(is_metal, 0.8, 0.04).expand(2, 3, 32, 32)}
    found = {name: values + torch.where(is_metal, 0.2, 0.1) for name, values in truth.items()}
    nothing = {"num_point_lights": 0, "num_area_lights": 0, "perceptual_weight": 0.0, "map_l1_weight": 0.0}

    def total(weight: float) -> float:
        config = LossConfig(**nothing, map_l2_weight=1.0, metal_weight=weight)
        return float(MaterialLoss(config, None)(found, truth, geometry, _draws(1), generator_for(1)).total)

    shown = float(geometry.mask.float().mean())  # pixels without surface have no error
    for weight in (0.0, 0.3, 1.0):
        assert total(weight) == pytest.approx(3 * shown * (weight * 0.04 + 0.01) / 2, rel=1e-4)


@pytest.mark.parametrize(("count", "calls"), [(None, 6 + 3), (2, 2 + 3), (0, 3)])
def test_the_perceptual_term_may_use_fewer_re_renderings(scene, count, calls):
    class Counter(torch.nn.Module):
        name = "counter"
        num_calls = 0

        def forward(self, image, reference, generator):
            self.num_calls += 1
            return (image - reference).abs().mean(dim=(1, 2, 3))

    truth, geometry = scene
    counter = Counter()
    loss = MaterialLoss(LossConfig(num_perceptual_renders=count), counter)
    terms = loss({n: m * 0.7 for n, m in truth.items()}, truth, geometry, _draws(1), generator_for(1))
    assert counter.num_calls == calls
    assert ("render_perceptual" in terms.parts) == (count != 0)


def test_log_encoding_has_the_documented_range():
    ends = encode_log_unit(torch.tensor([0.0, 1.0, 50.0]))
    torch.testing.assert_close(ends, torch.tensor([0.0, 1.0, 1.0]))
