# SPDX-License-Identifier: MIT
"""Durability: content is synced before it gets its final name, and the name before files that refer to it.

A recorder wraps the system calls and records the file or folder of each.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from blender_addon.write import PackageWriter
from datagen.farm.folder import DatasetFolder
from datagen.farm.local import LocalOptions, run_local
from datagen.farm.work_unit import UnitRun, run_unit
from datagen.formats.base import write_bytes_atomically
from datagen.formats.package import open_package, write_package
from datagen.foundation.durable import make_folder, publish, publish_first, sync_folder
from datagen.library import Library
from tests.datagen.small_library import write_small_library
from tests.datagen.small_plan import plan_small

Event = tuple[str, str]


class Recorder:
    """Wrapper of system calls that records the events ``sync``, ``name`` (rename or link) and ``remove``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        self.events: list[Event] = []
        self.unsynced_names: list[str] = []
        self._synced: set[int] = set()
        fsync, rmtree = os.fsync, shutil.rmtree

        def noted_fsync(descriptor: int) -> None:
            fsync(descriptor)
            self._synced.add(os.fstat(descriptor).st_ino)
            self.events.append(("sync", str(Path(f"/proc/self/fd/{descriptor}").readlink())))

        def noted_rmtree(path: Path, ignore_errors: bool = False) -> None:
            self.events.append(("remove", str(path)))
            rmtree(path, ignore_errors=ignore_errors)

        monkeypatch.setattr(os, "fsync", noted_fsync)
        monkeypatch.setattr(shutil, "rmtree", noted_rmtree)
        monkeypatch.setattr(os, "link", self._naming(os.link))
        for name in ("replace", "rename"):
            monkeypatch.setattr(Path, name, self._naming(getattr(Path, name)))

    def _naming(self, call: Callable[[Path, Path], object]) -> Callable[[Path, Path], None]:
        def noted(source: Path, target: Path) -> None:
            if not self._is_on_disk(Path(source)):
                self.unsynced_names.append(str(target))
            call(source, target)
            self.events.append(("name", str(target)))

        return noted

    def _is_on_disk(self, path: Path) -> bool:
        below = path.rglob("*") if path.is_dir() else ()
        return all(p.stat().st_ino in self._synced for p in (path, *below))

    def names(self) -> list[str]:
        return [path for kind, path in self.events if kind == "name"]

    def check(self) -> None:
        """Assert that content is synced before it is named, and its folder before anything else is named."""
        assert not self.unsynced_names
        pending: str | None = None
        for kind, path in self.events:
            if kind == "name":
                assert pending is None, f"{path} was named while {pending} might be lost"
                pending = path
            elif kind == "sync" and pending is not None and path == str(Path(pending).parent):
                pending = None
        assert pending is None, f"the name of {pending} might be lost"


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    return Recorder(monkeypatch)


def test_a_file_is_synced_before_its_name_and_its_folder_after(tmp_path: Path, recorder: Recorder) -> None:
    write_bytes_atomically(tmp_path / "a.json", b"{}")
    recorder.check()
    assert [kind for kind, _ in recorder.events] == ["sync", "name", "sync"]
    assert recorder.events[-1] == ("sync", str(tmp_path))


def test_only_the_first_of_two_names_is_published(tmp_path: Path, recorder: Recorder) -> None:
    for name in ("one", "other"):
        (tmp_path / name).write_text(name)
    publish_first(tmp_path / "one", tmp_path / "target")
    recorder.check()
    with pytest.raises(FileExistsError):
        publish_first(tmp_path / "other", tmp_path / "target")
    assert (tmp_path / "target").read_text() == "one"


def test_a_folder_is_synced_with_all_its_contents(tmp_path: Path, recorder: Recorder) -> None:
    (tmp_path / "partial" / "deep").mkdir(parents=True)
    (tmp_path / "partial" / "deep" / "file").write_text("x")
    publish(tmp_path / "partial", tmp_path / "whole")
    recorder.check()
    assert len(recorder.events) == 5


def test_new_folders_are_synced(tmp_path: Path, recorder: Recorder) -> None:
    make_folder(tmp_path / "a" / "b")
    make_folder(tmp_path / "a" / "b")
    assert recorder.events == [("sync", str(tmp_path)), ("sync", str(tmp_path / "a"))]


def test_packages_are_written_durably(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_small_library(tmp_path / "library")
    package = Library([tmp_path / "library"]).select("environment")[0]
    recorder = Recorder(monkeypatch)
    for name in ("room", "room.zip", "room"):  # the third replaces the first
        write_package(
            tmp_path / name,
            package.asset,
            {f: package.local_file(f) for f in package.names()},
            overwrite=True,
        )
    recorder.unsynced_names = [n for n in recorder.unsynced_names if not n.endswith(".old")]
    recorder.events = [event for event in recorder.events if not event[1].endswith(".old")]
    recorder.check()
    assert open_package(tmp_path / "room").sha256 == package.sha256


def test_packages_of_the_blender_extension_are_written_durably(tmp_path: Path, recorder: Recorder) -> None:
    with PackageWriter(tmp_path / "cup") as writer:
        writer.add("textures", "a", ".bin", b"content")
    recorder.check()
    assert recorder.names() == [str(tmp_path / "cup")]


def test_a_shard_is_synced_before_its_marker_and_the_work_removed_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = plan_small(tmp_path / "set", tmp_path / "library", num_units=1)
    run_local(folder.root, LocalOptions(stages=("render", "stats")))
    recorder = Recorder(monkeypatch)
    assert run_unit(_attempt(folder), ("pack",))
    recorder.check()
    kinds = [Path(name).suffix for name in recorder.names()]
    assert kinds == [".tar", ".partial", ".json"], "the shard, the marker beside, the marker"
    assert folder.is_done(folder.read_plan().units[0])
    shard, marker = recorder.names()[0], recorder.names()[-1]
    expected = [
        ("sync", str(folder.root)),  # the new folder of shards
        ("name", shard),
        ("sync", str(folder.shards_path)),
        ("name", marker),
        ("sync", str(folder.units_path)),
        ("remove", str(folder.work_path(folder.read_plan().units[0]))),
    ]
    rest = iter(recorder.events)
    assert all(event in rest for event in expected), "in this order"


def _attempt(folder: DatasetFolder) -> UnitRun:
    plan = folder.read_plan()
    library = Library([Path(path) for path in folder.read_record().library_paths])
    recipe = folder.read_recipe()
    return UnitRun(folder, plan.units[0], recipe, library, plan.versions, plan.variant)


def test_a_finished_view_is_synced_before_its_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = plan_small(tmp_path / "set", tmp_path / "library", num_units=1)
    run_local(folder.root, LocalOptions(stages=("render",)))
    attempt = _attempt(folder)
    record = attempt.read_record(attempt.rendered_path, "view-000")
    assert record is not None
    recorder = Recorder(monkeypatch)
    attempt.publish(attempt.rendered_path, record, {"depth_z_m": np.zeros((4, 4, 1), np.float32)}, "none")
    recorder.check()
    assert [Path(name).suffix for name in recorder.names()] == [".exr", ".json"]


def _failing_for(kind: Callable[[int], bool], code: int) -> Callable[[int], None]:
    def fsync(descriptor: int) -> None:
        if kind(os.fstat(descriptor).st_mode):
            raise OSError(code, os.strerror(code))

    return fsync


def test_file_systems_without_folder_sync_are_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", _failing_for(stat.S_ISDIR, errno.EINVAL))
    write_bytes_atomically(tmp_path / "a", b"a")
    sync_folder(tmp_path)
    monkeypatch.setattr(os, "fsync", _failing_for(stat.S_ISDIR, errno.EIO))
    with pytest.raises(OSError, match="Input/output error"):
        sync_folder(tmp_path)


def test_unsynced_content_gets_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", _failing_for(stat.S_ISREG, errno.EIO))
    with pytest.raises(OSError, match="Input/output error"):
        write_bytes_atomically(tmp_path / "a", b"a")
    assert list(tmp_path.iterdir()) == []
