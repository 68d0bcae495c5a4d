# SPDX-License-Identifier: MIT
"""Test scenes: rooms rendered from plausible camera positions with their true maps.

A scene is a Mitsuba file, an environment package, or a configuration drawn from a recipe, with its own lights
and with materials converted to the project's BSDF. It is rendered like a configuration of a dataset:
``view-000`` ... are the photographs that a method may use; ``path-000`` ... on a walk between two of them are
novel views. A scene is stored in a folder of the cache, named by a hash of everything that affects its
pixels; an interrupted rendering resumes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from datagen.farm.collect import collect
from datagen.farm.folder import DatasetFolder, Plan
from datagen.farm.local import Event, LocalOptions, run_local
from datagen.farm.planning import start_folder, write_plan
from datagen.formats.asset import EnvironmentAsset, MaterialAsset
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
from datagen.formats.lights import moved_light
from datagen.formats.package import Package, is_package
from datagen.formats.recipe import CameraRecipe, Recipe, RenderRecipe
from datagen.foundation.errors import Problem, input_error, raise_problems
from datagen.foundation.progress import Progress
from datagen.foundation.random import digest
from datagen.foundation.versions import PLAN_REVISION, RESULT_REVISION
from datagen.importers.common import ImportOptions
from datagen.library import Library
from model.checkpoint import CheckpointCard
from model.evaluation.drawn_room import RECIPE_SUFFIXES, draw_room, imported, recipe_library
from model.evaluation.photographer import choose_cameras

Side = Annotated[int, Field(ge=16, le=16384)]
"""Side of an image in pixels; at least 16, since LPIPS-VGG halves images four times (SSIM needs 11)."""
_SCENE_FILE = "scene.xml"


class TestScene(StrictModel):
    """A test scene.

    ``source``: a Mitsuba file, its folder, an environment package, or a recipe (.yaml), whose configuration
    number ``configuration`` is the scene; ``imports`` are files and folders whose assets the recipe may use.
    There are ``views`` photographs, and ``novel_views`` more views on a walk, of ``resolution`` (width,
    height); ``render`` and ``cameras`` are as in recipes. ``judged``: quality of true and re-rendered views
    instead of the suite's ``truth`` and ``render``, for noisy scenes. ``seed`` seeds cameras and light paths.
    ``unit_m``: metres per unit of a Mitsuba file; ``annotations``: file with corrections of the imported room
    (docs/importing.md). ``may_know_shapes``: checkpoints may have been trained on the rooms and objects of a
    recipe, but on none of its materials.
    """

    __test__: ClassVar[bool] = False  # keeps pytest from collecting it

    name: Slug
    source: Path
    views: Annotated[int, Field(ge=1, le=4096)] = 40
    novel_views: Annotated[int, Field(ge=0, le=4096)] = 10
    resolution: tuple[Side, Side] = (640, 384)
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    render: RenderRecipe = Field(default_factory=lambda: RenderRecipe(quality="standard"))
    judged: RenderRecipe | None = None
    cameras: CameraRecipe = CameraRecipe()
    unit_m: Positive = 1.0
    annotations: Path | None = None
    configuration: Annotated[int, Field(ge=0)] = 0
    imports: tuple[Path, ...] = ()
    may_know_shapes: bool = False

    @model_validator(mode="after")
    def _fields_fit_the_source(self) -> TestScene:
        of_files, of_recipes = ("unit_m", "annotations"), ("configuration", "imports", "may_know_shapes")
        fields, others = type(self).model_fields, of_files if self.is_drawn else of_recipes
        given = [name for name in others if getattr(self, name) != fields[name].default]
        if given:
            kind = "a Mitsuba file" if self.is_drawn else "a recipe"
            raise ValueError(f"expected {' and '.join(given)} only with {kind} as source")
        return self

    @property
    def is_drawn(self) -> bool:
        return self.source.suffix in RECIPE_SUFFIXES


@dataclass(frozen=True)
class PlannedScene:
    """A test scene with known assets and cameras.

    ``library``: folders of its assets; ``package``: the room with its true materials and lights;
    ``asset_sha256``: hashes of the packages, by id, and of their files, by ``<id>/<file>``, none of which may
    occur in a checkpoint's training data.
    """

    recipe: TestScene
    folder: DatasetFolder
    plan: Plan
    library: tuple[Path, ...]
    package: Path
    asset_sha256: dict[str, str]


@dataclass(frozen=True)
class PreparedScene(PlannedScene):
    """A rendered test scene.

    ``capture`` is a shard for :func:`model.reconstruction.captures.read.read_capture`, with the true maps of
    every view; ``input_names`` and ``novel_names`` are the names of its photographs and novel views.
    """

    capture: Path
    input_names: tuple[str, ...]
    novel_names: tuple[str, ...]


def plan_scene(scene: TestScene, cache: Path) -> PlannedScene:
    """Import a test scene and choose its cameras, unless the folder ``cache`` contains them.

    Raises :class:`InputError` if the source cannot be imported, or if there are too few camera positions.
    """
    root = cache / f"{scene.name}-{_key(scene)[:8]}"
    paths = _library(scene, root / "library")
    with Library(paths) as library:
        plan = _planned(scene, library, root / "capture")
        folder = DatasetFolder(root / "capture")
        configuration = folder.read_configuration(plan.units[0])
        return PlannedScene(
            recipe=scene,
            folder=folder,
            plan=plan,
            library=paths,
            package=library.package(configuration.environment.asset).path,
            asset_sha256=_hashes(scene, configuration, library),
        )


def prepare_scene(
    scene: TestScene, cache: Path, progress: Progress = lambda stage, done, total: None
) -> PreparedScene:
    """Plan and render a test scene; raises :class:`InputError` if either fails."""
    return photograph(plan_scene(scene, cache), progress)


def photograph(planned: PlannedScene, progress: Progress = lambda stage, done, total: None) -> PreparedScene:
    """Render a planned scene unless this is already done; raises :class:`InputError` if rendering fails."""
    folder = planned.folder
    (unit,) = planned.plan.units
    if not folder.is_done(unit):
        _render(folder, progress)
    collect(folder.root)
    manifest = folder.read_manifest(unit)
    assert manifest is not None
    names = [camera.name for camera in folder.read_configuration(unit).cameras]
    shard, num = folder.root / manifest.shard, planned.recipe.views
    return PreparedScene(
        **vars(planned), capture=shard, input_names=tuple(names[:num]), novel_names=tuple(names[num:])
    )


def assert_not_trained_on(scene: PlannedScene, card: CheckpointCard) -> None:
    """Raise :class:`InputError` if a checkpoint was trained on a test scene, or lacks a record of its
    training data.

    A scene is identified by the hashes of its packages and of their files, since unrelated rooms may have the
    same id. Hashes of files also identify a room that was imported with other options.
    """
    problems = []
    ours = {sha: asset for asset, sha in scene.asset_sha256.items()}
    for record in card.data:
        if record.num_views and not record.assets:
            got, expected = "no hashes of assets", "hashes of its training data"
            remedy = "judge a checkpoint whose data record lists its assets"
            problems.append(Problem("checkpoint", f"data {record.name}", got, expected, remedy))
        for asset_id, sha in sorted(record.assets.items()):
            if sha in ours:
                got = f"trained on {asset_id} ({sha[:12]}), which is {ours[sha]} of this scene"
                expected = "a checkpoint that was not trained on its test scenes"
                remedy = "judge another checkpoint, or leave this scene out"
                problems.append(Problem(f"scene {scene.recipe.name}", record.name, got, expected, remedy))
    raise_problems(problems)


def _key(scene: TestScene) -> str:
    """Hash of all inputs that affect pixels, except library versions and files named in the source."""
    parts = scene.model_dump(mode="json", exclude={"source", "annotations", "may_know_shapes", "judged"})
    if not scene.is_drawn:  # unused without a recipe
        del parts["configuration"], parts["imports"]
    else:
        parts["imports"] = [path.name for path in scene.imports]
        parts["plan_revision"] = PLAN_REVISION
    parts["result_revision"] = RESULT_REVISION
    for name, path in (("source", _file(scene.source)), ("annotations", scene.annotations)):
        if path is not None:
            if not path.is_file():
                raise input_error(path, f"scene {scene.name}: {name}", "no such file", "a readable file")
            parts[name] = sha256_file(path)
    return sha256_hex(canonical_json(parts))


def _file(source: Path) -> Path:
    """Path of the main file of ``source``, a file or folder."""
    if source.is_dir():
        return source / (_SCENE_FILE if (source / _SCENE_FILE).is_file() else "asset.json")
    return source


def _library(scene: TestScene, folder: Path) -> tuple[Path, ...]:
    """Library folders of the scene; its source is imported into ``folder`` if that is not done yet."""
    if scene.is_drawn:
        return recipe_library(scene.source, imported(scene.imports, folder))
    if is_package(scene.source):
        return (scene.source,)
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
    return (folder,)


def _room(library: Library) -> Package:
    rooms = library.select("environment", for_training=False)
    if len(rooms) != 1:
        got = ", ".join(package.id for package in rooms) or "none"
        raise input_error(library.paths[0], "environment", got, "one environment package")
    return rooms[0]


def _recipe(scene: TestScene) -> Recipe:
    """Recipe of a dataset that contains only the scene's configuration."""
    return Recipe(
        name=scene.name,
        seed=scene.seed,
        configurations=1,
        views=scene.views + scene.novel_views,
        resolution=scene.resolution,
        cameras=scene.cameras,
        render=scene.render,
    )


def _planned(scene: TestScene, library: Library, root: Path) -> Plan:
    """Read the plan in the dataset folder ``root``, or write a plan with only the scene's configuration."""
    recipe = _recipe(scene)
    folder = start_folder(recipe, library, root)
    if folder.plan_path.is_file():
        return folder.read_plan()
    configuration = _configuration(scene, library, f"{recipe.name}-00000")
    write_bytes_atomically(folder.configuration_path(configuration.id), canonical_json(configuration))
    return write_plan(folder, recipe, library)


def _configuration(scene: TestScene, library: Library, configuration_id: str) -> Configuration:
    if scene.is_drawn:
        size = scene.resolution, scene.views, scene.novel_views
        drawn = draw_room(scene.source, scene.configuration, library, scene.cameras, *size)
        return drawn.model_copy(update={"id": configuration_id, "index": 0})
    package = _room(library)
    asset = package.asset
    assert isinstance(asset, EnvironmentAsset)
    return Configuration(
        id=configuration_id,
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


def _hashes(scene: TestScene, configuration: Configuration, library: Library) -> dict[str, str]:
    """Hashes, by name, of packages and files that must not occur in a checkpoint's training data."""
    packages = [library.package(asset_id) for asset_id in configuration.assets]
    if scene.may_know_shapes:
        packages = [package for package in packages if isinstance(package.asset, MaterialAsset)]
    found = {}
    for package in packages:
        found[package.id] = package.sha256
        found |= {f"{package.id}/{name}": sha256_hex(package.read_bytes(name)) for name in package.names()}
    return found
