# SPDX-License-Identifier: MIT
"""Finds and removes the files that killed attempts left in a dataset folder.

A crash between a shard's rename and its marker leaves a tar file that no marker names; an earlier crash
leaves a partial one. A second process on a unit may write views after the first has committed the unit.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

from datagen.farm.folder import DatasetFolder, PlannedUnit
from datagen.farm.status import RUNNING_AGE_S, age_of_attempt, file_system_now
from datagen.foundation.durable import sync_folder
from datagen.foundation.errors import InputError

_SHARD = re.compile(r"(?P<id>.+)-[0-9a-f]{16}\.tar")
_PARTIAL_SHARD = re.compile(r"\.(?P<id>.+)\.[0-9a-f]{12}\.partial")
_PARTIAL_MARKER = re.compile(r"\.+(?P<key>[0-9a-f]{64})\.json\.[0-9a-f]{12}\.partial(\.\d+\.partial)?")


def find_leftovers(root: Path) -> list[Path]:
    """Unneeded files and folders of planned units that are not in progress, sorted.

    Other names than those of this project are ignored. Raises :class:`InputError` if there is no plan.
    """
    folder = DatasetFolder(root)
    units = folder.read_plan().units
    by_id, by_key = {unit.id: unit for unit in units}, {unit.key: unit for unit in units}
    now = file_system_now(folder)
    found = []
    for name in _names(folder.shards_path):
        if match := _SHARD.fullmatch(name) or _PARTIAL_SHARD.fullmatch(name):
            unit = by_id.get(match["id"])
            if unit is not None and not _is_needed(folder, unit, name, now):
                found.append(folder.shards_path / name)
    for name in _names(folder.units_path):
        if match := _PARTIAL_MARKER.fullmatch(name):
            unit = by_key.get(match["key"])
            if unit is not None and not _is_needed(folder, unit, name, now):
                found.append(folder.units_path / name)
    works = set(_names(root / "work"))
    found += [
        folder.work_path(unit)
        for unit in units
        if folder.work_path(unit).name in works and _is_over(folder, unit, now)
    ]
    return sorted(found)


def remove_leftovers(root: Path) -> list[Path]:
    """Remove the files and folders of :func:`find_leftovers`; returns the removed paths."""
    removed = []
    for path in find_leftovers(root):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)  # a slow attempt may be writing into it
        else:
            path.unlink(missing_ok=True)
        if not os.path.lexists(path):
            removed.append(path)
    for parent in {path.parent for path in removed}:
        sync_folder(parent)
    return removed


def _names(folder: Path) -> list[str]:
    try:
        return sorted(entry.name for entry in os.scandir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return []


def _is_needed(folder: DatasetFolder, unit: PlannedUnit, name: str, now: float) -> bool:
    """Whether a file is the unit's shard, or may become it while an attempt is running."""
    if age_of_attempt(folder.work_path(unit), now) < RUNNING_AGE_S:
        return True
    try:
        manifest = folder.read_manifest(unit)
    except InputError:
        return True  # a damaged marker does not identify its shard
    return manifest is not None and Path(manifest.shard).name == name


def _is_over(folder: DatasetFolder, unit: PlannedUnit, now: float) -> bool:
    """Whether the unit is done and no process is working on it."""
    return folder.is_done(unit) and age_of_attempt(folder.work_path(unit), now) >= RUNNING_AGE_S
