# SPDX-License-Identifier: MIT
"""The event hook of training and inference: events that listeners receive, and failing listeners."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from datagen.foundation.errors import InputError
from model.cli import app
from model.events import Event, Listeners, load_listeners
from model.reconstruction.infer_options import InferReport, Progress
from model.training.config import resolve_config
from model.training.train import Trainer
from tests.model.training_data import make_dataset

pytestmark = pytest.mark.filterwarnings("ignore:Sparse CSR tensor support is in beta")
HEARD: list[Event] = []


def hear(event: Event) -> None:
    HEARD.append(event)


def test_listeners_get_the_entries_of_the_log(tmp_path: Path) -> None:
    data = make_dataset(tmp_path / "set", {"room-0": ("train", 4), "room-1": ("validation", 2)})
    HEARD.clear()
    listeners = load_listeners([f"{__name__}:hear"])
    Trainer(
        resolve_config("smoke"), [data], tmp_path / "run", device=torch.device("cpu"), listeners=listeners
    ).run()
    with (tmp_path / "run" / "log.csv").open() as file:
        logged = {
            (int(r["step"]), f"{r['kind']}/{r['phase']}", r["name"], float(r["value"]))
            for r in csv.DictReader(file)
        }
    received = {
        (e.step, e.name, name, value)
        for e in HEARD
        if e.kind == "scalars"
        for name, value in e.values.items()
    }
    assert received == logged and len(received) > 20
    images = [event.image for event in HEARD if event.kind == "image"]
    assert images and all(i.dtype == np.uint8 and i.shape[2] == 3 for i in images)
    assert [(e.kind, e.source, e.folder) for e in HEARD[-1:]] == [("end", "train", tmp_path / "run")]


def test_a_failing_listener_is_reported_and_dropped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = []

    def broken(event: Event) -> None:
        calls.append(event)
        raise ConnectionError("the server is gone")

    HEARD.clear()
    listeners = Listeners([broken, hear])
    for step in range(3):
        listeners.tell(Event("train", "scalars", tmp_path, "train/joint", step, {"loss": 1.0}))
    assert len(calls) == 1 and [event.step for event in HEARD] == [0, 1, 2]
    output = capsys.readouterr().err
    assert "broken failed and is not called again" in output and "the server is gone" in output


@pytest.mark.parametrize("quiet", [(), ("--quiet",)])
def test_inference_reports_its_stages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quiet: tuple[str, ...]
) -> None:
    def infer(capture: object, out: Path, source: object, options: object, progress: Progress) -> InferReport:
        for done in range(3):
            progress("trace", done, 2)
        return InferReport("room", 2, 1, seconds={"trace": 1.5, "merge": 2.5})

    monkeypatch.setattr("model.reconstruction.infer.infer", infer)
    monkeypatch.setattr("model.reconstruction.captures.read.read_capture", lambda *arguments: None)
    HEARD.clear()
    command = ["infer", "room", "--out", str(tmp_path), "--truth", "--listener", f"{__name__}:hear", *quiet]
    CliRunner().invoke(app, command, catch_exceptions=True)
    stages = [(e.name, e.step, e.values["total"]) for e in HEARD if e.kind == "progress"]
    assert stages == [("trace", 0, 2), ("trace", 1, 2), ("trace", 2, 2)]
    assert HEARD[-1].kind == "end" and HEARD[-1].values == {"seconds": 4.0} and HEARD[-1].folder == tmp_path


def test_all_unresolvable_names_are_refused_at_once() -> None:
    with pytest.raises(InputError) as caught:
        load_listeners(["no_such_module:f", "json:no_such_function", "json", "json:decoder", "./f.py:f"])
    assert len(caught.value.problems) == 5
    assert all(problem.expected == "MODULE:FUNCTION" for problem in caught.value.problems)
