# SPDX-License-Identifier: MIT
"""Plans a dataset folder from a recipe, by writing all configurations and then the list of units."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import yaml

from datagen.assembly.generated import room_of
from datagen.assembly.notes import notes_before
from datagen.assembly.plan import NUM_TRIES, assemble, configuration_id
from datagen.assembly.splits import check_recipe
from datagen.farm.folder import DatasetFolder, FolderRecord, Plan, PlannedUnit, rooms_of, unit_key
from datagen.formats.base import canonical_json, read_json, sha256_hex, write_bytes_atomically
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import Recipe
from datagen.formats.shard import AssetRecord
from datagen.foundation.errors import InputError
from datagen.foundation.progress import Advance, no_advance
from datagen.foundation.versions import pixel_versions
from datagen.library import Library
from mitsuba_plugins.variant import check_variant, resolve_variant


def check_start(recipe: Recipe, library: Library) -> None:
    """Raise :class:`InputError` for faults of recipe, library or Mitsuba variant before work starts."""
    check_recipe(recipe, library)
    check_variant(recipe.render.variant)


def start_folder(recipe: Recipe, library: Library, root: Path) -> DatasetFolder:
    """Create or reopen a dataset folder. Raises :class:`InputError` if it was started with other inputs."""
    folder = DatasetFolder(root)
    record = FolderRecord(
        recipe_sha256=sha256_hex(canonical_json(recipe)),
        library_sha256=library.sha256,
        library_paths=tuple(str(path) for path in library.paths),
        versions=pixel_versions(has_light=recipe.statistics.light),
    )
    root.mkdir(parents=True, exist_ok=True)
    folder.check_same_start(recipe, record)
    write_bytes_atomically(folder.record_path, canonical_json(record))
    text = yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    write_bytes_atomically(folder.recipe_path, text.encode())
    folder.configuration_path("x").parent.mkdir(exist_ok=True)
    return folder


_opened = cache(Library)
"""Function that opens a library, memoised by its paths in each process that assembles configurations."""


def _assemble_one(recipe: Recipe, library_paths: tuple[Path, ...], folder: DatasetFolder, index: int) -> None:
    configuration = assemble(recipe, index, _opened(library_paths))
    room = room_of(recipe, configuration, NUM_TRIES)
    if room is not None:
        write_bytes_atomically(folder.room_path(room.package.id), room.data, parents=True)
    write_bytes_atomically(folder.configuration_path(configuration.id), canonical_json(configuration))


def create_plan(
    recipe: Recipe,
    library: Library,
    root: Path,
    workers: int = 1,
    report: Advance = no_advance,
    tell: Callable[[str], None] = lambda note: None,
) -> Plan:
    """Assemble the missing configurations and write the plan; if there is already a plan, return it.

    ``report(done, total)`` is called for each assembled configuration, ``tell`` for each note of
    :func:`notes_before`. Raises :class:`InputError` for faults of recipe, library or folder.
    """
    if not DatasetFolder(root).plan_path.exists():
        check_start(recipe, library)  # before any file is written
    for note in notes_before(recipe, library):
        tell(note)
    folder = start_folder(recipe, library, root)
    if folder.plan_path.exists():
        return folder.read_plan()
    missing = [i for i in range(recipe.configurations) if not _is_assembled(folder, recipe, library, i)]
    done = recipe.configurations - len(missing)
    report(done, recipe.configurations)
    for _ in _assembled(recipe, library.paths, folder, missing, workers):
        done += 1
        report(done, recipe.configurations)
    return write_plan(folder, recipe, library)


def _assembled(
    recipe: Recipe, library_paths: tuple[Path, ...], folder: DatasetFolder, indices: list[int], workers: int
) -> Iterator[None]:
    """Assemble configurations, in this process or in parallel in worker processes; yield after each."""
    num_workers = min(workers, len(indices))
    if num_workers <= 1:
        for index in indices:
            _assemble_one(recipe, library_paths, folder, index)
            yield
        return
    with ProcessPoolExecutor(num_workers, get_context("spawn")) as pool:
        futures = [pool.submit(_assemble_one, recipe, library_paths, folder, index) for index in indices]
        try:
            for future in as_completed(futures):
                future.result()
                yield
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def read_configurations(root: Path, plan: Plan) -> Iterator[Configuration]:
    """Yield the configurations of the dataset folder ``root``, in the plan's order."""
    yield from map(DatasetFolder(root).read_configuration, plan.units)


def _is_assembled(folder: DatasetFolder, recipe: Recipe, library: Library, index: int) -> bool:
    path = folder.configuration_path(configuration_id(recipe, index))
    if not path.exists():
        return False
    try:
        configuration = read_json(Configuration, path)
        room = configuration.environment.asset
        return configuration.index == index and (room in library or folder.room_path(room).exists())
    except InputError:
        return False  # damaged, so assembled again


def write_plan(folder: DatasetFolder, recipe: Recipe, library: Library) -> Plan:
    """Write ``plan.json`` from the configurations on disk, and return the plan."""
    versions = pixel_versions(has_light=recipe.statistics.light)
    variant = resolve_variant(recipe.render.variant)
    units = []
    used: set[str] = set()
    for index in range(recipe.configurations):
        path = folder.configuration_path(configuration_id(recipe, index))
        configuration = read_json(Configuration, path)
        used.update(configuration.assets)
        units.append(
            PlannedUnit(
                index=index,
                id=configuration.id,
                split=configuration.split,
                key=unit_key(configuration, recipe, variant, versions),
                num_views=len(configuration.cameras),
                seed=configuration.seed,
                assets=tuple(sorted(configuration.assets)),
            )
        )
    assets = {}
    rooms = rooms_of(folder.root)
    whole = Library([*library.paths, *rooms]) if rooms else library
    for asset_id in sorted(used):
        package = whole.package(asset_id)
        provenance = package.asset.provenance
        assets[asset_id] = AssetRecord(
            kind=package.asset.kind,
            sha256=package.sha256,
            license=provenance.license,
            author=provenance.author,
            source=provenance.source,
        )
    plan = Plan(variant=variant, versions=versions, assets=assets, units=tuple(units))
    write_bytes_atomically(folder.plan_path, canonical_json(plan))
    return plan
