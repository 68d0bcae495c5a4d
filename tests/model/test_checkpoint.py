# SPDX-License-Identifier: MIT
"""Checkpoints: round trip, card, and refusal of damaged, foreign or hostile files."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys

import pytest
import torch
from safetensors.torch import load_file, save_file

from datagen.foundation.errors import InputError
from model.checkpoint import (
    CheckpointCard,
    bundled_checkpoint,
    load_checkpoint,
    read_card,
    save_checkpoint,
    software_versions,
)
from model.confidence import ConfidenceNets
from model.networks import MaterialNetwork, NetworkConfig
from model.publish import publish_checkpoint

TINY = NetworkConfig(base_channels=2, global_channels=4)


@pytest.fixture
def card() -> CheckpointCard:
    return CheckpointCard(
        network=TINY,
        loss="l1+gradient-ssim-3",
        phase="joint",
        step=12,
        metrics={"roughness_mse": 0.25},
        training={"seed": 3},
        versions=software_versions(),
    )


@pytest.mark.parametrize("with_confidence", [False, True])
def test_round_trip(tmp_path, card, with_confidence):
    network = MaterialNetwork(TINY).eval()
    confidence = ConfidenceNets() if with_confidence else None
    path = tmp_path / "best.safetensors"
    save_checkpoint(path, card, network, confidence)
    loaded = load_checkpoint(path)
    x = torch.rand(1, 9, 32, 32)
    assert torch.equal(loaded.network.tracks["diffuse"](x), network.tracks["diffuse"](x))
    assert not loaded.network.training
    assert (loaded.confidence is not None) == with_confidence == loaded.card.has_confidence
    if with_confidence:
        image, maps = (
            torch.rand(1, 3, 8, 8),
            {"specular_albedo": torch.rand(1, 3, 8, 8), "roughness": torch.rand(1, 1, 8, 8)},
        )
        for name, value in loaded.confidence(image, maps).items():
            assert torch.equal(value, confidence(image, maps)[name])
    assert loaded.card.metrics == {"roughness_mse": 0.25}
    assert read_card(path) == loaded.card
    assert json.loads(path.with_suffix(".json").read_text())["loss"] == "l1+gradient-ssim-3"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["best.json", "best.safetensors"]


def test_a_checkpoint_is_read_without_the_compiler_of_torch(tmp_path, card):
    save_checkpoint(tmp_path / "best.safetensors", card, MaterialNetwork(TINY))
    code = (
        "import sys; from pathlib import Path; from model.checkpoint import load_checkpoint;"
        "load_checkpoint(Path(sys.argv[1])); sys.exit('torch._dynamo' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "best.safetensors")], check=True)


def test_a_published_checkpoint_has_half_the_size_and_no_paths(tmp_path, card):
    network = MaterialNetwork(TINY).eval()
    card = card.model_copy(
        update={
            "training": {"initial_checkpoint": str(tmp_path / "first"), "perceptual": {"vgg": str(tmp_path)}}
        }
    )
    save_checkpoint(tmp_path / "run.safetensors", card, network, ConfidenceNets())
    publish_checkpoint(tmp_path / "run.safetensors", tmp_path / "out" / "small.safetensors")
    loaded = load_checkpoint(tmp_path / "out" / "small.safetensors")
    for name, value in network.state_dict().items():
        assert loaded.network.state_dict()[name].dtype == torch.float32
        assert torch.equal(loaded.network.state_dict()[name], value.half().float())
    assert loaded.confidence is not None
    text = (tmp_path / "out" / "small.json").read_text()
    assert str(tmp_path) not in text and json.loads(text)["metrics"] == {"roughness_mse": 0.25}


def test_a_published_checkpoint_keeps_values_beyond_half_floats(tmp_path, card):
    """An example is the batch count of a normalisation layer in a custom network."""
    network = MaterialNetwork(TINY)
    with torch.no_grad():
        network.tracks["diffuse"].enc2.shift.fill_(70000.0)
    save_checkpoint(tmp_path / "run.safetensors", card, network)
    publish_checkpoint(tmp_path / "run.safetensors", tmp_path / "small.safetensors")
    published = load_checkpoint(tmp_path / "small.safetensors").network
    assert (published.tracks["diffuse"].enc2.shift == 70000.0).all()


def test_a_published_checkpoint_is_not_overwritten_by_its_card(tmp_path, card):
    save_checkpoint(tmp_path / "run.safetensors", card, MaterialNetwork(TINY))
    with pytest.raises(InputError, match=r"--out: .*small\.json.*expected the name of a \.safetensors file"):
        publish_checkpoint(tmp_path / "run.safetensors", tmp_path / "small.json")


def test_equal_content_has_equal_bytes(tmp_path, card):
    network = MaterialNetwork(TINY)
    for name in ("a", "b"):
        save_checkpoint(tmp_path / f"{name}.safetensors", card, network)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def _rewrite(path, change_tensors=None, change_card=None):
    tensors = load_file(path)
    text = json.loads(path.with_suffix(".json").read_text())
    if change_tensors:
        change_tensors(tensors)
    if change_card:
        change_card(text)
    save_file(tensors, path, {"card": json.dumps(text)})


@pytest.mark.parametrize(
    ("tensors", "card_change", "message"),
    [
        (lambda t: t.pop("network.tracks.diffuse.enc1.weight"), None, "enc1.weight = missing"),
        (lambda t: t.update(extra=torch.zeros(2)), None, "extra"),
        (lambda t: t.update({"network.tracks.diffuse.enc1.weight": torch.zeros(1)}), None, "enc1.weight"),
        (lambda t: t["network.tracks.diffuse.enc1.weight"].fill_(float("nan")), None, "NaN"),
        (None, lambda c: c.update(version=2), "version"),
        (None, lambda c: c["network"].update(base_channels=4), "expected"),
        (None, lambda c: c["network"].update(base_channels=10**9), "base_channels"),
        (None, lambda c: c.update(unknown=1), "unknown"),
        (None, lambda c: c.update(has_confidence=True), "confidence"),
    ],
)
def test_mismatched_weights_are_refused(tmp_path, card, tensors, card_change, message):
    path = tmp_path / "c.safetensors"
    save_checkpoint(path, card, MaterialNetwork(TINY))
    _rewrite(path, tensors, card_change)
    with pytest.raises(InputError, match=message):
        load_checkpoint(path)


def test_damaged_and_foreign_files_are_refused(tmp_path, card):
    path = tmp_path / "c.safetensors"
    save_checkpoint(path, card, MaterialNetwork(TINY))
    data = path.read_bytes()
    for content in (b"", data[:100], data[: len(data) // 2], b"\xff" * 64, pickle.dumps({"a": 1})):
        path.write_bytes(content)
        with pytest.raises(InputError):
            load_checkpoint(path)
    save_file({"x": torch.zeros(1)}, path)
    with pytest.raises(InputError, match="no card"):
        load_checkpoint(path)
    with pytest.raises(InputError, match="no such file"):
        load_checkpoint(tmp_path / "absent.safetensors")


def test_the_bundled_checkpoint_is_small_and_names_its_training_data():
    path = bundled_checkpoint()
    assert path.stat().st_size <= 20e6
    checkpoint = load_checkpoint(path)
    assert checkpoint.confidence is not None
    data = {record.name: record for record in checkpoint.card.data}
    assert {name: record.num_views for name, record in data.items()} == {
        "learning": 1000,
        "checkpoint": 720,
        "pale": 720,
        "pale_validation": 80,
    }
    assert {"study", "kitchen"} <= data["learning"].assets.keys()  # its validation views show the study
    for name in ("checkpoint", "pale"):
        assert "staircase" in data[name].assets
        assert "study" not in data[name].assets  # validation data is not trained on
        assert not data[name].assets.keys() & data["pale_validation"].assets.keys()
    assert not any({"veach-ajar", "dining-room"} & record.assets.keys() for record in data.values())
    assert checkpoint.card.training["initial_checkpoint"] is None
    maps = checkpoint.network.tracks["diffuse"](torch.zeros(1, 9, 32, 32))
    assert maps.shape == (1, 3, 32, 32) and bool(torch.isfinite(maps).all())
