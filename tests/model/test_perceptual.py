# SPDX-License-Identifier: MIT
"""Perceptual distances: LPIPS' published check value, E-LPIPS' transforms and dropout, and gradient SSIM."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from datagen.foundation.errors import InputError
from model.training import perceptual, weights
from model.training.conditions import generator_for


@pytest.fixture(scope="module")
def vgg() -> list[weights.Convolution]:
    try:
        return weights.find_vgg()
    except InputError as error:
        pytest.skip(f"VGG16 weights are absent: {error}")


@pytest.fixture(scope="module")
def elpips(vgg, shared_data) -> perceptual.Elpips:
    return perceptual.Elpips(vgg, weights.load_elpips_heads(shared_data / "weights" / weights.HEADS_FILE))


def test_lpips_has_the_published_value(vgg):
    assert perceptual.lpips_check_value(vgg) == pytest.approx(perceptual.LPIPS_CHECK_VALUE, abs=5e-5)


def test_one_wrong_layer_changes_lpips(vgg):
    wrong = [weights.Convolution(1.05 * vgg[0].weight, vgg[0].bias), *vgg[1:]]
    images = torch.rand(2, 1, 3, 64, 64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    values = [float(perceptual.lpips_vgg(layers, *images)) for layers in (vgg, wrong)]
    assert abs(values[0] - values[1]) > 1e-4


def test_elpips_is_zero_on_equal_images_and_grows_with_the_difference(elpips):
    generator = torch.Generator().manual_seed(0)
    image = torch.nn.functional.interpolate(torch.rand(1, 3, 8, 8, generator=generator), size=(64, 64))
    noise = torch.randn(image.shape, generator=generator)
    distances = [
        elpips(image + strength * noise, image, generator_for(5)).detach() for strength in (0.0, 0.05, 0.2)
    ]
    assert (distances[0] == 0).all()
    assert (distances[1] > 0).all()
    assert (distances[2] > distances[1]).all()
    assert elpips.name == "elpips-vgg16-elpips14"


def test_elpips_is_reproducible_and_its_gradient_finite(elpips):
    generator = torch.Generator().manual_seed(1)
    image, reference = torch.rand(2, 1, 3, 64, 64, generator=generator)
    image = image.requires_grad_()
    first = elpips(image, reference, generator_for(2))
    assert torch.equal(first, elpips(image, reference, generator_for(2)))
    assert not torch.equal(first, elpips(image, reference, generator_for(3)))
    black = torch.zeros(1, 3, 64, 64, requires_grad=True)
    (first.sum() + elpips(black, torch.zeros(1, 3, 64, 64), generator_for(4)).sum()).backward()
    assert torch.isfinite(image.grad).all() and image.grad.abs().sum() > 0
    assert torch.isfinite(black.grad).all()


def test_elpips_in_bfloat16_is_close(elpips):
    images = torch.rand(2, 1, 3, 64, 64, generator=torch.Generator().manual_seed(3))
    exact = elpips(*images, generator_for(1))
    elpips.precision = "bfloat16"
    coarse = elpips(*images, generator_for(1))
    elpips.precision = "float32"
    assert coarse.dtype == torch.float32
    torch.testing.assert_close(coarse, exact, rtol=0.02, atol=0)


def test_lpips_heads_are_a_named_fallback(vgg):
    metric = perceptual.Elpips(vgg, weights.load_lpips_heads())
    assert metric.name == "elpips-vgg16-lpips5"
    assert float(metric(torch.rand(1, 3, 64, 64), torch.rand(1, 3, 64, 64), generator_for(1))) > 0


def test_missing_weights_are_never_replaced_silently(tmp_path, monkeypatch):
    monkeypatch.setenv("SCENE_MATERIALS_WEIGHTS", str(tmp_path))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    with pytest.raises(InputError, match="gradient_ssim"):
        perceptual.make_perceptual("elpips")
    assert perceptual.make_perceptual("gradient_ssim").name == "gradient-ssim-3"


def test_transforms_are_drawn_in_their_ranges():
    scales = []
    for seed in range(200):
        draw = perceptual.sample_transform(4, 256, 320, generator_for(seed))
        scales.append(draw.scale)
        assert all(0 <= o <= perceptual.OFFSET_MAX for pair in draw.offsets for o in pair)
        assert all(o < draw.scale for o in draw.scale_offset)
        assert (draw.gains >= 0.2).all() and (draw.gains <= 1.0).all()
        assert sorted(draw.flips) == [0, 1, 2, 3]  # stratified over the batch
    assert set(scales) == {1, 2, 3, 4}
    weights_of = np.array([1, 1 / 4, 1 / 9, 1 / 16])
    expected = weights_of[0] / weights_of.sum()
    assert abs(scales.count(1) / 200 - expected) < 4 * np.sqrt(expected * (1 - expected) / 200)
    assert perceptual.sample_transform(1, 127, 127, generator_for(0)).scale == 1


@pytest.mark.parametrize("size", [(64, 64), (131, 150), (192, 128)])
def test_transform_keeps_colour_and_mean(size):
    """Flips, shifts and averages keep a constant image constant, up to gains and channel order."""
    color = torch.tensor([0.2, 0.5, 0.9]).reshape(1, 3, 1, 1)
    image = color.expand(3, 3, *size)
    for seed in range(6):
        draw = perceptual.sample_transform(3, *size, generator_for(seed))
        out = perceptual.apply_transform(image, draw)
        assert min(out.shape[-2:]) >= min(size) // draw.scale
        for index in range(3):
            aim = color[0, list(draw.channel_orders[index]), 0, 0] * draw.gains[index]
            torch.testing.assert_close(out[index].mean(dim=(1, 2)), aim)
            assert (out[index].std(dim=(1, 2)) < 1e-6).all()


def test_flip_and_transpose_match_their_names():
    image = torch.arange(12.0).reshape(1, 1, 3, 4).expand(1, 3, 3, 4)
    plain = perceptual.Transform(1, (0, 0), False, ((0, 0),), (0,), ((0, 1, 2),), torch.ones(1, 3))
    big = torch.nn.functional.interpolate(image, size=(30, 40))
    base = perceptual.apply_transform(big, plain)
    flipped = perceptual.apply_transform(big, perceptual.Transform(**{**plain.__dict__, "flips": (1,)}))
    turned = perceptual.apply_transform(big, perceptual.Transform(**{**plain.__dict__, "transpose": True}))
    assert torch.equal(flipped, base.flip(3))
    assert torch.equal(turned, base.transpose(2, 3))


def test_gradient_ssim_matches_skimage_and_orders_distortions():
    metric = perceptual.GradientSsim()
    rng = np.random.default_rng(0)
    a = torch.from_numpy(rng.random((1, 3, 40, 48)).astype(np.float32))
    b = (a + 0.1 * torch.from_numpy(rng.standard_normal((1, 3, 40, 48)).astype(np.float32))).clamp(0, 1)
    _, full = structural_similarity(
        a[0].numpy(),
        b[0].numpy(),
        channel_axis=0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    assert float(metric.ssim(a, b)) == pytest.approx(full[:, 5:-5, 5:-5].mean(), abs=1e-4)
    generator = generator_for(0)
    assert float(metric(a, a, generator)) == pytest.approx(0.0, abs=1e-6)
    assert float(metric(b, a, generator)) > 0.05
    tiny = torch.rand(2, 3, 8, 8, requires_grad=True)
    assert (metric(tiny, torch.rand(2, 3, 8, 8), generator) == 0).all()
