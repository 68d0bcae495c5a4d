# SPDX-License-Identifier: MIT
"""The preview page of a run shows the latest views, even once packed, and rate, time left and failures."""

from __future__ import annotations

import base64
import io
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from datagen.cli import app
from datagen.farm.local import LocalOptions, RunSummary
from datagen.inspection import preview
from datagen.inspection.preview import Preview
from tests.datagen.small_dataset import make_configuration, make_view_files
from tests.datagen.small_plan import plan_small


def _render(root: Path, num_views: int, unit: str = "small-00000-k") -> Path:
    folder = root / "work" / unit / "rendered"
    folder.mkdir(parents=True, exist_ok=True)
    make_view_files(folder, make_configuration(num_views))
    return folder


def _pictures(page: str) -> dict[str, np.ndarray]:
    found = re.findall(r'<img alt="([^"]*)" src="data:image/jpeg;base64,([^"]*)"', page)
    return {name: np.array(Image.open(io.BytesIO(base64.b64decode(data)))) for name, data in found}


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(preview.time, "monotonic", lambda: now[0])
    return now


def test_the_page_shows_pictures_rate_and_time_left(tmp_path: Path, clock: list[float]) -> None:
    page = Preview(tmp_path, total=100, before=10)
    page.update(10)
    assert _pictures(page.path.read_text()) == {} and "10 of 100 views" in page.path.read_text()
    folder = _render(tmp_path, 3)
    clock[0] = 60.0
    page.update(40)
    text = page.path.read_text()
    assert "40 of 100 views, 1,800 per hour, 2 min left" in text  # 30 views in a minute, 60 left
    assert 'http-equiv="refresh"' in text
    shown = _pictures(text)
    assert list(shown) == [f"small-00000 / view-00{k}" for k in (2, 1, 0)]
    assert all(picture.shape == (24, 40, 3) and picture.std() > 5 for picture in shown.values())
    shutil.rmtree(folder.parent)  # as packing does
    clock[0] = 120.0
    page.update(100, is_over=True)
    text = page.path.read_text()
    assert len(_pictures(text)) == 3 and "the run has ended" in text and "refresh" not in text


def test_views_of_earlier_runs_are_not_shown_as_new(tmp_path: Path, clock: list[float]) -> None:
    _render(tmp_path, 2)
    page = Preview(tmp_path, 4, 2)
    page.update(2)
    assert _pictures(page.path.read_text()) == {}


def test_the_page_is_written_at_intervals(tmp_path: Path, clock: list[float]) -> None:
    page = Preview(tmp_path, 4)
    page.update(0)
    clock[0] = 1.0
    page.update(1)
    assert "0 of 4 views" in page.path.read_text()
    clock[0] = 4.0
    page.update(1)
    assert "1 of 4 views" in page.path.read_text()


def test_a_missing_or_damaged_view_is_skipped(tmp_path: Path, clock: list[float]) -> None:
    page = Preview(tmp_path, 3)
    folder = _render(tmp_path, 3)
    (folder / "view-001.exr").write_bytes(b"x")
    (folder / "view-002.exr").unlink()
    page.update(1)
    assert list(_pictures(page.path.read_text())) == ["small-00000 / view-000"]


def test_a_unit_may_be_packed_while_its_views_are_listed(
    tmp_path: Path, clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Preview(tmp_path, 4)
    _render(tmp_path, 2, "small-00000-k")
    packed = _render(tmp_path, 2, "small-00001-k")
    scandir = os.scandir

    def packs(path: object) -> object:
        if isinstance(path, str | Path) and Path(path) == packed:
            shutil.rmtree(packed.parent)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", packs)
    page.update(2)
    assert not packed.exists() and len(_pictures(page.path.read_text())) == 2


def test_failures_are_shown_as_text(tmp_path: Path, clock: list[float]) -> None:
    page = Preview(tmp_path, 3)
    page.say("unit-1 is tried again (1/3): <b>no room</b> & more")
    page.update(0)
    assert "&lt;b&gt;no room&lt;/b&gt; &amp; more" in page.path.read_text()


def test_the_command_writes_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stub of the local engine provides rendered views and reports a retry."""
    folder = plan_small(tmp_path / "set", tmp_path / "library", 1, 3)

    def run_local(out: Path, options: LocalOptions, on_event) -> RunSummary:
        _render(out, 3)
        for event in (("progress", "small-00000", "render", 3, 3), ("retry", "small-00000", "killed", 1, 3)):
            on_event(event)
        on_event(("done", "small-00000", "", 0, 0))
        return RunSummary(done=["small-00000"], interrupted=False)

    monkeypatch.setattr("datagen.farm.local.run_local", run_local)
    monkeypatch.setattr("datagen.run_command.plan_recipe", lambda *arguments: None)
    monkeypatch.setattr(
        "datagen.farm.collect.collect", lambda *arguments: (_ for _ in ()).throw(SystemExit(0))
    )
    result = CliRunner().invoke(
        app, ["run", "smoke", "--out", str(folder.root), "--preview", "--no-space-check"]
    )
    assert "preview: file://" in result.output
    text = (folder.root / "preview.html").read_text()
    assert len(_pictures(text)) == 3
    assert "3 of 3 views" in text and "is tried again (1/3): killed" in text and "the run has ended" in text
