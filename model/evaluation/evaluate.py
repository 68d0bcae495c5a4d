# SPDX-License-Identifier: MIT
"""Runs a suite: scenes, methods, figures. What is in the cache already is not done again.

CACHE/<scene>-<key>/            the rendered scene (``test_scene``)
CACHE/<scene>-<key>/results/
    geometry-<key>/             the mesh that a method gets, unwrapped
    <method>-<key>/             what ``materials infer`` writes, views/ and result-<key>.json
    renders/<key>/              VIEW.exr, a folder for all that decides the pixels
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from datagen.errors import InputError, Problem
from datagen.formats.base import canonical_json, sha256_file, sha256_hex
from datagen.formats.capture import Capture, CaptureView
from datagen.formats.configuration import PlacedAsset
from datagen.formats.exr import decode_view
from datagen.formats.package import open_package
from datagen.formats.recipe import RenderRecipe
from mitsuba_plugins.variant import select_variant
from model.checkpoint import read_card
from model.evaluation.baselines import given_maps
from model.evaluation.metrics import Lpips, MapSums, common_exposure, image_figures
from model.evaluation.peak_memory import forget_peak, peak_mb
from model.evaluation.rendering import JudgedView, render_scenery, stored_view
from model.evaluation.results import MethodResult, SceneResult, SuiteResult, read_result, write_result
from model.evaluation.scenery import Scenery, added_lights, level_place, recovered_scenery, true_scenery
from model.evaluation.suite import Method, ModifiedLight, NetworkMethod, Suite, TruthMethod
from model.evaluation.test_scene import PreparedScene, TestScene, assert_not_trained_on, prepare_scene
from model.evaluation.unwrapped_geometry import geometry_for
from model.reconstruction.captures import CaptureOptions, read_capture
from model.reconstruction.captures.rendered import package_geometry
from model.reconstruction.infer import infer
from model.reconstruction.infer_options import InferOptions
from model.reconstruction.merge import MAP_NAMES

Tell = Callable[[str, int, int], None]
OWN, MODIFIED, INSERTED = "own", "modified", "inserted"
_REVISION, _MEASURES = 2, 1
"""Of atlases and renderings, and of figures: others are made anew."""


@dataclass
class _Scene:
    """A scene as all methods share it. ``truth`` by light and view; ``place_m`` of the inserted object."""

    recipe: TestScene
    prepared: PreparedScene
    root: Path
    capture: Capture
    inputs: tuple[str, ...]
    novel: tuple[str, ...]
    sceneries: dict[str, Scenery]
    truth: dict[str, dict[str, JudgedView]]
    exposures: dict[str, float]
    figure_views: dict[str, str]
    renders: dict[str, str]

    def view(self, name: str) -> CaptureView:
        return next(view for view in self.capture.views if view.name == name)

    def views_of(self, light: str) -> tuple[str, ...]:
        return (self.figure_views["input"],) if light == INSERTED else (*self.inputs, *self.novel)


@dataclass(frozen=True)
class Evaluation:
    """``figure_views``: by scene, the views of its pictures as its capture has them."""

    result: SuiteResult
    figure_views: dict[str, dict[str, JudgedView]]


def evaluate(suite: Suite, cache: Path, tell: Tell = lambda stage, done, total: None) -> Evaluation:
    """Measure every method on every scene. Raises :class:`InputError` for bad scenes, maps and packages, and
    for a checkpoint that was trained on a scene."""
    lpips = Lpips()
    scenes, shown = [], {}
    for recipe in suite.scenes:
        prepared = prepare_scene(recipe, cache, lambda *progress: tell(*progress))
        if not suite.may_be_known:
            _assert_unknown(suite, prepared)
        scene = _open(suite, recipe, prepared, tell)
        methods = tuple(_judge(suite, scene, method, lpips, tell) for method in suite.methods)
        scenes.append(_scene_result(scene, methods))
        shown[recipe.name] = {name: scene.truth[OWN][name] for name in scene.figure_views.values()}
    result = SuiteResult(
        suite=suite.name, may_be_known=suite.may_be_known, lpips_absence=lpips.absence, scenes=tuple(scenes)
    )
    return Evaluation(result, shown)


def _assert_unknown(suite: Suite, prepared: PreparedScene) -> None:
    problems: list[Problem] = []
    for method in suite.methods:
        if isinstance(method, NetworkMethod) and Path(method.checkpoint).is_file():
            try:
                assert_not_trained_on(prepared, read_card(Path(method.checkpoint)))
            except InputError as error:
                problems += error.problems
    if problems:
        raise InputError(*problems)


# ---- the scene


def _open(suite: Suite, recipe: TestScene, prepared: PreparedScene, tell: Tell) -> _Scene:
    select_variant()
    whole = read_capture(
        prepared.capture, CaptureOptions(library=prepared.library, max_width_px=recipe.resolution[0])
    )
    random = np.random.default_rng([suite.seed, 0x76696577])
    drawn = random.permutation(len(prepared.input_names))[: suite.input_views]
    inputs = tuple(prepared.input_names[k] for k in sorted(drawn))
    novel = prepared.novel_names[: suite.novel_views]
    truth = true_scenery(prepared)
    modified = suite.modified_light.get(recipe.name, ModifiedLight())
    cameras = [view.camera for view in whole.views]
    scene = _Scene(
        recipe=recipe,
        prepared=prepared,
        root=prepared.capture.parent.parent.parent / "results",
        capture=whole,
        inputs=inputs,
        novel=novel,
        sceneries={
            OWN: truth,
            MODIFIED: truth.lit_by(modified, added_lights(modified, whole.geometry, cameras)),
        },
        truth={},
        exposures={},
        figure_views={},
        renders={},
    )
    scene.truth[OWN] = {name: stored_view(scene.view(name)) for name in (*inputs, *novel)}
    _choose_figures(suite, scene)
    for light in (MODIFIED, *([INSERTED] if INSERTED in scene.sceneries else [])):
        scenery = scene.sceneries[light]
        folder = _render_folder(scene, scenery, scene.views_of(light), recipe.render)
        scene.renders[light] = str(folder)
        scene.truth[light] = render_scenery(
            scenery,
            scene.views_of(light),
            folder,
            recipe.render,
            _told(tell, f"{recipe.name}: truth, {light}"),
        )
    scene.exposures = {light: common_exposure(list(views.values())) for light, views in scene.truth.items()}
    if INSERTED in scene.exposures:
        scene.exposures[INSERTED] = scene.exposures[OWN]
    return scene


def _choose_figures(suite: Suite, scene: _Scene) -> None:
    """Views for the pictures, and the place of the inserted object in one of them."""
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


def _scene_result(scene: _Scene, methods: tuple[MethodResult, ...]) -> SceneResult:
    samples = [view.render.path_samples for view in _records(scene)]
    return SceneResult(
        name=scene.recipe.name,
        num_views=len(scene.prepared.input_names),
        num_novel=len(scene.prepared.novel_names),
        resolution=scene.recipe.resolution,
        judged_views=scene.inputs,
        novel_views=scene.novel,
        exposures=scene.exposures,
        figure_views=scene.figure_views,
        path_samples=float(np.mean(samples)),
        renders=scene.renders,
        methods=methods,
    )


def _records(scene: _Scene) -> list[Any]:
    from datagen.formats.shard import ShardReader

    return list(ShardReader(scene.prepared.capture).records())


def _told(tell: Tell, stage: str) -> Callable[[int, int], None]:
    return lambda done, total: tell(stage, done, total)


def _render_folder(scene: _Scene, scenery: Scenery, views: tuple[str, ...], render: RenderRecipe) -> Path:
    seen = scenery.seen_by(views).configuration
    return scene.root / "renders" / _key(seen.model_dump(mode="json"), render.model_dump(mode="json"))


def _key(*parts: Any) -> str:
    return sha256_hex(canonical_json([_REVISION, *parts]))[:12]


# ---- a method


def _judge(suite: Suite, scene: _Scene, method: Method, lpips: Lpips, tell: Tell) -> MethodResult:
    """The figures of a method on a scene."""
    name = scene.recipe.name
    base = MethodResult(
        scene=name,
        method=method.name,
        kind=method.kind,
        geometry=method.geometry.describe() if method.geometry else "true",
    )
    weights = ""
    if isinstance(method, NetworkMethod):
        if not Path(method.checkpoint).is_file():
            return base.model_copy(update={"skipped": f"no checkpoint at {Path(method.checkpoint).name}"})
        weights = sha256_file(Path(method.checkpoint))
        base = base.model_copy(update={"checkpoint": f"{Path(method.checkpoint).stem} {weights[:12]}"})
    own = method.model_dump(mode="json", exclude={"checkpoint", "folder"})
    maps = _maps_identity(method, name)
    folder = scene.root / f"{method.name}-{_key(own, weights, suite.atlas, scene.inputs, maps)}"
    lights = {light: s.configuration.model_dump(mode="json") for light, s in scene.sceneries.items()}
    how = [_MEASURES, scene.novel, suite.render.model_dump(mode="json"), lights, not lpips.absence]
    path = folder / f"result-{_key(how)}.json"
    done = read_result(path)
    if done is not None:
        return done
    folder.mkdir(parents=True, exist_ok=True)
    forget_peak()

    def say(stage: str, number: int, total: int) -> None:
        tell(f"{name}, {method.name}: {stage}", number, total)

    measured = _measure(suite, scene, method, folder, lpips, say)
    measured |= {"folder": str(folder), "peak_memory_mb": round(peak_mb(), 1)}
    result = base.model_copy(update=measured)
    write_result(path, result)
    return result


def _maps_identity(method: Method, scene: str) -> list[str]:
    """What the files of given maps are, so that others are measured anew."""
    folder = getattr(method, "folder", None)
    if folder is None:
        return []
    files = sorted((folder / scene).rglob("*.exr"))
    return [f"{path.name} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in files]


def _measure(
    suite: Suite, scene: _Scene, method: Method, folder: Path, lpips: Lpips, tell: Tell
) -> dict[str, Any]:
    found: dict[str, Any] = {}
    seconds: dict[str, float] = {}
    if isinstance(method, TruthMethod):
        sceneries = scene.sceneries
    else:
        asset, found = _reconstruct(suite, scene, method, folder, tell)
        seconds = found["seconds"]
        found["maps_per_view"] = _per_view(scene, folder).mse()
        sceneries = {light: recovered_scenery(s, asset) for light, s in scene.sceneries.items()}
    start = time.perf_counter()
    renders, images, merged = {}, {}, MapSums()
    for light, scenery in sceneries.items():
        views = scene.views_of(light)
        other = scenery.with_seed(scenery.configuration.seed + 1)  # the truth's noise is not to be met again
        target = _render_folder(scene, other, views, suite.render)
        rendered = render_scenery(other, views, target, suite.render, _told(tell, f"render, {light}"))
        renders[light] = str(target)
        if light == INSERTED:
            continue
        images[light] = {
            "input": _figures(scene, light, scene.inputs, rendered, lpips),
            "novel": _figures(scene, light, scene.novel, rendered, lpips),
        }
        if light == OWN:
            for name in scene.inputs:
                merged.add(rendered[name].maps, scene.truth[OWN][name], rendered[name].surface_mask)
    seconds["render and compare"] = round(time.perf_counter() - start, 2)
    return {
        **found,
        "maps_merged": merged.mse(),
        "covered_share": merged.covered_share,
        "images": images,
        "renders": renders,
        "seconds": seconds,
    }


def _figures(
    scene: _Scene, light: str, views: tuple[str, ...], rendered: dict[str, JudgedView], lpips: Lpips
) -> dict[str, float | None]:
    truth = {name: scene.truth[light][name] for name in views}
    return image_figures(rendered, truth, scene.exposures[light], lpips)


def _reconstruct(
    suite: Suite, scene: _Scene, method: Method, folder: Path, tell: Tell
) -> tuple[Path, dict[str, Any]]:
    """The asset of a method, and what ``materials infer`` says of it; made where it is not there."""
    geometry, seconds = geometry_for(scene.capture.geometry, method.geometry, scene.root, tell)
    inputs = set(scene.prepared.input_names)
    views = tuple(view for view in scene.capture.views if view.name in inputs)
    capture = replace(scene.capture, views=views, geometry=geometry)
    options = InferOptions(atlas=suite.atlas, is_checked=False, has_exr=False)
    given = checkpoint = None
    if isinstance(method, NetworkMethod):
        checkpoint = Path(method.checkpoint)
        options = replace(options, is_filtered=method.is_filtered, weights=method.weights)
    else:
        assert not isinstance(method, TruthMethod)
        given = given_maps(method, scene.recipe.name, capture, folder / "views", scene.inputs)
    if not (folder / "report.json").is_file():
        infer(capture, folder, checkpoint, options, tell, given)
    report = json.loads((folder / "report.json").read_bytes())
    stages = {name: round(value, 2) for name, value in report["seconds"].items()}
    stages["unwrap"] = round(stages.get("unwrap", 0.0) + seconds, 2)
    found = {
        "seconds": stages,
        "seen_share": report["seen_share"],
        "atlas_size": report["atlas_size"],
        "notes": tuple(report["notes"]),
    }
    return folder / "asset", found


def _per_view(scene: _Scene, folder: Path) -> MapSums:
    """Errors of the maps as they were predicted."""
    sums = MapSums()
    for name in scene.inputs:
        maps = decode_view(folder / "views" / f"{name}.exr", MAP_NAMES)
        sums.add(maps, scene.truth[OWN][name])
    return sums
