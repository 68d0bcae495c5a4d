# SPDX-License-Identifier: MIT
"""Test scenes: a room as its author made it, photographed from believable places, with the truth.

A scene comes from a Mitsuba file, or is an environment package already. It is converted to the project's
BSDF, keeps its own lights and materials, and is rendered by the machinery of datasets as one configuration:
``view-000`` ... are the photographs that a method may use, ``path-000`` ... lie on a walk between two of them
and are for judging novel views only. Everything lies in a folder of the cache that is named by what decides
its pixels; an interrupted rendering goes on where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from datagen.farm.collect import collect
from datagen.farm.folder import DatasetFolder, Plan
from datagen.farm.local import Event, LocalOptions, run_local
from datagen.farm.planning import start_folder, write_plan
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.base import (
    IDENTITY4,
    Positive,
    Slug,
    StrictModel,
    canonical_json,
    sha256_file,
    sha256_hex,
    write_bytes_atomically,
)
from datagen.formats.configuration import Configuration, PlacedAsset
from datagen.formats.light_changes import moved_light
from datagen.formats.package import Package, is_package
from datagen.formats.recipe import CameraRecipe, Recipe, RenderRecipe
from datagen.foundation.errors import InputError, Problem, input_error
from datagen.foundation.random import digest
from datagen.foundation.versions import RESULT_REVISION
from datagen.importers.common import ImportOptions
from datagen.library import Library
from model.checkpoint import CheckpointCard
from model.evaluation.photographer import choose_cameras

Progress = Callable[[str, int, int], None]
"""(stage, done, total); the stages are "render", "stats" and "pack"."""

_SCENE_FILE = "scene.xml"


class TestScene(StrictModel):
    """A scene to judge methods by. ``source``: a Mitsuba file, its folder, or an environment package.

    ``views`` photographs and ``novel_views`` more on a walk, of ``resolution`` (width, height), by ``render``
    and ``cameras`` as in recipes. ``seed`` chooses cameras and samples. ``unit_m``: metres in a unit of a
    Mitsuba file, so that cameras are at a person's height; ``annotations`` mends what the importer finds out
    about a room (docs/importing.md).
    """

    __test__: ClassVar[bool] = False  # no test case, although pytest would take its name for one

    name: Slug
    source: Path
    views: Annotated[int, Field(ge=1, le=4096)] = 40
    novel_views: Annotated[int, Field(ge=0, le=4096)] = 10
    resolution: tuple[Annotated[int, Field(ge=8, le=16384)], Annotated[int, Field(ge=8, le=16384)]] = (
        640,
        384,
    )
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    render: RenderRecipe = Field(default_factory=lambda: RenderRecipe(quality="standard"))
    cameras: CameraRecipe = CameraRecipe()
    unit_m: Positive = 1.0
    annotations: Path | None = None


@dataclass(frozen=True)
class PreparedScene:
    """A test scene that is rendered. ``capture`` is a shard for :func:`model.reconstruction.captures.
    read_capture`, with the true maps of every view; ``library`` the folders that it needs, ``package`` the
    room with its true materials and lights. ``input_names`` and ``novel_names`` divide the capture's views.

    ``asset_sha256``: of the package by its id, of each of its files by ``<id>/<file>``.
    """

    name: str
    capture: Path
    library: tuple[Path, ...]
    package: Path
    input_names: tuple[str, ...]
    novel_names: tuple[str, ...]
    asset_sha256: dict[str, str]


def prepare_scene(
    scene: TestScene, cache: Path, progress: Progress = lambda stage, done, total: None
) -> PreparedScene:
    """Import, photograph and render a test scene; what is in the cache already is not made again.

    Raises :class:`InputError` where the source cannot be imported, where too few places for cameras are
    found, and where rendering fails.
    """
    root = cache / f"{scene.name}-{_key(scene)[:8]}"
    library_path = _library(scene, root / "library")
    with Library([library_path]) as library:
        package = _room(library)
        plan = _planned(scene, library, package, root / "capture")
        folder = DatasetFolder(root / "capture")
        (unit,) = plan.units
        if not folder.is_done(unit):
            _render(folder, progress)
        collect(folder.root)
        manifest = folder.read_manifest(unit)
        assert manifest is not None
        names = [camera.name for camera in folder.read_configuration(unit).cameras]
        return PreparedScene(
            name=scene.name,
            capture=folder.root / manifest.shard,
            library=(library_path,),
            package=package.path,
            input_names=tuple(names[: scene.views]),
            novel_names=tuple(names[scene.views :]),
            asset_sha256=_hashes(package),
        )


def assert_not_trained_on(prepared: PreparedScene, card: CheckpointCard) -> None:
    """Raise :class:`InputError` where a checkpoint has learnt from a test scene, or does not say from what.

    A scene is known by the hashes of its package and files, and by its id: imported with other options it has
    another hash and is the same room all the same.
    """
    problems = []
    ours = {sha: name for name, sha in prepared.asset_sha256.items()}
    ids = {name for name in prepared.asset_sha256 if "/" not in name}
    for record in card.data:
        if record.num_views and not record.assets:
            remedy = "judge a checkpoint whose data record lists its assets"
            problems.append(
                Problem("checkpoint", f"data {record.name}", "no hashes of assets", "what it saw", remedy)
            )
        for asset_id, sha in sorted(record.assets.items()):
            if asset_id in ids or sha in ours:
                got = f"trained on {asset_id} ({sha[:12]}), which is {ours.get(sha, asset_id)} of this scene"
                expected = "a checkpoint that has never seen its test scenes"
                remedy = "judge another checkpoint, or leave this scene out"
                problems.append(Problem(f"scene {prepared.name}", record.name, got, expected, remedy))
    if problems:
        raise InputError(*problems)


def _key(scene: TestScene) -> str:
    """Hash of all that decides the pixels, but the versions of libraries and the source's own files."""
    parts = scene.model_dump(mode="json", exclude={"source", "annotations"})
    parts["result_revision"] = RESULT_REVISION
    for name, path in (("source", _file(scene.source)), ("annotations", scene.annotations)):
        if path is not None:
            if not path.is_file():
                raise input_error(path, f"scene {scene.name}: {name}", "no such file", "a readable file")
            parts[name] = sha256_file(path)
    return sha256_hex(canonical_json(parts))


def _file(source: Path) -> Path:
    """The file that stands for a source."""
    if source.is_dir():
        return source / (_SCENE_FILE if (source / _SCENE_FILE).is_file() else "asset.json")
    return source


def _library(scene: TestScene, folder: Path) -> Path:
    """The library of the scene: its package where it is one, else what the importer makes, once."""
    if is_package(scene.source):
        return scene.source
    if not (folder / "environments" / scene.name).is_dir():
        from datagen.importers.mitsuba_xml import import_mitsuba_scene

        options = ImportOptions(
            asset_id=scene.name,
            dielectric="replace",
            missing="replace",
            unit_scale=scene.unit_m,
            annotations=scene.annotations,
            overwrite=True,
        )
        import_mitsuba_scene(_file(scene.source), folder, options)
    return folder


def _room(library: Library) -> Package:
    rooms = library.select("environment", for_training=False)
    if len(rooms) != 1:
        got = ", ".join(package.id for package in rooms) or "none"
        raise input_error(library.paths[0], "environment", got, "one environment package")
    return rooms[0]


def _recipe(scene: TestScene) -> Recipe:
    """What a dataset of this one configuration is made by; nothing is drawn from it but the cameras."""
    return Recipe(
        name=scene.name,
        seed=scene.seed,
        configurations=1,
        views=scene.views + scene.novel_views,
        resolution=scene.resolution,
        cameras=scene.cameras,
        render=scene.render,
    )


def _planned(scene: TestScene, library: Library, package: Package, root: Path) -> Plan:
    """The plan of the dataset folder; made where there is none. Its only configuration is the room as it is,
    seen from the chosen cameras."""
    recipe = _recipe(scene)
    folder = start_folder(recipe, library, root)
    if folder.plan_path.is_file():
        return folder.read_plan()
    asset = package.asset
    assert isinstance(asset, EnvironmentAsset)
    configuration = Configuration(
        id=f"{recipe.name}-00000",
        index=0,
        seed=int.from_bytes(digest(scene.seed, scene.name, "renderer")[:8], "little") >> 1,
        split="test",
        environment=PlacedAsset(name="room", asset=package.id),
        lights=tuple(moved_light(light, IDENTITY4, package.id) for light in asset.lights),
        cameras=choose_cameras(
            library, package, scene.cameras, scene.resolution, scene.views, scene.novel_views, scene.seed
        ),
        assets={package.id: package.sha256},
    )
    write_bytes_atomically(folder.configuration_path(configuration.id), canonical_json(configuration))
    return write_plan(folder, recipe, library)


def _render(folder: DatasetFolder, progress: Progress) -> None:
    def on_event(event: Event) -> None:
        kind, _, stage, done, total = event
        if kind == "progress":
            progress(stage, done, total)

    summary = run_local(folder.root, LocalOptions(workers=1), on_event)
    if summary.interrupted:
        raise KeyboardInterrupt
    if summary.failures:
        failure = summary.failures[0]
        raise input_error(folder.root, failure.id, failure.reason, "a rendered scene", f"see {failure.log}")


def _hashes(package: Package) -> dict[str, str]:
    files = {f"{package.id}/{name}": sha256_hex(package.read_bytes(name)) for name in package.names()}
    return {package.id: package.sha256, **files}
