# SPDX-License-Identifier: MIT
"""Gathers the manifests of a dataset folder into its index."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from datagen.farm.folder import DatasetFolder, UnitManifest
from datagen.farm.leftovers import remove_leftovers
from datagen.formats.base import canonical_json, sha256_file, write_bytes_atomically
from datagen.formats.configuration import Split
from datagen.formats.shard import DatasetIndex, ShardReader, ShardRecord
from datagen.formats.view import ViewRecord
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from datagen.foundation.paths import inside
from datagen.foundation.progress import Advance, no_advance


def collect(
    root: Path,
    deep: bool = False,
    on_removed: Callable[[Path], object] = lambda path: None,
    progress: Advance = no_advance,
) -> DatasetIndex:
    """Write ``index.json`` from the manifests of finished units, and return the index.

    Unfinished units are listed in ``missing``; ``progress(done, total)`` counts units. Files left by killed
    attempts are removed, and ``on_removed`` is called with each path. Raises :class:`InputError` with all
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
            inside(root, root / manifest.shard)
        except InputError as error:
            problems += error.problems
            continue
        if deep:
            problems += _check_hash(folder, manifest)
        if not buffers:
            buffers = _first_record(root / manifest.shard).buffers
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


def _first_record(shard: Path) -> ViewRecord:
    for record in ShardReader(shard).records():
        return record
    raise input_error(shard, "", "no views", "at least one view", f"remove {shard.name} and run again")


def _check_hash(folder: DatasetFolder, manifest: UnitManifest) -> list[Problem]:
    got = sha256_file(folder.root / manifest.shard)
    if got == manifest.sha256:
        return []
    remedy = f"remove {manifest.shard} and run again"
    return [Problem(folder.root / manifest.shard, "sha256", got, manifest.sha256, remedy)]
