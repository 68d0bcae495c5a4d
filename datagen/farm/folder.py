# SPDX-License-Identifier: MIT
"""The dataset folder, with plan, work in progress, shards and manifests.

    recipe.yaml                   the resolved recipe
    dataset.json                  inputs of the folder (recipe, library, versions)
    configurations/<id>.json      one configuration each
    rooms/<id>.zip                environment packages made for this dataset (parametric rooms)
    plan.json                     the immutable list of units, written when planning is complete
    work/<id>-<key>/rendered/     rendered views without statistics (EXR and JSON)
    work/<id>-<key>/complete/     rendered views with statistics
    shards/<id>-<sha>.tar         committed shards
    units/<key>.json              manifests: a unit is done if and only if its manifest exists
    sheets/<id>.png               contact sheets
    failed/<id>.json, logs/       units that failed, and the output of their processes
    index.json                    the index, collected from the manifests

There is no other state, so any process with access to this folder can continue the work.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from datagen.formats.base import (
    RelativePath,
    Slug,
    StrictModel,
    canonical_json,
    differences,
    read_json,
    read_yaml,
    sha256_hex,
)
from datagen.formats.configuration import Configuration, Split
from datagen.formats.recipe import Recipe
from datagen.formats.shard import AssetRecord
from datagen.foundation.errors import InputError, Problem, Problems, input_error, raise_problems
from datagen.foundation.paths import inside

_NEITHER_LINKS_NOR_PIPES = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Flags to open a file without following links or waiting for pipes; 0 on Windows, which lacks them."""


class FolderRecord(StrictModel):
    """Content of ``dataset.json``, the hashes and versions of the folder's inputs, which never change."""

    format: Literal["scene-materials/folder"] = "scene-materials/folder"
    version: Literal[1] = 1
    recipe_sha256: str
    library_sha256: str
    library_paths: tuple[str, ...]
    versions: dict[str, str]


class PlannedUnit(StrictModel):
    """A unit in ``plan.json``; ``key`` is a hash of everything that affects the unit's bytes."""

    index: Annotated[int, Field(ge=0)]
    id: Slug
    split: Split
    key: Slug
    num_views: int
    seed: int
    assets: tuple[str, ...]


class Plan(StrictModel):
    """Content of ``plan.json``, the list of units with the variant, versions and assets that they use."""

    format: Literal["scene-materials/plan"] = "scene-materials/plan"
    version: Literal[1] = 1
    variant: str
    versions: dict[str, str]
    assets: dict[str, AssetRecord]
    units: tuple[PlannedUnit, ...]


class ViewTiming(StrictModel):
    """Seconds spent on one view, by stage of rendering."""

    view: str
    seconds: dict[str, float]


class UnitManifest(StrictModel):
    """Content of ``units/<key>.json``, which marks a unit as done; ``attempt`` is a random id of the run."""

    format: Literal["scene-materials/unit"] = "scene-materials/unit"
    version: Literal[1] = 1
    key: Slug
    id: Slug
    shard: RelativePath
    sha256: Annotated[str, Field(min_length=1)]
    num_bytes: int
    num_views: int
    attempt: str
    host: str
    seconds: dict[str, float]
    views: tuple[ViewTiming, ...]
    peak_memory_mb: float


class FailureRecord(StrictModel):
    """Content of ``failed/<id>.json``: a unit whose attempts all failed, its log, and a command to run it."""

    id: Slug
    index: int
    attempts: int
    reason: str
    log: RelativePath | Literal[""]
    command: str


@dataclass(frozen=True)
class _Inside:
    """Descriptor that returns the path ``name`` in the root of a :class:`DatasetFolder`."""

    name: str

    def __get__(self, folder: DatasetFolder, owner: type[DatasetFolder]) -> Path:
        return folder.root / self.name


@dataclass(frozen=True)
class DatasetFolder:
    """Paths and contents of a dataset folder; reading a faulty file raises :class:`InputError`."""

    root: Path

    recipe_path = _Inside("recipe.yaml")
    record_path = _Inside("dataset.json")
    plan_path = _Inside("plan.json")
    index_path = _Inside("index.json")
    shards_path = _Inside("shards")
    units_path = _Inside("units")
    logs_path = _Inside("logs")
    failed_path = _Inside("failed")
    rooms_path = _Inside("rooms")

    def room_path(self, asset_id: str) -> Path:
        return self.rooms_path / f"{asset_id}.zip"

    def library_paths(self) -> list[Path]:
        """Folders of the dataset's library and, if there are any, of its generated rooms."""
        return [*map(Path, self.read_record().library_paths), *rooms_of(self.root)]

    def configuration_path(self, unit_id: str) -> Path:
        return self.root / "configurations" / f"{unit_id}.json"

    def work_path(self, unit: PlannedUnit) -> Path:
        return self.root / "work" / f"{unit.id}-{unit.key[:8]}"

    def manifest_path(self, unit: PlannedUnit) -> Path:
        return self.units_path / f"{unit.key}.json"

    def read_recipe(self) -> Recipe:
        return read_yaml(Recipe, inside(self.root, self.recipe_path))

    def read_record(self) -> FolderRecord:
        return read_json(FolderRecord, inside(self.root, self.record_path))

    def read_plan(self) -> Plan:
        """Read the plan. Raises :class:`InputError` if the folder has none."""
        if not self.plan_path.is_file():
            raise input_error(
                self.plan_path, "", "no plan here", "a dataset folder with a plan", "run `datagen plan` first"
            )
        return read_json(Plan, inside(self.root, self.plan_path))

    def read_configuration(self, unit: PlannedUnit) -> Configuration:
        return read_json(Configuration, inside(self.root, self.configuration_path(unit.id)))

    def read_manifest(self, unit: PlannedUnit) -> UnitManifest | None:
        """Read the unit's manifest; None if there is none. Raises :class:`InputError` if it is damaged."""
        path = self.manifest_path(unit)
        try:  # opens the file, since network file systems cache negative look-ups
            os.close(os.open(path, os.O_RDONLY | _NEITHER_LINKS_NOR_PIPES))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise input_error(path, "", str(error), "a manifest", "remove this file") from None
        manifest = read_json(UnitManifest, path)
        if manifest.key != unit.key:
            raise input_error(path, "key", manifest.key, unit.key, "remove this file and run the unit again")
        return manifest

    def read_failure(self, unit_id: str) -> FailureRecord:
        """Read the record of a failed unit. Raises :class:`InputError` if there is none."""
        return read_json(FailureRecord, inside(self.root, self.failed_path / f"{unit_id}.json"))

    def finished(self, unit: PlannedUnit) -> UnitManifest | None:
        """Return the unit's manifest if it exists and its shard has the recorded size, else None."""
        with suppress(InputError, OSError):
            manifest = self.read_manifest(unit)
            if manifest is not None:
                status = (self.root / manifest.shard).lstat()
                if stat.S_ISREG(status.st_mode) and status.st_size == manifest.num_bytes:
                    return manifest
        return None

    def is_done(self, unit: PlannedUnit) -> bool:
        return self.finished(unit) is not None

    def check_same_start(self, recipe: Recipe, record: FolderRecord) -> None:
        """Raise :class:`InputError` unless the folder is empty or was started with these inputs."""
        if not self.record_path.exists():
            if any(not path.name.startswith(".") for path in self.root.iterdir()):
                expected = "a new or empty folder, or a dataset folder"
                raise input_error(self.root, "--out", "a folder with other files", expected, "choose another")
            return
        existing = self.read_record()
        remedy = "choose another --out, or continue with the same recipe, library and versions"
        if not self.plan_path.exists():
            remedy = "choose another --out, or remove this folder (nothing in it is rendered yet)"
        problems = Problems(self.root)
        if existing.recipe_sha256 != record.recipe_sha256:
            earlier = self.read_recipe().model_dump(mode="json")
            problems += [
                Problem(self.root, f"recipe: {field}", now, f"{then}, as when the run started", remedy)
                for field, then, now in differences(earlier, recipe.model_dump(mode="json"))
            ]
        if existing.library_sha256 != record.library_sha256:
            expected = f"those that the run started with ({', '.join(existing.library_paths)})"
            problems.add("library", "other assets", expected, remedy)
        for name in sorted({*existing.versions, *record.versions}):
            then_, now_ = existing.versions.get(name, "none"), record.versions.get(name, "none")
            if then_ != now_:
                problems.add(f"version of {name}", now_, f"{then_}, as when the run started", remedy)
        raise_problems(problems)


def unit_key(configuration: Configuration, recipe: Recipe, variant: str, versions: dict[str, str]) -> str:
    """Return the hexadecimal SHA-256 of everything that affects the bytes of a unit."""
    parts = {
        "configuration": configuration.model_dump(mode="json"),
        "render": recipe.render.model_dump(mode="json"),
        "statistics": recipe.statistics.model_dump(mode="json"),
        "output": recipe.output.model_dump(mode="json"),
        "variant": variant,
        "versions": versions,
    }
    return sha256_hex(canonical_json(parts))


def rooms_of(path: Path) -> list[Path]:
    """Return a list with the folder of generated rooms of the dataset ``path``; empty if it has none."""
    rooms = DatasetFolder(path).rooms_path
    return [rooms] if rooms.is_dir() else []


def library_of(path: Path) -> list[Path] | None:
    """Folders of a dataset's library and generated rooms; None if one, or ``dataset.json``, is missing."""
    try:
        paths = DatasetFolder(path).library_paths()
    except InputError:
        return None
    return paths if all(p.exists() for p in paths) else None
