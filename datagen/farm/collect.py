# SPDX-License-Identifier: MIT
"""Gathers the manifests of a dataset folder into its index, and removes files left by killed processes.

A crash after publication of a shard, but before that of its manifest, leaves a tar file that no manifest
names; a crash before both leaves a partial file. If two processes run a unit, one may write views after the
other's commit.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

from datagen.farm.folder import DatasetFolder, PlannedUnit
from datagen.farm.status import RUNNING_AGE_S, age_of_attempt, file_system_now, names_in
from datagen.formats.base import canonical_json, sha256_file, write_bytes_atomically
from datagen.formats.configuration import Split
from datagen.formats.shard import DatasetIndex, ShardReader, ShardRecord
from datagen.foundation.durable import sync_folder
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from datagen.foundation.paths import inside
from datagen.foundation.progress import Advance, no_advance

_SHARD = re.compile(r"(?P<id>.+)-[0-9a-f]{16}\.tar")
_PARTIAL_SHARD = re.compile(r"\.(?P<id>.+)\.[0-9a-f]{12}\.partial")
_PARTIAL_MARKER = re.compile(r"\.+(?P<key>[0-9a-f]{64})\.json\.[0-9a-f]{12}\.partial(\.\d+\.partial)?")


def collect(
    root: Path,
    deep: bool = False,
    on_removed: Callable[[Path], object] = lambda path: None,
    progress: Advance = no_advance,
) -> DatasetIndex:
    """Write ``index.json`` from the manifests of finished units, and return the index.

    Unfinished units are listed in ``missing``; ``progress(done, total)`` counts units. Files left by killed
    processes are removed, and ``on_removed`` is called with each path. Raises :class:`InputError` with all
    shards that are outside the folder or, if ``deep``, whose SHA-256 differs from the manifest's.
    """
    folder = DatasetFolder(root)
    plan = folder.read_plan()
    recipe = folder.read_recipe()
    shards, missing = [], []
    problems: list[Problem] = []
    buffers: tuple[str, ...] = ()
    splits: dict[Split, int] = {}
    for number, unit in enumerate(plan.units):
        progress(number, len(plan.units))
        manifest = folder.finished(unit)
        if manifest is None:
            missing.append(unit.id)
            continue
        try:
            path = inside(root, root / manifest.shard)
        except InputError as error:
            problems += error.problems
            continue
        if deep and (digest := sha256_file(path)) != manifest.sha256:
            remedy = f"remove {manifest.shard} and run again"
            problems.append(Problem(path, "sha256", digest, manifest.sha256, remedy))
        if not buffers:
            first = next(ShardReader(path).records(), None)
            if first is None:
                remedy = f"remove {path.name} and run again"
                raise input_error(path, "", "no views", "at least one view", remedy)
            buffers = first.buffers
        splits[unit.split] = splits.get(unit.split, 0) + 1
        shards.append(
            ShardRecord(
                file=manifest.shard,
                sha256=manifest.sha256,
                num_bytes=manifest.num_bytes,
                configuration=unit.id,
                split=unit.split,
                num_views=manifest.num_views,
                seed=unit.seed,
                assets=unit.assets,
            )
        )
    progress(len(plan.units), len(plan.units))
    raise_problems(problems)
    # only folder names, since paths of the machine that made the dataset are private
    library = tuple(Path(path).name for path in recipe.library)
    weights = {Path(path).name: weight for path, weight in recipe.objects.library_weights.items()}
    objects = recipe.objects.model_copy(update={"library_weights": weights})
    index = DatasetIndex(
        recipe=recipe.model_copy(update={"library": library, "objects": objects}),
        versions=plan.versions,
        variant=plan.variant,
        num_configurations=len(shards),
        num_views=sum(shard.num_views for shard in shards),
        num_bytes=sum(shard.num_bytes for shard in shards),
        is_complete=not missing,
        missing=tuple(missing),
        splits=splits,
        buffers=buffers,
        assets={a: plan.assets[a] for a in sorted({a for shard in shards for a in shard.assets})},
        shards=tuple(shards),
    )
    write_bytes_atomically(folder.index_path, canonical_json(index))
    for path in remove_leftovers(root):
        on_removed(path)
    return index


def find_leftovers(root: Path) -> list[Path]:
    """Find unneeded files and folders of planned units that are not in progress; return sorted paths.

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
    for unit in units:
        work = folder.work_path(unit)
        if work.name in names and folder.is_done(unit) and age_of_attempt(work, now) >= RUNNING_AGE_S:
            found.append(work)
    return sorted(found)


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
    """Return whether the file ``name`` is the unit's shard or may belong to a running attempt."""
    if age_of_attempt(folder.work_path(unit), now) < RUNNING_AGE_S:
        return True
    try:
        manifest = folder.read_manifest(unit)
    except InputError:
        return True  # a damaged manifest does not identify its shard
    return manifest is not None and Path(manifest.shard).name == name
