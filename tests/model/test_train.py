# SPDX-License-Identifier: MIT
"""The training loop on a small dataset: every phase, bitwise resuming, ranks, stops, and progress."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from datagen.foundation.errors import InputError
from model.checkpoint import load_checkpoint
from model.training.config import parse_overrides, resolve_config
from model.training.context import Ranks
from model.training.dataset import buffer_names
from model.training.run_folder import NonFiniteError
from model.training.run_log import RunLog
from model.training.train import Trainer
from model.training.validation import (
    constant_predictor,
    evaluate,
    mean_maps,
    network_predictor,
    whole_views,
)
from tests.conftest import REPOSITORY
from tests.model.training_data import make_dataset, read_log

pytestmark = pytest.mark.filterwarnings("ignore:Sparse CSR tensor support is in beta")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    splits = {"room-0": ("train", 4), "room-1": ("train", 4), "room-2": ("validation", 2)}
    return make_dataset(tmp_path_factory.mktemp("data") / "set", splits)


CPU = torch.device("cpu")


def _config(*settings: str):
    return resolve_config("smoke", None, parse_overrides(list(settings)))


def _weights(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(folder / "final.safetensors")


@pytest.fixture(scope="module")
def whole(dataset, tmp_path_factory) -> Path:
    """Folder of an uninterrupted run of the smoke preset."""
    out = tmp_path_factory.mktemp("run") / "whole"
    Trainer(_config(), [dataset], out, device=CPU).run()
    return out


def test_smoke_preset_runs_every_phase(dataset, whole):
    out, final = whole, whole / "final.safetensors"
    checkpoint = load_checkpoint(final)
    assert checkpoint.confidence is not None
    card = checkpoint.card
    assert card.loss == "l1+gradient-ssim-3"
    assert card.data[0].name == "tiny" and card.step == 10
    expected = {f"{n}_{k}" for n in ("diffuse_albedo", "specular_albedo", "roughness") for k in ("mse", "l1")}
    assert expected <= set(card.metrics)
    assert {"filtered_roughness_mse", "filtered_specular_albedo_mse"} <= set(card.metrics)
    files = {p.name for p in out.iterdir()}
    phases = ("diffuse", "specular", "joint", "confidence")
    assert files >= {"run.json", "log.csv", "state.safetensors", *(f"best-{p}.safetensors" for p in phases)}
    assert list((out / "tensorboard").glob("events*"))
    assert [step for step, _ in read_log(out, "train", "total")] == list(range(1, 11))
    assert len(read_log(out, "validation", "score")) == 4
    assert json.loads((out / "run.json").read_text())["config"]["batch_size"] == 2
    assert Trainer(_config(), [dataset], out, device=CPU).run() == final


@pytest.mark.parametrize("limit", [1e-3, None])
def test_gradients_are_scaled_down_to_the_limit(dataset, tmp_path, monkeypatch, limit):
    """The optimiser gets gradients with a norm of at most ``limit``; the log has the norm before scaling."""
    seen = []
    take = torch.optim.Adam.step

    def step(self, *arguments):
        gradients = [p.grad for group in self.param_groups for p in group["params"] if p.grad is not None]
        seen.append(float(torch.nn.utils.get_total_norm(gradients)))
        return take(self, *arguments)

    monkeypatch.setattr(torch.optim.Adam, "step", step)
    config = _config("phases=[{name: diffuse, steps: 2}]", f"gradient_clip_norm={limit or 'null'}")
    Trainer(config, [dataset], tmp_path / "run", device=CPU).run()
    logged = [norm for _, norm in read_log(tmp_path / "run", "train", "gradient_norm")]
    assert min(logged) > 1e-3
    assert seen == pytest.approx([limit] * 2 if limit else logged, rel=1e-3)


def test_the_rate_falls_along_half_a_cosine(dataset, tmp_path, monkeypatch):
    """The rate falls from the phase's first to the run's final rate; without a final one it is constant."""
    seen = []
    take = torch.optim.Adam.step

    def step(self, *arguments):
        seen.extend(group["lr"] for group in self.param_groups)
        return take(self, *arguments)

    monkeypatch.setattr(torch.optim.Adam, "step", step)
    phases = "phases=[{name: diffuse, steps: 5, learning_rate: 0.008}, {name: specular, steps: 2}]"
    falling = _config(phases, "learning_rate=0.002", "final_learning_rate=0.0004")
    Trainer(falling, [dataset], tmp_path / "falling", device=CPU).run()
    middle = (0.008 + 0.0004) / 2
    quarter = (0.008 - 0.0004) * 0.5 * 2**-0.5
    expected = [0.008, middle + quarter, middle, middle - quarter, 0.0004, 0.002, 0.0004]
    assert seen == pytest.approx(expected)
    seen.clear()
    short = "phases=[{name: diffuse, steps: 3}]"
    constant = _config(short, "final_learning_rate=null", "learning_rate=0.002")
    Trainer(constant, [dataset], tmp_path / "constant", device=CPU).run()
    assert seen == [0.002] * 3


def test_phases_train_only_their_part(dataset, tmp_path):
    config = _config("phases=[{name: diffuse, steps: 2}]")
    trainer = Trainer(config, [dataset], tmp_path / "run", device=CPU)
    before = {n: v.clone() for n, v in trainer.models.state_dict().items()}
    trainer.run()
    changed = {n for n, v in trainer.models.state_dict().items() if not torch.equal(v, before[n])}
    assert changed and all(n.startswith("network.tracks.diffuse.") for n in changed)


@pytest.mark.parametrize("stop_at", [1, 4, 9])
def test_an_interrupted_run_continues_bit_for_bit(dataset, whole, tmp_path, stop_at):
    """A run stopped in any phase, also between checkpoints, and then resumed has the same bytes and log."""
    parts = tmp_path / "parts"
    trainer = Trainer(_config(), [dataset], parts, device=CPU)
    original = trainer.step

    def step(phase, batches):
        values = original(phase, batches)
        if trainer.progress.total_step + 1 == stop_at:
            trainer.request_stop()
        return values

    trainer.step = step
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert not (parts / "final.safetensors").exists()
    torch.manual_seed(12345)  # earlier random draws of the process do not matter
    Trainer(_config(), [dataset], parts, device=CPU).run()
    assert (whole / "final.safetensors").read_bytes() == (parts / "final.safetensors").read_bytes()
    logs = [read_log(folder, "train", "total") for folder in (whole, parts)]
    assert logs[0] == logs[1]


def test_checkpoints_have_averaged_weights(dataset, tmp_path):
    """Checkpoints contain exponential averages of the weights; training and resuming are unchanged."""
    settings = ("phases=[{name: diffuse, steps: 6}]", "learning_rate=0.01", "checkpoint_every_steps=2")
    Trainer(_config(*settings), [dataset], tmp_path / "plain", device=CPU).run()
    expected, steps = [], []

    def run(folder: Path, stop_at: int | None) -> None:
        trainer = Trainer(_config(*settings, "average_decay=0.9"), [dataset], folder, device=CPU)
        original = trainer.step

        def step(phase, batches):
            if not steps:
                expected[:] = [p.detach().clone() for p in phase.parameters]
            values = original(phase, batches)
            steps.append(len(steps) + 1)
            decay = min(0.9, steps[-1] / (10 + steps[-1]))
            for mean, p in zip(expected, phase.parameters, strict=True):
                mean.mul_(decay).add_(p.detach(), alpha=1 - decay)
            if steps[-1] == stop_at:
                trainer.request_stop()
            return values

        trainer.step = step
        trainer.run()

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts", stop_at=3)
    run(tmp_path / "parts", stop_at=None)
    assert steps == [1, 2, 3, 4, 5, 6]
    network = load_checkpoint(tmp_path / "parts" / "final.safetensors").network
    found = list(network.tracks["diffuse"].parameters())
    for mean, p in zip(expected, found, strict=True):
        torch.testing.assert_close(p.detach(), mean, rtol=1e-5, atol=1e-6)
    plain = load_checkpoint(tmp_path / "plain" / "final.safetensors").network
    assert any(
        (a - b).abs().max() > 1e-4 for a, b in zip(plain.parameters(), network.parameters(), strict=True)
    )
    logs = [read_log(tmp_path / name, "train", "total") for name in ("plain", "parts")]
    assert logs[0] == logs[1]


def test_a_killed_run_resumes_from_its_last_state(dataset, whole, tmp_path):
    """Killed between two saved states, the run repeats the steps in between with the same result."""
    parts = tmp_path / "parts"
    trainer = Trainer(_config(), [dataset], parts, device=CPU)
    original = trainer.step

    def step(phase, batches):
        if trainer.progress.total_step == 7:
            raise RuntimeError("power cut")
        return original(phase, batches)

    trainer.step = step
    with pytest.raises(RuntimeError, match="power cut"):
        trainer.run()
    Trainer(_config(), [dataset], parts, device=CPU).run()
    assert (whole / "final.safetensors").read_bytes() == (parts / "final.safetensors").read_bytes()
    assert read_log(whole, "train", "total") == read_log(parts, "train", "total")


def test_a_log_keeps_its_rows_when_a_resumed_run_is_killed(tmp_path):
    """Before the first new row, the kept rows are on disk, without the incomplete row of the killed run."""
    with RunLog(tmp_path, tensorboard=False) as log:
        for step in range(1, 121):
            log.scalars(step, "joint", 0, "train", {"total": step / 2})
    path = tmp_path / "log.csv"
    path.write_text(path.read_text() + "12")  # of step 121
    resumed = RunLog(tmp_path, 100, tensorboard=False)  # not closed, as if killed
    assert read_log(tmp_path, "train", "total") == [(step, step / 2) for step in range(1, 101)]
    assert len(path.read_text().splitlines()) == 101
    resumed.scalars(101, "joint", 0, "train", {"total": 1.0})
    resumed.close()
    assert read_log(tmp_path, "train", "total")[-2:] == [(100, 50.0), (101, 1.0)]


def test_validation_does_not_change_training(dataset, tmp_path):
    """Validating after every step changes neither the dropout of the trained track nor the loss curve."""
    settings = ("phases=[{name: diffuse, steps: 4}]", "network.dropout=0.5")
    curves = []
    for name, extra in (("often", "validation.every_steps=1"), ("never", "validation.num_views=0")):
        trainer = Trainer(_config(*settings, extra), [dataset], tmp_path / name, device=CPU)
        trainer.run()
        assert trainer.models.network.tracks["diffuse"].dec4.dropout.training
        assert not trainer.models.network.tracks["specular"].dec4.dropout.training
        curves.append(read_log(tmp_path / name, "train", "total"))
    assert curves[0] == curves[1]


def test_validation_at_intervals_replaces_that_after_epochs(dataset, tmp_path):
    settings = ("phases=[{name: diffuse, steps: 4}]", "batch_size=4", "data.crops_per_view=1")
    for name, extra, steps in (("own", ("validation.every_steps=3",), [3, 4]), ("epochs", (), [2, 4])):
        trainer = Trainer(_config(*settings, *extra), [dataset], tmp_path / name, device=CPU)
        assert trainer.context.plan(0, 0).steps_per_epoch == 2
        trainer.run()
        assert [step for step, _ in read_log(tmp_path / name, "validation", "score")] == steps


def test_a_run_is_not_continued_with_other_settings_or_data(dataset, tmp_path):
    out = tmp_path / "run"
    short = ("phases=[{name: diffuse, steps: 1}]",)
    Trainer(_config(*short), [dataset], out, device=CPU).run()
    with pytest.raises(InputError, match="config"):
        Trainer(_config(*short, "learning_rate=0.5"), [dataset], out, device=CPU).run()
    other = make_dataset(tmp_path / "other", {"room-9": ("train", 4)})
    with pytest.raises(InputError, match="data"):
        Trainer(_config(*short), [other], out, device=CPU).run()


def test_accumulation_equals_a_larger_batch(dataset, tmp_path):
    """Two micro-batches of 2 give the step of one batch of 4, up to rounding."""
    common = ("phases=[{name: joint, steps: 4}]", "network.dropout=0.0", "validation.num_views=0")
    runs = {"large": ("batch_size=4",), "small": ("batch_size=2", "accumulation=2")}
    curves = {}
    for name, settings in runs.items():
        out = tmp_path / name
        Trainer(_config(*common, *settings), [dataset], out, device=CPU).run()
        curves[name] = [value for _, value in read_log(out, "train", "total")]
    np.testing.assert_allclose(curves["small"], curves["large"], rtol=1e-4)


def test_two_ranks_equal_one_process_with_the_double_batch(dataset, tmp_path):
    """torchrun with two gloo processes: the same loss curve to 1e-3."""
    settings = ["phases=[{name: joint, steps: 5}]", "network.dropout=0.0", "validation.num_views=0"]
    one = tmp_path / "one"
    Trainer(_config(*settings, "batch_size=4"), [dataset], one, device=CPU).run()
    two = tmp_path / "two"
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2", "--master-port=0"]
    command += [
        "--rdzv-backend=c10d",
        "--rdzv-endpoint=localhost:0",
        "-m",
        "model.cli",
        "train",
        str(dataset),
    ]
    command += ["--out", str(two), "--preset", "smoke", "--device", "cpu", "--quiet", "--threads", "1"]
    for item in [*settings, "batch_size=2"]:
        command += ["--set", item]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY)}
    result = subprocess.run(
        command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr[-2000:]
    curves = [[value for _, value in read_log(folder, "train", "total")] for folder in (one, two)]
    np.testing.assert_allclose(curves[1], curves[0], rtol=1e-3)
    weights = [_weights(folder) for folder in (one, two)]
    for name, value in weights[0].items():
        torch.testing.assert_close(weights[1][name], value, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("device", "expected"), [(CPU, ["gloo"]), (None, [0, "nccl"])])
def test_ranks_communicate_on_the_device_of_training(monkeypatch, device, expected):
    """On a machine with GPUs, ``--device cpu`` needs a backend for tensors of the CPU."""
    chosen = []
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "set_device", lambda index: chosen.append(index))
    monkeypatch.setattr(torch.distributed, "init_process_group", chosen.append)
    Ranks(device)
    assert chosen == expected


def _predict_nan(trainer: Trainer, call: int) -> None:
    """Replace the predictions in the loss's call number ``call`` by NaN."""
    original, calls = trainer.context.loss.forward, itertools.count(1)

    def forward(predicted, *args):
        if next(calls) == call:
            predicted = {n: v * float("nan") for n, v in predicted.items()}
        return original(predicted, *args)

    trainer.context.loss.forward = forward


def test_a_non_finite_loss_stops_with_the_batch_saved(dataset, tmp_path):
    out = tmp_path / "run"
    trainer = Trainer(_config("phases=[{name: diffuse, steps: 3}]"), [dataset], out, device=CPU)
    _predict_nan(trainer, call=2)
    with pytest.raises(NonFiniteError, match=r"diffuse, step 1: .*total = nan"):
        trainer.run()
    (saved,) = out.glob("bad_batch_step1_rank0.safetensors")
    batch = load_file(saved)
    assert batch["beauty"].shape == (2, 3, 32, 32) and torch.isfinite(batch["beauty"]).all()


def test_the_batch_of_a_non_finite_loss_has_all_micro_batches(dataset, tmp_path):
    config = _config("phases=[{name: diffuse, steps: 1}]", "accumulation=2")
    trainer = Trainer(config, [dataset], tmp_path / "run", device=CPU)
    _predict_nan(trainer, call=1)
    with pytest.raises(NonFiniteError, match="total = nan"):
        trainer.run()
    batch = load_file(tmp_path / "run" / "bad_batch_step0_rank0.safetensors")
    used = [crop for micro in trainer.context.plan(0, 0, 1) for crop in micro]
    assert batch["sample_id"].tolist() == used and len(used) == 4


def test_weights_that_diverge_in_the_last_step_stop_the_run(dataset, tmp_path):
    rates = ("learning_rate=1e38", "final_learning_rate=null")
    config = _config("phases=[{name: diffuse, steps: 1}]", "validation.num_panels=0", *rates)
    with pytest.raises(NonFiniteError, match="diffuse, step 1: validation errors are not finite"):
        Trainer(config, [dataset], tmp_path / "run", device=CPU).run()


def test_bad_views_stop_or_are_counted(dataset, tmp_path):
    def spoil(buffers, record):
        if record["index"] == 1:
            buffers["roughness"] = buffers["roughness"] * np.nan

    bad = make_dataset(tmp_path / "bad", {"room-0": ("train", 4)}, change=spoil)
    settings = ("phases=[{name: diffuse, steps: 4}]", "validation.num_views=0")
    with pytest.raises(InputError, match=r"room-0/view-001: roughness"):
        Trainer(_config(*settings), [bad], tmp_path / "a", device=CPU).run()
    with pytest.raises(InputError, match=r"room-0/view-001: roughness"):
        Trainer(_config(*settings, "data.workers=1"), [bad], tmp_path / "w", device=CPU).run()
    trainer = Trainer(_config(*settings, "data.on_bad_view=skip"), [bad], tmp_path / "b", device=CPU)
    trainer.run()
    assert trainer.progress.num_skipped == 2  # both crops of the bad view, once an epoch


def test_bad_validation_views_stop_a_run_before_it_starts_or_are_skipped(tmp_path):
    def spoil(buffers, record):
        if record["split"] == "validation" and record["index"] == 1:
            buffers["roughness"] = buffers["roughness"] * np.nan

    splits = {"room-0": ("train", 4), "room-1": ("validation", 2)}
    data = make_dataset(tmp_path / "set", splits, change=spoil)
    short = "phases=[{name: diffuse, steps: 1}]"
    with pytest.raises(InputError, match=r"room-1/view-001: roughness"):
        Trainer(_config(short), [data], tmp_path / "run", device=CPU)
    trainer = Trainer(_config(short, "data.on_bad_view=skip"), [data], tmp_path / "run", device=CPU)
    trainer.run()
    assert [place.name for place in trainer.validation_views] == ["room-1/view-000"]
    assert len(read_log(tmp_path / "run", "validation", "score")) == 1


def test_bfloat16_channels_last_and_checkpoint_start(dataset, tmp_path):
    settings = ("phases=[{name: joint, steps: 2}]", "precision=bfloat16", "channels_last=true")
    final = Trainer(_config(*settings), [dataset], tmp_path / "a", device=CPU).run()
    again = (*settings, f"initial_checkpoint={final}")
    trainer = Trainer(_config(*again), [dataset], tmp_path / "b", device=CPU)
    first = load_checkpoint(final).network.state_dict()
    assert all(torch.equal(v, first[n]) for n, v in trainer.models.network.state_dict().items())
    with pytest.raises(InputError, match="network"):
        wider = _config(*again, "network.base_channels=8")
        Trainer(wider, [dataset], tmp_path / "c", device=CPU)


def test_unknown_settings_are_refused(tmp_path):
    with pytest.raises(InputError, match="batchsize"):
        _config("batchsize=3")
    with pytest.raises(InputError, match="KEY=VALUE"):
        parse_overrides(["batch_size"])
    with pytest.raises(InputError, match="epochs or steps"):
        _config("phases=[{name: diffuse}]")
    with pytest.raises(InputError, match=r"adam_betas\[1\] = 1\.0; expected .*less than 1"):
        _config("adam_betas=[0.9, 1.0]")
    with pytest.raises(InputError, match=r"expected a light or a weight above 0"):
        _config("loss={num_point_lights: 0, num_area_lights: 0, map_l1_weight: 0, perceptual_weight: 0}")
    with pytest.raises(InputError, match="--preset"):
        resolve_config("large")
    file = tmp_path / "c.yaml"
    file.write_text("seed: 2020-13-01")
    for settings in (lambda: resolve_config("smoke", file), lambda: parse_overrides(["seed=2020-13-01"])):
        with pytest.raises(InputError, match="month must be in"):
            settings()
    file.write_text("batch_size: 3\ndata: {workers: 0}\n")
    config = resolve_config("smoke", file, {"data": {"crop_px": 48}})
    assert (config.batch_size, config.data.crop_px, config.data.crops_per_view) == (3, 48, 2)


def test_presets_are_as_documented():
    paper = resolve_config("paper")
    assert (paper.learning_rate, paper.adam_betas, paper.batch_size) == (2e-5, (0.5, 0.999), 8)
    assert (paper.data.crop_px, paper.data.crops_per_view) == (256, 7)
    assert [p.epochs for p in paper.phases] == [15, 15, 15, None]
    assert (paper.loss.num_point_lights, paper.loss.num_area_lights, paper.loss.map_l1_weight) == (3, 3, 0.1)
    assert paper.perceptual.kind == "elpips"


def test_overfitting_one_view_reaches_near_zero_error(tmp_path):
    """Trained on one view, every map's error falls near zero, far below that of a constant prediction."""
    folder = make_dataset(tmp_path / "set", {"room-0": ("train", 1)}, width=32, height=32)
    config = _config(
        "phases=[{name: joint, steps: 160}]",
        "network={base_channels: 16, global_channels: 32, dropout: 0.0}",
        "data={crop_px: 32, crops_per_view: 1, flips: false, exposure_jitter_stops: 0.0, workers: 0}",
        "batch_size=1",
        "learning_rate=1e-3",
        "loss={map_l1_weight: 1.0, num_point_lights: 1, num_area_lights: 0}",
        "validation.num_views=0",
        "checkpoint_every_steps=1000",
        "log_every_steps=20",
    )
    trainer = Trainer(config, [folder], tmp_path / "run", device=CPU)
    trainer.run()
    batches = list(whole_views(trainer.data.train, buffer_names(config.network), CPU))
    network = load_checkpoint(tmp_path / "run" / "final.safetensors").network
    ours = evaluate(network_predictor(network, ("diffuse", "specular")), batches)
    constant = evaluate(constant_predictor(mean_maps(batches)), batches)
    for name in ("diffuse_albedo", "specular_albedo", "roughness"):
        assert ours[f"{name}_mse"] < 0.2 * constant[f"{name}_mse"]
        assert ours[f"{name}_mse"] < 1e-3


@pytest.mark.slow
def test_compiled_training_follows_the_eager_curve(dataset, tmp_path):
    """torch.compile changes neither the curve nor the checkpoint's names."""
    settings = ("phases=[{name: diffuse, steps: 3}]", "network.dropout=0.0", "validation.num_views=0")
    curves = {}
    for name, compiled in (("eager", "false"), ("compiled", "true")):
        out = tmp_path / name
        Trainer(_config(*settings, f"compile={compiled}"), [dataset], out, device=CPU).run()
        curves[name] = [value for _, value in read_log(out, "train", "total")]
    np.testing.assert_allclose(curves["compiled"], curves["eager"], rtol=1e-3)
    assert set(_weights(tmp_path / "eager")) == set(_weights(tmp_path / "compiled"))
