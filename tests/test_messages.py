# SPDX-License-Identifier: MIT
"""Messages: empty files are called empty, differing documents are listed by field, ids are not truncated."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from datagen.formats.base import canonical_json, differences, read_json
from datagen.formats.capture import CaptureFile
from datagen.formats.package import open_package
from datagen.formats.shard import ShardReader
from datagen.foundation.errors import InputError, Problem
from datagen.foundation.images import image_size, read_image
from datagen.foundation.meshes.ply import read_ply
from datagen.foundation.progress import table_console
from datagen.importers.common import ImportOptions
from datagen.importers.dispatch import import_asset
from datagen.inspection.commands import library
from datagen.library import describe_library
from model.checkpoint import DataRecord, read_card
from model.reconstruction.captures.mesh_file import load_mesh
from model.reconstruction.captures.photograph_files import read_photograph
from model.reconstruction.captures.read import read_capture
from model.training.config import resolve_config
from model.training.run_folder import RunRecord, check_same_run


def _import(path: Path) -> object:
    return import_asset(path, path.parent / "library", ImportOptions(license="CC0-1.0"))


READERS: tuple[tuple[str, Callable[[Path], object]], ...] = (
    ("a.glb", _import),
    ("a.gltf", _import),
    ("scene.xml", _import),
    ("a.sh3f", _import),
    ("a.zip", open_package),
    ("a.ply", read_ply),
    ("a.glb", load_mesh),
    ("a.obj", load_mesh),
    ("a.png", read_image),
    ("a.exr", read_image),
    ("a.png", image_size),
    ("a.webp", read_photograph),
    ("a.tar", lambda path: list(ShardReader(path).records())),
    ("a.json", lambda path: read_json(CaptureFile, path)),
    ("transforms.json", read_capture),
    ("cameras.xml", read_capture),
    ("a.safetensors", read_card),
)


@pytest.mark.parametrize(("name", "read"), READERS, ids=lambda x: x if isinstance(x, str) else "")
def test_an_empty_file_is_called_empty(tmp_path: Path, name: str, read: Callable[[Path], object]) -> None:
    """Regression: the message for a .glb was "Expecting value: line 1 column 1 (char 0)"."""
    (tmp_path / name).touch()
    with pytest.raises(InputError, match=rf"{name}: an empty file; expected .*; \w+") as caught:
        read(tmp_path / name)
    assert len(caught.value.problems) == 1


@pytest.mark.parametrize("data", [b"glTF", b"glTF\x02\0\0\0\x0c\0\0\0"])
def test_a_glb_that_ends_after_its_header_is_truncated(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.glb").write_bytes(data)
    with pytest.raises(InputError, match=r"a \.glb without its JSON chunk"):
        load_mesh(tmp_path / "a.glb")


def test_an_empty_glb_is_not_reported_as_json(tmp_path: Path) -> None:
    (tmp_path / "a.glb").touch()
    with pytest.raises(InputError, match=r"a\.glb: an empty file; expected an intact \.glb file; export"):
        load_mesh(tmp_path / "a.glb")


def test_fields_of_an_empty_file_are_kept(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").touch()
    error = InputError(Problem(tmp_path / "a.yaml", "name"), Problem("here", "", "nothing"))
    assert [problem.got for problem in error.problems] == ["", "nothing"]


def test_repeated_problems_are_reported_once() -> None:
    error = InputError(Problem("a", "b", "c"), Problem("a", "b", "d"), Problem("a", "b", "c"))
    assert [problem.got for problem in error.problems] == ["c", "d"]


def test_differences_are_reported_per_leaf() -> None:
    """Regression: for a difference in one field, the whole dictionary was printed."""
    old = {"name": "a", "render": {"path_samples": 4, "quality": None, "error": {"a": 1}}, "sizes": [1, 2]}
    new = {"name": "a", "render": {"path_samples": 8, "quality": "draft", "error": {"a": 1}}, "sizes": [1, 3]}
    assert differences(old, new) == [
        ("render.path_samples", "4", "8"),
        ("render.quality", "nothing", "draft"),
        ("sizes", "[1, 2]", "[1, 3]"),
    ]
    assert differences({"a": [{"b": 1}, {"b": 2}]}, {"a": [{"b": 1}, {"b": 3}]}) == [("a[1].b", "2", "3")]
    assert differences({"a": {"b": 1}}, {"c": 2}) == [("a", "{'b': 1}", "nothing"), ("c", "nothing", "2")]
    long = differences({"a": list(range(10_000))}, {"a": []})
    assert len(long[0][1]) < 200


def test_another_run_of_training_names_the_differing_fields(tmp_path: Path) -> None:
    """Regression: only "config" was named."""
    data = DataRecord(name="d", index_sha256="a", num_views=1, assets={"mug": "1"})
    record = RunRecord(config=resolve_config("smoke"), folders=("d",), data=(data,), loss="l", num_ranks=1)
    path = tmp_path / "run.json"
    path.write_bytes(canonical_json(record))
    check_same_run(path, record)
    other = resolve_config("smoke", overrides={"seed": 7})
    now = data.model_copy(update={"index_sha256": "b", "assets": {"mug": "2"}})
    with pytest.raises(InputError) as caught:
        check_same_run(path, record.model_copy(update={"config": other, "data": (now,)}))
    assert {p.field for p in caught.value.problems} == {"config.seed", "data[0].index_sha256"}
    assert "config.seed = 7; expected 0, as when the run started" in str(caught.value)


def test_ids_are_not_truncated_in_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    """Regression: ids were truncated at 80 columns."""
    library(["bundled"])
    text = capsys.readouterr().out
    from datagen.foundation.bundled import bundled_library

    lines = [line for line in text.splitlines() if line.count("│") == 6]
    for summary in describe_library([bundled_library()]):
        (line,) = [line for line in lines if line.split("│")[2].strip() == summary.id]
        assert summary.detail in line and summary.license in line
    assert "…" not in text


def test_ids_are_folded_on_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Console, "is_terminal", property(lambda self: True))
    narrow = table_console()
    assert narrow.width < 1000
    monkeypatch.setattr(Console, "is_terminal", property(lambda self: False))
    wide = table_console()
    with wide.capture() as capture:
        wide.print(Table("x" * 300))
    assert "x" * 300 in capture.get()
