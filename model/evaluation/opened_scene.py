# SPDX-License-Identifier: MIT
"""A test scene as shared by all methods of a suite: capture, lights, judged views and true images."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from datagen.formats.base import canonical_json, sha256_hex
from datagen.formats.capture import Capture, CaptureView
from datagen.formats.configuration import PlacedAsset
from datagen.formats.package import open_package
from datagen.formats.recipe import RenderRecipe
from datagen.formats.shard import ShardReader
from datagen.foundation.buffers import LIGHT_BUFFERS
from datagen.foundation.progress import Advance
from datagen.foundation.versions import LIGHT_REVISION
from datagen.rendering.capture_geometry import package_geometry
from mitsuba_plugins.variant import select_variant
from model.checkpoint import read_card
from model.evaluation.camera_faults import CameraFaults
from model.evaluation.metrics import common_exposure
from model.evaluation.rendering import BUFFERS, JudgedView, Rendering, judged_view, render_scenery
from model.evaluation.results import MethodResult, SceneResult
from model.evaluation.room import PreparedScene, TestScene
from model.evaluation.scenery import Scenery, added_lights, level_place
from model.evaluation.suite import Method, ModifiedLight, NetworkMethod, Suite
from model.evaluation.surface_kinds import SurfaceFinder, ViewSurfaces
from model.own_network import network_inputs
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture

Tell = Callable[[str, int, int], None]
OWN, MODIFIED, INSERTED = "own", "modified", "inserted"
RECOVERED = "recovered"
"""Name of the light recovered by a method; its truth is rendered under the scene's own light."""
RENDER_SEED, SECOND_SEED, TRUE_SEED = 1, 2, 3  # added to the scene's seed (that of the photographs)
_REVISION = 2
"""Revision of atlases and renderings; cached ones of a different revision are computed again."""
_GEOMETRY = 2
"""Revision of the geometry of captures, on which predictions depend."""
_MENDED_MESH = 2
"""Revision of the repair of meshes with simulated errors, which precedes prediction."""


@dataclass
class OpenedScene:
    """A scene and the names of its judged views, which are compared with the truth: ``inputs`` and ``novel``.

    ``sceneries``, ``truth`` (true views by name), ``exposures``, and ``renders`` (folders of true views that
    are not in the capture) are by light. ``root`` is the folder of results; ``figure_views`` are the views in
    pictures, by set (input, novel); ``modified_gain`` scales the scene's own lights under modified light.
    """

    recipe: TestScene
    prepared: PreparedScene
    root: Path
    capture: Capture
    inputs: tuple[str, ...]
    novel: tuple[str, ...]
    sceneries: dict[str, Scenery]
    modified_gain: float = 0.0
    truth: dict[str, dict[str, JudgedView]] = field(default_factory=dict)
    exposures: dict[str, float] = field(default_factory=dict)
    figure_views: dict[str, str] = field(default_factory=dict)
    renders: dict[str, str] = field(default_factory=dict)
    _surfaces: dict[str, ViewSurfaces] = field(default_factory=dict)
    _finder: SurfaceFinder | None = None

    @property
    def geometries(self) -> Path:
        """Folder of unwrapped meshes, shared by all scenes."""
        return self.root.parents[1] / "geometries"

    @property
    def renderings(self) -> Path:
        """Folder of rendered views, with a folder for each rendering."""
        return self.root / "renders"

    def view(self, name: str) -> CaptureView:
        return next(view for view in self.capture.views if view.name == name)

    def surfaces(self, name: str) -> ViewSurfaces:
        """Kinds of surface in the judged view ``name``, computed on first use."""
        if name not in self._surfaces:
            if self._finder is None:
                self._finder = SurfaceFinder(self.capture.geometry, self.capture.lights)
            self._surfaces[name] = self._finder.find(self.view(name), self.truth[OWN][name])
        return self._surfaces[name]

    def views_of(self, light: str) -> tuple[str, ...]:
        """Names of the judged views that are rendered under ``light``."""
        return (self.figure_views["input"],) if light == INSERTED else (*self.inputs, *self.novel)

    def input_capture(self) -> Capture:
        """The capture with only the photographs that methods may use."""
        inputs = set(self.prepared.input_names)
        return replace(self.capture, views=tuple(v for v in self.capture.views if v.name in inputs))

    def rendering(
        self,
        scenery: Scenery,
        light: str,
        seed: int,
        render: RenderRecipe,
        views: tuple[str, ...] | None = None,
        *stopped_by: Any,
    ) -> Rendering:
        """Define the rendering of ``scenery`` under ``light``, in a folder named by a hash of its inputs.

        ``views`` None selects all views of the light; ``seed`` is added to the scenery's seed; ``stopped_by``
        are the parameters of early stopping, which also enter the hash.
        """
        seed += scenery.configuration.seed
        cameras = self.views_of(light)
        seen = scenery.seen_by(cameras).with_seed(seed).configuration
        key = key_of(seen.model_dump(mode="json"), render.model_dump(mode="json"), *stopped_by)
        return Rendering(seed, cameras if views is None else views, self.renderings / key)

    def result(self, methods: tuple[MethodResult, ...]) -> SceneResult:
        samples = [record.render.path_samples for record in ShardReader(self.prepared.capture).records()]
        return SceneResult(
            name=self.recipe.name,
            num_views=len(self.prepared.input_names),
            num_novel=len(self.prepared.novel_names),
            resolution=self.recipe.resolution,
            judged_views=self.inputs,
            novel_views=self.novel,
            exposures=self.exposures,
            figure_views=self.figure_views,
            path_samples=float(np.mean(samples)),
            renders=self.renders,
            methods=methods,
        )


def key_of(*parts: Any) -> str:
    """Hash of ``parts`` in 12 hexadecimal digits, for names of folders and files."""
    return sha256_hex(canonical_json([_REVISION, *parts]))[:12]


def stage_progress(tell: Tell, stage: str) -> Advance:
    """Callback (done, total) that reports the progress of ``stage`` to ``tell``."""
    return lambda done, total: tell(stage, done, total)


def open_scene(suite: Suite, recipe: TestScene, prepared: PreparedScene, tell: Tell) -> OpenedScene:
    """Open a photographed scene, and render its missing true views under each light."""
    select_variant()
    whole = read_capture(
        prepared.capture, CaptureOptions(library=prepared.library, max_width_px=recipe.resolution[0])
    )
    random = np.random.default_rng([suite.seed, 0x76696577])
    drawn = random.permutation(len(prepared.input_names))[: suite.input_views]
    inputs = tuple(prepared.input_names[k] for k in sorted(drawn))
    novel = prepared.novel_names[: suite.novel_views]
    truth = Scenery(ShardReader(prepared.capture).configuration(), prepared.library)
    modified = suite.modified_light.get(recipe.name, ModifiedLight())
    cameras = [view.camera for view in whole.views]
    scene = OpenedScene(
        recipe=recipe,
        prepared=prepared,
        root=prepared.capture.parents[2] / "results",
        capture=whole,
        inputs=inputs,
        novel=novel,
        sceneries={
            OWN: truth,
            MODIFIED: truth.lit_by(modified, added_lights(modified, whole.geometry, cameras)),
        },
        modified_gain=modified.own_gain,
    )
    if suite.truth is None:
        scene.truth[OWN] = {
            name: judged_view(scene.view(name).source.read_maps(BUFFERS)) for name in (*inputs, *novel)
        }
    _choose_figures(suite, scene)
    render = suite.truth or recipe.render
    lights = (MODIFIED, *([INSERTED] if INSERTED in scene.sceneries else []))
    for light in lights if suite.truth is None else (OWN, *lights):
        seed = TRUE_SEED if light == OWN else 0  # avoids the seed, and thus the noise, of the photographs
        rendering = scene.rendering(scene.sceneries[light], light, seed, render)
        progress = stage_progress(tell, f"{recipe.name}: truth, {light}")
        render_scenery(scene.sceneries[light], rendering.views, [rendering], render, tell=progress)
        scene.renders[light] = str(rendering.folder)
        scene.truth[light] = rendering.read()
    scene.truth[RECOVERED] = scene.truth[OWN]
    if OWN in scene.renders:
        scene.renders[RECOVERED] = scene.renders[OWN]
    scene.exposures = {light: common_exposure(list(views.values())) for light, views in scene.truth.items()}
    if INSERTED in scene.exposures:
        scene.exposures[INSERTED] = scene.exposures[OWN]
    return scene


def _choose_figures(suite: Suite, scene: OpenedScene) -> None:
    """Choose the views in pictures; add a :class:`Scenery` with the inserted object if a view has space."""
    inserted = suite.inserted[scene.recipe.name]
    package = open_package(Path(inserted.package))
    thing, _ = package_geometry(package, PlacedAsset(name=INSERTED, asset=package.id))
    height_m = float(thing.mesh.positions[:, 2].max()) * inserted.scale
    position = None if inserted.position_m is None else np.array(inserted.position_m)
    chosen, best = scene.inputs[0], np.inf
    for name in scene.inputs if position is None else ():
        view = scene.view(name)
        stored = view.source.read_maps(("depth_z_m", "normal_world"))
        place = level_place(view.camera, stored["depth_z_m"], stored["normal_world"], height_m)
        if place is not None and place.cost < best:
            chosen, best, position = name, place.cost, place.position_m
    scene.figure_views["input"] = chosen
    if scene.novel:
        scene.figure_views["novel"] = scene.novel[len(scene.novel) // 2]
    if position is not None:
        scene.sceneries[INSERTED] = scene.sceneries[OWN].with_object(inserted, position)


def predictions_folder(
    scene: OpenedScene, method: NetworkMethod, camera: CameraFaults | None, weights: str
) -> Path:
    """Folder for predictions of the checkpoint with the hash ``weights``, named by a hash of their inputs."""
    faults = [None if f is None else f.model_dump(mode="json") for f in (method.geometry, camera)]
    names = scene.prepared.input_names
    revisions = [_GEOMETRY, *light_revision(method), *mesh_revision(method, camera)]
    return scene.root / f"predictions-{key_of(weights, method.is_filtered, names, faults, *revisions)}"


def light_revision(method: NetworkMethod) -> list[int]:
    """Return the revision of recorded light in a list if the method's network uses it as input, else []."""
    inputs = network_inputs(read_card(Path(method.checkpoint)).network)
    return [LIGHT_REVISION] if set(LIGHT_BUFFERS) & set(inputs) else []


def mesh_revision(method: Method, camera: CameraFaults | None) -> list[int]:
    """Return the revision of mended meshes in a list if the mesh of a method has errors, else []."""
    errors = (method.geometry, camera.geometry if camera else None)
    return [_MENDED_MESH] if any(error is not None for error in errors) else []


def link_files(source: Path, target: Path) -> None:
    """Hard-link the files of the folder ``source``, if it exists, into ``target``; keep existing files."""
    if not source.is_dir():
        return
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(source.iterdir()):
        with suppress(FileExistsError):
            os.link(path, target / path.name)
