# SPDX-License-Identifier: MIT
"""Finds and removes the files that killed attempts left in a dataset folder.

A crash between publication of a shard and its manifest leaves a tar file that no manifest names; an earlier
crash leaves a partial one. A second process on a unit may write views after the first has committed it.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

from datagen.farm.folder import DatasetFolder, PlannedUnit
from datagen.farm.status import RUNNING_AGE_S, age_of_attempt, file_system_now, names_in
from datagen.foundation.durable import sync_folder
from datagen.foundation.errors import InputError

_SHARD = re.compile(r"(?P<id>.+)-[0-9a-f]{16}\.tar")
_PARTIAL_SHARD = re.compile(r"\.(?P<id>.+)\.[0-9a-f]{12}\.partial")
_PARTIAL_MARKER = re.compile(r"\.+(?P<key>[0-9a-f]{64})\.json\.[0-9a-f]{12}\.partial(\.\d+\.partial)?")


def find_leftovers(root: Path) -> list[Path]:
    """Sorted paths of the unneeded files and folders of planned units that are not in progress.

    Files with unknown names are ignored. Raises :class:`InputError` if there is no plan.
    """
    folder = DatasetFolder(root)
    units = folder.read_plan().units
    by_id, by_key = {unit.id: unit for unit in units}, {unit.key: unit for unit in units}
    now = file_system_now(folder)
    candidates: list[tuple[Path, PlannedUnit | None]] = []
    for name in names_in(folder.shards_path):
        if match := _SHARD.fullmatch(name) or _PARTIAL_SHARD.fullmatch(name):
            candidates.append((folder.shards_path / name, by_id.get(match["id"])))
    for name in names_in(folder.units_path):
        if match := _PARTIAL_MARKER.fullmatch(name):
            candidates.append((folder.units_path / name, by_key.get(match["key"])))
    found = [p for p, unit in candidates if unit is not None and not _is_needed(folder, unit, p.name, now)]
    names = names_in(root / "work")
    works = [unit for unit in units if folder.work_path(unit).name in names]
    return sorted([*found, *(folder.work_path(unit) for unit in works if _is_over(folder, unit, now))])


def remove_leftovers(root: Path) -> list[Path]:
    """Remove the files and folders of :func:`find_leftovers`, and return the removed paths."""
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


def _is_needed(folder: DatasetFolder, unit: PlannedUnit, name: str, now: float) -> bool:
    """Whether the file ``name`` is the unit's shard or may belong to a running attempt."""
    if age_of_attempt(folder.work_path(unit), now) < RUNNING_AGE_S:
        return True
    try:
        manifest = folder.read_manifest(unit)
    except InputError:
        return True  # a damaged manifest does not identify its shard
    return manifest is not None and Path(manifest.shard).name == name


def _is_over(folder: DatasetFolder, unit: PlannedUnit, now: float) -> bool:
    """Whether the unit is done and has no recent heartbeat."""
    return folder.is_done(unit) and age_of_attempt(folder.work_path(unit), now) >= RUNNING_AGE_S
