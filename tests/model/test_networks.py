# SPDX-License-Identifier: MIT
"""The two tracks: sizes, shapes, receptive field, padding, the global track, and the input encoding by
name."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from datagen.foundation import color
from model import networks
from model.networks import MaterialNetwork, NetworkConfig, Track

TINY = NetworkConfig(base_channels=4, global_channels=8, dropout=0.0)


def _buffers(batch: int, height: int, width: int, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    names = ("beauty", "color_median", "color_max", "color_min", "normal_camera")
    buffers = {n: torch.rand(batch, 3, height, width, generator=generator) for n in names}
    buffers["depth_z_m"] = 1.0 + torch.rand(batch, 1, height, width, generator=generator)
    return buffers


def test_parameter_counts_of_the_paper_preset():
    network = MaterialNetwork()
    assert networks.num_parameters(network.tracks["diffuse"]) == 7_998_608
    assert networks.num_parameters(network.tracks["specular"]) == 8_011_264
    convolutions = [p.numel() for n, p in network.tracks["diffuse"].named_parameters() if "conv" in n]
    assert sum(convolutions) + 64 * 9 * 16 == 7_552_144


@pytest.mark.parametrize("size", [(32, 48), (30, 41), (16, 16), (1, 1), (17, 200)])
@pytest.mark.parametrize("wide", [False, True])
def test_any_size_gives_maps_of_that_size_in_range(size, wide):
    network = MaterialNetwork(TINY.model_copy(update={"wide_decoder": wide})).eval()
    maps = network(_buffers(2, *size), torch.ones(2))
    shapes = {name: tuple(value.shape) for name, value in maps.items()}
    assert shapes == {
        "diffuse_albedo": (2, 3, *size),
        "specular_albedo": (2, 3, *size),
        "roughness": (2, 1, *size),
    }
    assert all((m >= 0).all() and (m <= 1).all() for m in maps.values())


def test_padding_changes_nothing():
    """An image in a larger canvas gives exactly the same maps; without masking it does not."""
    for ignores, changed in ((True, False), (False, True)):
        torch.manual_seed(5)
        track = Track(9, 3, TINY.model_copy(update={"ignores_padding": ignores})).double().eval()
        x = torch.rand(1, 9, 48, 32, dtype=torch.float64)
        alone = track(x)
        padded = track(torch.nn.functional.pad(x, (0, 48, 0, 16)), (48, 32))
        assert padded.shape == alone.shape
        assert ((padded - alone).abs().max() > 1e-6) == changed


def test_receptive_field(monkeypatch):
    """Gradient support of one output pixel through the convolutions alone, at phases of the coarsest grid."""
    monkeypatch.setattr(networks.Layer, "modulate", lambda self, x, g, valid: (x, g))
    torch.manual_seed(0)
    config = NetworkConfig(base_channels=1, global_channels=1, dropout=0.0)
    track = Track(1, 1, config).double().eval()
    sides = set()
    for phase in range(0, 16, 5):
        x = torch.randn(1, 1, 320, 320, dtype=torch.float64, requires_grad=True)
        (gradient,) = torch.autograd.grad(track(x)[0, 0, 160 + phase, 160 + phase], x)
        rows = gradient[0, 0].abs().sum(dim=1).nonzero()
        sides.add(int(rows.max() - rows.min()) + 1)
    assert max(sides) == networks.RECEPTIVE_FIELD_PX
    assert sides == {126, 142}


def test_global_track_connects_distant_pixels():
    """A change in one corner reaches the opposite corner, far outside the convolutions' receptive field."""
    torch.manual_seed(2)
    track = Track(3, 3, TINY).double().eval()
    x = torch.zeros(1, 3, 320, 320, dtype=torch.float64)
    y = x.clone()
    y[:, :, :16, :16] = 1.0
    difference = (track(x) - track(y))[0, :, 310:, 310:].abs().max()
    assert difference > 1e-9


def test_the_norm_of_a_constant_image_is_finite():
    track = Track(9, 3, TINY).eval()
    x = torch.zeros(1, 9, 32, 32, requires_grad=True)
    track(x).sum().backward()
    assert torch.isfinite(x.grad).all()


def test_dropout_acts_in_training_only():
    track = Track(9, 3, TINY.model_copy(update={"dropout": 0.5}))
    x = torch.rand(1, 9, 32, 32)
    track.train()
    assert not torch.equal(track(x), track(x))
    track.eval()
    assert torch.equal(track(x), track(x))


def test_channels_last_and_bfloat16_agree_with_float32():
    torch.manual_seed(1)
    network = MaterialNetwork(NetworkConfig(base_channels=8, global_channels=16)).eval()
    buffers, exposure = _buffers(1, 48, 64), torch.ones(1)
    with torch.no_grad():
        reference = network(buffers, exposure)
        network.to(memory_format=torch.channels_last)
        assert network.is_channels_last
        fast = network(buffers, exposure)
        with torch.autocast("cpu", torch.bfloat16):
            coarse = network(buffers, exposure)
    for name, expected in reference.items():
        torch.testing.assert_close(fast[name], expected, rtol=0, atol=2e-6)
        assert coarse[name].dtype == torch.float32
        assert (coarse[name] - expected).abs().mean() < 0.01


def test_inputs_are_assembled_by_name():
    buffers = _buffers(2, 16, 16)
    exposure = torch.tensor([1.0, 0.5])
    x = networks.assemble_inputs("specular", buffers, exposure, TINY)
    assert x.shape == (2, 18, 16, 16)
    assert networks.track_inputs("diffuse", TINY) == ("beauty", "color_median", "color_max")
    expected = color.log_from_linear(buffers["color_min"][1].numpy() * 0.5)
    np.testing.assert_allclose(x[1, 9:12].numpy(), expected, atol=1e-6)
    assert torch.equal(x[:, 12:15], buffers["normal_camera"])
    depth = buffers["depth_z_m"]
    torch.testing.assert_close(x[:, 15:16], 2 * depth / depth.amax(dim=(1, 2, 3), keepdim=True) - 1)
    assert torch.equal(x[:, 15], x[:, 17])
    with pytest.raises(KeyError, match="color_max"):
        networks.assemble_inputs(
            "diffuse", {k: v for k, v in buffers.items() if k != "color_max"}, exposure, TINY
        )


def test_single_view_ablation_has_no_statistics():
    config = TINY.model_copy(update={"uses_statistics": False})
    assert networks.track_inputs("diffuse", config) == ("beauty",)
    assert networks.track_inputs("specular", config) == ("beauty", "normal_camera", "depth")
    only = {k: v for k, v in _buffers(1, 16, 16).items() if not k.startswith("color_")}
    assert set(MaterialNetwork(config)(only, torch.ones(1))) == {
        "diffuse_albedo",
        "specular_albedo",
        "roughness",
    }


def test_a_black_view_and_an_empty_view_encode_to_the_floor():
    assert (networks.encode_color(torch.zeros(1, 3, 4, 4), 1.0) == -1).all()
    assert (networks.encode_depth(torch.zeros(1, 1, 4, 4)) == -1).all()


@pytest.mark.parametrize("size", [(96, 64), (101, 77), (50, 130)])
@pytest.mark.parametrize("elements", [2**8, 2**13])
def test_strips_of_large_images_change_nothing(monkeypatch, size, elements):
    """Strips of one or several rows give the same maps, but not without global statistics of the norms."""
    torch.manual_seed(1)
    track = Track(9, 3, NetworkConfig(base_channels=8, global_channels=16)).eval()
    x = torch.randn(2, 9, *size)
    with torch.no_grad():
        whole = track(x)
        upper = track(x[:, :, : size[0] // 2])
        monkeypatch.setattr(networks, "STRIP_ELEMENTS", elements)
        in_strips = track(x)
    torch.testing.assert_close(in_strips, whole, rtol=0, atol=1e-6)
    assert (upper - whole[:, :, : size[0] // 2])[:, :, :16].abs().max() > 1e-4
