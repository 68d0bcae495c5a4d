# SPDX-License-Identifier: MIT
"""Suites of scenes, methods and measurements in YAML files (``scenes/suites/``); unknown keys are errors.

Paths in a suite are relative to its file. docs/evaluation.md explains the figures.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from datagen.formats.base import NonNegative, Positive, Slug, StrictModel, Unit, Vector3, read_yaml
from datagen.formats.lights import Light
from datagen.formats.package import is_package
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.bundled import object_package, resolve_bundled
from datagen.foundation.errors import Problem, raise_problems
from model.checkpoint import bundled_checkpoint
from model.evaluation.camera_faults import CameraFaults, chosen_cameras
from model.evaluation.mesh_errors import GeometryError
from model.evaluation.room import TestScene
from model.reconstruction.infer_options import Materials
from model.reconstruction.merge.weights import Weights

BUNDLED = "bundled"


class _Method(StrictModel):
    name: Slug
    geometry: GeometryError | None = None


class NetworkMethod(_Method):
    """Maps predicted by a checkpoint; if its file is missing, a note replaces the method's figures.
    ``is_filtered`` (bilateral solver), ``weights`` (of pixels in the merge), ``is_leveled`` (albedo scale)
    and ``materials`` are options of ``materials infer``."""

    kind: Literal["network"]
    checkpoint: str = BUNDLED
    is_filtered: bool = True
    weights: Weights = "resolution"
    is_leveled: bool = True
    materials: Materials = "both"


class TextureMethod(_Method):
    """The exposed photographs as diffuse albedo, merged by the median, without specular reflection."""

    kind: Literal["texture"]


class ConstantMethod(_Method):
    """Constant maps.

    The defaults are the means over surface pixels of the training views of ``scenes/recipes/learning.yaml``
    (every fifth view of every fourth configuration).
    """

    kind: Literal["constant"]
    diffuse_albedo: tuple[Unit, Unit, Unit] = (0.372, 0.334, 0.279)
    specular_albedo: tuple[Unit, Unit, Unit] = (0.051, 0.051, 0.050)
    roughness: Unit = 0.598


class MapsMethod(_Method):
    """Maps in files ``FOLDER/SCENE/VIEW.exr`` of every input view, made by another method."""

    kind: Literal["maps"]
    folder: Path


class OracleMethod(_Method):
    """The true maps, merged into an atlas, to measure the loss from merging and resolution."""

    kind: Literal["oracle"]


class TruthMethod(_Method):
    """The true scene, rendered again, to measure the effect of noise."""

    kind: Literal["truth"]

    @model_validator(mode="after")
    def _has_its_own_geometry(self) -> TruthMethod:
        if self.geometry is not None:
            raise ValueError("expected no geometry, as the truth is rendered with its own")
        return self


Method = Annotated[
    NetworkMethod | TextureMethod | ConstantMethod | MapsMethod | OracleMethod | TruthMethod,
    Field(discriminator="kind"),
]


class ModifiedLight(StrictModel):
    """Modified light: the scene's own lights times ``own_gain``, plus ``lights``.

    "ceiling" is a square lamp with a side of 0.6 m just below the ceiling, above the camera nearest to the
    mean position of all cameras.
    """

    own_gain: NonNegative = 0.0
    lights: Literal["ceiling"] | tuple[Light, ...] = "ceiling"


class InsertedObject(StrictModel):
    """Object inserted into the scene for the pictures; ``package`` is an object package or ``bundled:ID``.

    Without ``position_m``, a level position in front of a camera is chosen; ``scale`` multiplies the object's
    size, and ``yaw_deg`` turns it about the vertical.
    """

    package: str = "bundled:statuette_torso"
    position_m: Vector3 | None = None
    yaw_deg: float = 0.0
    scale: Positive = 1.0

    def path(self, folder: Path) -> Path:
        """Path of the package; a relative ``package`` is resolved against ``folder``."""
        return object_package(self.package, folder)


class Suite(StrictModel):
    """Configuration of ``materials evaluate``.

    At most ``input_views`` of the views available to methods, drawn by ``seed``, and ``novel_views`` novel
    views of each scene are judged, i.e. compared with the truth. ``render``: quality of re-rendered views;
    ``truth``: quality of the true views, which are then rendered separately from the photographs, once per
    scene; None uses the photographs as truth, and their quality for other lights. ``seed_views``: number of
    views, per set and light, that are rendered with a second seed to estimate the noise of the figures.
    ``noise_share``: a view of a reconstruction is finished once its remaining noise is at most this share of
    its squared difference from the truth; None: no early stop. ``atlas``: side in texels. ``camera``: every
    method except the truth is also judged on photographs with these faults (names of
    ``camera_faults.PRESETS``, "each" for every fault alone, or custom faults). ``modified_light`` and
    ``inserted`` are given by scene; other scenes use the defaults. ``may_be_known``: checkpoints may have
    been trained on the scenes (a test of the program, not of the checkpoints).
    """

    format: Literal["scene-materials/suite"] = "scene-materials/suite"
    version: Literal[1] = 1
    name: Slug
    scenes: Annotated[tuple[TestScene, ...], Field(min_length=1)]
    methods: Annotated[tuple[Method, ...], Field(min_length=1)]
    atlas: Literal["auto"] | Annotated[int, Field(ge=16, le=16384)] = "auto"
    input_views: Annotated[int, Field(ge=1)] = 10
    novel_views: Annotated[int, Field(ge=0)] = 10
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    render: RenderRecipe = Field(default_factory=lambda: RenderRecipe(quality="draft"))
    truth: RenderRecipe | None = None
    seed_views: Annotated[int, Field(ge=0)] = 0
    noise_share: Annotated[float, Field(gt=0, lt=1)] | None = None
    camera: tuple[str | CameraFaults, ...] = ()
    modified_light: dict[Slug, ModifiedLight] = {}
    inserted: dict[Slug, InsertedObject] = {}
    may_be_known: bool = False

    @model_validator(mode="after")
    def _names_are_known(self) -> Suite:
        scenes = [scene.name for scene in self.scenes]
        for names, what in ((scenes, "scene"), ([m.name for m in self.methods], "method")):
            if len(set(names)) != len(names):
                raise ValueError(f"expected every {what} to have its own name")
        chosen_cameras(self.camera)
        unknown = sorted({*self.modified_light, *self.inserted} - set(scenes))
        if unknown:
            raise ValueError(f"expected modified_light and inserted to name scenes, not {', '.join(unknown)}")
        return self

    def judging(self, scene: TestScene) -> Suite:
        """The suite with ``scene.judged``, if given, in place of ``render`` and ``truth``."""
        if scene.judged is None:
            return self
        return self.model_copy(update={"truth": scene.judged, "render": scene.judged})

    @property
    def cameras(self) -> tuple[CameraFaults, ...]:
        return chosen_cameras(self.camera)


def read_suite(path: Path, checkpoint: Path | None = None) -> Suite:
    """Read the suite in the file ``path``, or the bundled suite with that name; its paths become absolute.

    ``checkpoint`` replaces the bundled checkpoint. Raises :class:`InputError` with every fault of the file
    and every missing file that it names.
    """
    path = resolve_bundled(path, "suites")
    suite = read_yaml(Suite, path)
    folder = path.parent.resolve()
    problems: list[Problem] = []

    def existing(field: str, name: Path | str, expected: str) -> Path:
        found = (folder / name).resolve()
        if not found.exists():
            problems.append(Problem(path, field, str(name), expected, f"put it at {found}, or correct it"))
        return found

    scenes = []
    for index, scene in enumerate(suite.scenes):
        source = existing(f"scenes[{index}].source", scene.source, "a scene")
        changes: dict[str, Any] = {"source": source}
        if is_package(source) and (scene.unit_m != 1.0 or scene.annotations is not None):
            got, expected = "an asset package", "a Mitsuba file, since unit_m or annotations is set"
            problems.append(
                Problem(path, f"scenes[{index}].source", got, expected, "leave unit_m and annotations out")
            )
        if scene.annotations is not None:
            changes["annotations"] = existing(
                f"scenes[{index}].annotations", scene.annotations, "a file of annotations"
            )
        changes["imports"] = tuple(
            existing(f"scenes[{index}].imports[{k}]", path, "something to import")
            for k, path in enumerate(scene.imports)
        )
        scenes.append(scene.model_copy(update=changes))
        inserted = suite.inserted.get(scene.name, InsertedObject())
        existing(f"inserted.{scene.name}.package", inserted.path(folder), "an object package")
    methods: list[Method] = []
    for index, method in enumerate(suite.methods):
        field = f"methods[{index}]"
        if isinstance(method, NetworkMethod):
            bundled = checkpoint.resolve() if checkpoint is not None else bundled_checkpoint()
            weights = bundled if method.checkpoint == BUNDLED else (folder / method.checkpoint).resolve()
            if method.checkpoint == BUNDLED and not weights.is_file():
                problems.append(
                    Problem("--checkpoint", "", str(weights), "a checkpoint (.safetensors)", "check the path")
                )
            methods.append(method.model_copy(update={"checkpoint": str(weights)}))
        elif isinstance(method, MapsMethod):
            maps = existing(f"{field}.folder", method.folder, "a folder of maps")
            problems += _missing_folders(path, f"{field}.folder", maps, suite)
            methods.append(method.model_copy(update={"folder": maps}))
        else:
            methods.append(method)
    raise_problems(problems)
    inserted_paths = {
        scene.name: (own := suite.inserted.get(scene.name, InsertedObject())).model_copy(
            update={"package": str(own.path(folder))}
        )
        for scene in suite.scenes
    }
    return suite.model_copy(
        update={"scenes": tuple(scenes), "methods": tuple(methods), "inserted": inserted_paths}
    )


def _missing_folders(path: Path, field: str, maps: Path, suite: Suite) -> list[Problem]:
    """Problems of the suite ``path`` at ``field``, one for each scene that has no subfolder in ``maps``."""
    if not maps.is_dir():
        return []
    return [
        Problem(path, field, f"no {scene.name} in {maps}", "a folder for every scene", "add it")
        for scene in suite.scenes
        if not (maps / scene.name).is_dir()
    ]


def describe_suite(suite: Suite) -> str:
    """Describe the planned work of a suite, for ``--dry-run``."""
    lines = [f"suite {suite.name}: {len(suite.scenes)} scenes, {len(suite.methods)} methods"]
    for scene in suite.scenes:
        width, height = scene.resolution
        lines.append(
            f"  {scene.name}: {scene.views} + {scene.novel_views} views of {width} x {height}, {scene.source}"
        )
    for method in suite.methods:
        text = f"  {method.name}: {method.kind}"
        if isinstance(method, NetworkMethod):
            absent = "" if Path(method.checkpoint).is_file() else " (missing: left out)"
            text += f", {method.checkpoint}{absent}"
        if method.geometry is not None:
            text += f", geometry: {method.geometry.describe()}"
        lines.append(text)
    if suite.cameras:
        lines.append(f"  all methods but the truth with cameras: {', '.join(c.name for c in suite.cameras)}")
    views = suite.input_views + suite.novel_views + 2 * suite.seed_views
    lines.append(
        f"  at most {3 * views + 1} re-rendered views per method, camera and scene, "
        f"{2 * views + 1} of the truth"
    )
    return "\n".join(lines)
