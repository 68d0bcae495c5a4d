# SPDX-License-Identifier: MIT
"""User-defined networks: trained, loaded from checkpoints, and refused if they break the contract."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from datagen.foundation.errors import InputError
from model.checkpoint import CheckpointCard, load_checkpoint, save_checkpoint
from model.networks import (
    INPUTS,
    MaterialNetwork,
    NetworkConfig,
    assemble_inputs,
    blend_reflectance,
    encode_input,
    track_inputs,
)
from model.own_network import OwnNetwork, make_network, network_inputs, try_network
from model.training.config import parse_overrides, resolve_config
from model.training.dataset import buffer_names
from model.training.dry_run import describe_run, synthetic_batch
from model.training.train import Trainer
from tests.model.training_data import make_dataset

TOY = "tests.model.toy_network:Toy"
CPU = torch.device("cpu")
pytestmark = pytest.mark.filterwarnings("ignore:Sparse CSR tensor support is in beta")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    splits = {"room-0": ("train", 4), "room-1": ("train", 4), "room-2": ("validation", 2)}
    return make_dataset(tmp_path_factory.mktemp("data") / "set", splits, has_light=True)  # type: ignore[arg-type]


def _config(*settings: str, preset: str = "smoke"):
    return resolve_config(preset, None, parse_overrides(list(settings)))


def _own(name: str) -> NetworkConfig:
    return NetworkConfig(factory=f"tests.model.toy_network:{name}")


def test_the_command_trains_it_and_the_checkpoint_restores_it(dataset: Path, tmp_path: Path) -> None:
    from model.cli import app

    out = tmp_path / "run"
    arguments = ["train", str(dataset), "--out", str(out), "--preset", "smoke", "--quiet", "--device", "cpu"]
    settings = ["--network", TOY, "--set", "network.arguments.width=6"]
    result = CliRunner().invoke(app, [*arguments, *settings])
    assert result.exit_code == 0, result.output
    checkpoint = load_checkpoint(out / "final.safetensors")
    assert isinstance(checkpoint.network, OwnNetwork)
    assert checkpoint.card.network == NetworkConfig(factory=TOY, arguments={"width": 6})
    assert checkpoint.network.module.first.out_channels == 6
    assert checkpoint.card.phase == "confidence" and checkpoint.confidence is not None
    assert checkpoint.card.metrics["diffuse_albedo_mse"] < 0.2
    assert checkpoint.network.module.norm.running_mean.abs().sum() > 0  # buffers are saved like weights
    batch = synthetic_batch(1, 21, CPU)
    maps = checkpoint.network(batch, batch["exposure"], batch["depth_max_m"])
    assert {name: tuple(value.shape) for name, value in maps.items()} == {
        "diffuse_albedo": (1, 3, 21, 21),
        "specular_albedo": (1, 3, 21, 21),
        "roughness": (1, 1, 21, 21),
    }


def test_a_dry_run_prints_its_size(dataset: Path) -> None:
    text = describe_run(_config(f"network.factory={TOY}"), [dataset], CPU)
    num = 12 * 8 * 9 + 8 + 2 * 8 + 8 * 7 + 7
    assert f"{TOY}: {num:,} parameters" in text and "joint: " in text


def test_all_parameters_are_trained(dataset: Path, tmp_path: Path) -> None:
    config = _config(f"network.factory={TOY}", "phases=[{name: joint, steps: 3}]")
    trainer = Trainer(config, [dataset], tmp_path / "run", device=CPU)
    before = {name: value.clone() for name, value in trainer.models.network.named_parameters()}
    trainer.run()
    after = dict(trainer.models.network.named_parameters())
    assert all(not torch.equal(before[name], after[name]) for name in before)


def test_tied_weights_are_saved(dataset: Path, tmp_path: Path) -> None:
    config = _config("network.factory=tests.model.toy_network:Tied", "phases=[{name: joint, steps: 1}]")
    network = load_checkpoint(Trainer(config, [dataset], tmp_path / "run", device=CPU).run()).network
    assert isinstance(network, OwnNetwork)
    assert torch.equal(network.module.same.weight, network.module.last.weight)


def test_a_preset_trains_it_in_one_phase_for_its_tracks() -> None:
    config = _config(f"network.factory={TOY}", preset="small")
    assert [(phase.name, phase.epochs, phase.steps) for phase in config.phases] == [
        ("joint", 4, None),
        ("confidence", None, 150),
    ]
    assert config.network == NetworkConfig(factory=TOY)
    paper = _config(f"network.factory={TOY}", preset="paper")
    assert [phase.name for phase in paper.phases] == ["joint", "confidence"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (("phases=[{name: diffuse, steps: 1}]",), "network.factory has no tracks"),
        (("network.base_channels=8",), "no base_channels with factory"),
    ],
)
def test_settings_of_the_tracks_are_refused(settings: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        _config(f"network.factory={TOY}", *settings)
    with pytest.raises(InputError, match="arguments only with factory"):
        _config("network.arguments.width=8")


def test_arguments_in_exponential_notation_are_numbers(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(f"network: {{factory: '{TOY}', arguments: {{rate: -2.5E3}}}}")
    config = resolve_config("smoke", file, parse_overrides(["network.arguments.eps=1e-4"]))
    assert config.network.arguments == {"rate": -2500.0, "eps": 0.0001}


@pytest.mark.parametrize("value", ["2020-01-01", ".inf", "{1: 2}", "!!binary aGk="])
def test_arguments_that_a_checkpoint_cannot_store_are_refused(value: str) -> None:
    with pytest.raises(InputError, match=r"network\.arguments = .*expected text, finite numbers"):
        _config(f"network.factory={TOY}", f"network.arguments.width={value}")


@pytest.mark.parametrize(
    ("factory", "message"),
    [
        ("tests.model.toy_network", "no MODULE:NAME"),
        ("./toy_network.py:Toy", "no MODULE:NAME"),
        ("tests.model.toy_network:Missing", "no attribute 'Missing'"),
        ("no.such.module:Class", "No module named 'no"),
        ("tests.model.toy_network:not_a_class", "not a class of networks"),
        ("subprocess:Popen", "not a class of networks"),
        ("tests.model.toy_network:Curious", r"expected some of beauty, .*known_share"),
        ("tests.model.toy_network:Aimless", "inputs = None"),
    ],
)
def test_classes_that_are_no_networks_are_refused(factory: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_network(NetworkConfig(factory=factory))


def test_a_checkpoint_cannot_call_other_classes(tmp_path: Path) -> None:
    """Checkpoints are untrusted: a name in the card is only called if it is a network class."""
    card = CheckpointCard(network=NetworkConfig(factory=TOY), loss="none", phase="joint", step=0)
    path = tmp_path / "weights.safetensors"
    config = NetworkConfig(
        factory="subprocess:Popen", arguments={"args": ["touch", str(tmp_path / "called")]}
    )
    save_checkpoint(path, card.model_copy(update={"network": config}), make_network(_own("Toy")))
    with pytest.raises(InputError, match="not a class of networks"):
        load_checkpoint(path)
    assert not (tmp_path / "called").exists()


def test_unknown_arguments_are_named() -> None:
    with pytest.raises(
        InputError, match=r"unexpected keyword argument 'depth'.*arguments of tests.model.toy_network:Toy"
    ):
        make_network(NetworkConfig(factory=TOY, arguments={"depth": 3}))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Unbounded", r"Unbounded: \w+ = .*expected values in \[0, 1\]"),
        ("Fixed", "Fixed = no parameters; expected weights to train"),
        ("Halved", r"\(1, 3, 12, 19\).*\(1, 3, 23, 38\)"),
    ],
)
def test_invalid_outputs_stop_a_run_before_it_starts(
    dataset: Path, tmp_path: Path, name: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Trainer(_config(f"network.factory=tests.model.toy_network:{name}"), [dataset], tmp_path, device=CPU)


def test_data_without_the_inputs_is_refused(tmp_path: Path) -> None:
    plain = make_dataset(tmp_path / "plain", {"room-0": ("train", 4)})
    config = _config("network.factory=tests.model.toy_network:Echo", "phases=[{name: joint, steps: 1}]")
    with pytest.raises(InputError, match="no reflectance, known_share"):
        Trainer(config, [plain], tmp_path / "run", device=CPU)


def test_each_input_is_passed_by_name() -> None:
    batch = synthetic_batch(2, 16, CPU)
    exposure = batch["exposure"].reshape(-1, 1, 1, 1)
    for name in INPUTS:
        value = encode_input(name, batch, exposure, batch["depth_max_m"])
        assert value.shape == (2, 1 if name == "known_share" else 3, 16, 16), name
        assert value.min() >= -1 and value.max() <= 1
    assert network_inputs(_own("Echo")) == ("reflectance", "known_share")
    network = make_network(_own("Echo"))
    assert isinstance(network, OwnNetwork)
    try_network(network)
    maps = network(batch, batch["exposure"])
    torch.testing.assert_close(maps["diffuse_albedo"], batch["reflectance"] / 2, rtol=0, atol=1e-5)
    torch.testing.assert_close(maps["roughness"], batch["known_share"], rtol=0, atol=1e-6)


# --- light as inputs of the two tracks --------------------------------------------------------------------

LIT = NetworkConfig(base_channels=2, global_channels=4, light_inputs=("known_share", "reflectance"))


def test_light_follows_the_other_inputs_of_both_tracks() -> None:
    assert track_inputs("diffuse", LIT) == (
        "beauty",
        "color_median",
        "color_max",
        "reflectance",
        "known_share",
    )
    assert track_inputs("specular", LIT)[-3:] == ("depth", "reflectance", "known_share")
    assert set(buffer_names(LIT)) - set(buffer_names(NetworkConfig())) == {"reflectance", "known_share"}
    batch = synthetic_batch(1, 16, CPU)
    x = assemble_inputs("diffuse", batch, batch["exposure"], LIT)
    assert x.shape == (1, 13, 16, 16)
    torch.testing.assert_close(x[:, 12:], 2 * batch["known_share"] - 1)
    brighter = assemble_inputs("diffuse", batch, 2 * batch["exposure"], LIT)
    assert torch.equal(brighter[:, 9:], x[:, 9:]) and not torch.equal(brighter[:, :9], x[:, :9])
    assert set(MaterialNetwork(LIT)(batch, batch["exposure"])) == {
        "diffuse_albedo",
        "specular_albedo",
        "roughness",
    }


def test_tracks_train_with_light(dataset: Path, tmp_path: Path) -> None:
    config = _config("network.light_inputs=[reflectance, known_share, mirror_sharp, mirror_broad]")
    final = Trainer(config, [dataset], tmp_path / "run", device=CPU).run()
    card = load_checkpoint(final).card
    assert card.network.light_inputs == ("reflectance", "known_share", "mirror_sharp", "mirror_broad")


def test_training_with_light_starts_from_a_checkpoint_without(dataset: Path, tmp_path: Path) -> None:
    lit = "network.light_inputs=[known_share, mirror_broad]"
    first = Trainer(_config(), [dataset], tmp_path / "first", device=CPU).run()
    config = _config(lit, f"initial_checkpoint={first}")
    other = make_dataset(tmp_path / "other", {"room-2": ("train", 4)}, has_light=True)
    trainer = Trainer(config, [other], tmp_path / "lit", device=CPU)
    narrow, wide = load_checkpoint(first).network, trainer.models.network.eval()
    batch = synthetic_batch(2, 32, CPU)
    expected, found = narrow(batch, batch["exposure"]), wide(batch, batch["exposure"])
    for name, values in found.items():
        torch.testing.assert_close(values, expected[name], rtol=0, atol=1e-6)
    assert not torch.equal(values, torch.full_like(values, 0.5))
    card = load_checkpoint(trainer.run()).card
    assert [record.num_views for record in card.data] == [10, 4]
    assert trainer.models.network.tracks["diffuse"].enc1.weight[:, 9:].abs().max() > 0
    with pytest.raises(InputError, match="fewer light_inputs"):
        fewer = _config(
            "network.light_inputs=[known_share]", f"initial_checkpoint={tmp_path / 'lit'}/final.safetensors"
        )
        Trainer(fewer, [dataset], tmp_path / "fewer", device=CPU)


def test_diffuse_albedo_blends_recorded_reflectance() -> None:
    base, reflectance = torch.full((1, 3, 2, 2), 0.2), torch.full((1, 3, 2, 2), 0.6)

    def blended(share: float, gain: float) -> torch.Tensor:
        outputs = torch.cat([base, base[:, :1] * 0 + share, base * 0 + gain], dim=1)
        return blend_reflectance(outputs, reflectance)

    for share, gain, expected in ((0, 0.9, 0.2), (1, 0.5, 0.6), (1, 0.25, 0.3), (1, 1, 1), (0.25, 0.5, 0.3)):
        torch.testing.assert_close(blended(share, gain), torch.full_like(base, expected))
    with pytest.raises(ValueError, match="expected reflectance in light_inputs"):
        NetworkConfig(blends_reflectance=True)


def test_training_with_reflectance_starts_from_a_checkpoint_without(dataset: Path, tmp_path: Path) -> None:
    first = Trainer(_config(), [dataset], tmp_path / "first", device=CPU).run()
    lit = ("network.light_inputs=[reflectance]", "network.blends_reflectance=true")
    trainer = Trainer(_config(*lit, f"initial_checkpoint={first}"), [dataset], tmp_path / "lit", device=CPU)
    narrow, wide = load_checkpoint(first).network, trainer.models.network.eval()
    batch = synthetic_batch(2, 32, CPU)
    expected, found = narrow(batch, batch["exposure"]), wide(batch, batch["exposure"])
    for name in ("specular_albedo", "roughness"):
        torch.testing.assert_close(found[name], expected[name], rtol=0, atol=1e-6)
    x = assemble_inputs("diffuse", batch, batch["exposure"], wide.config)
    outputs = wide.tracks["diffuse"](x)
    torch.testing.assert_close(outputs[:, :3], expected["diffuse_albedo"], rtol=0, atol=1e-6)
    share, gain = outputs[:, 3:4], outputs[:, 4:]
    assert ((share - 0.5).abs() < 0.1).all() and ((gain - 0.5).abs() < 0.1).all()
    reflectance = batch["reflectance"].clamp(0, 2) * 2 ** (4 * gain - 2)
    mixed = (1 - share) * outputs[:, :3] + share * reflectance.clamp(max=1)
    torch.testing.assert_close(found["diffuse_albedo"], mixed, rtol=0, atol=1e-6)
    assert load_checkpoint(trainer.run()).card.network.blends_reflectance


def test_cards_without_light_are_unchanged() -> None:
    optional = {"light_inputs", "blends_reflectance", "factory", "arguments"}
    assert not optional & NetworkConfig().model_dump().keys()
