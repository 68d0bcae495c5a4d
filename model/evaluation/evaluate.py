# SPDX-License-Identifier: MIT
"""Runs a suite: scenes, methods, figures. What is in the cache already is not done again.

CACHE/<scene>-<key>/            the rendered scene (``room``)
CACHE/<scene>-<key>/results/
    geometry-<key>/             the mesh that a method gets, unwrapped
    <method>-<key>/             what ``materials infer`` writes, views/ and result-<key>.json
    renders/<key>/              VIEW.exr, a folder for all that decides the pixels
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from datagen.formats.base import sha256_file
from datagen.foundation.errors import InputError, Problem
from datagen.foundation.exr import decode_view
from model.checkpoint import read_card
from model.evaluation.baselines import given_maps, maps_files
from model.evaluation.metrics import Lpips, MapSums, image_figures
from model.evaluation.opened_scene import INSERTED, OWN, OpenedScene, Tell, key_of, open_scene, told
from model.evaluation.peak_memory import forget_peak, peak_mb
from model.evaluation.rendering import JudgedView, render_scenery
from model.evaluation.results import MethodResult, SuiteResult, read_result, write_result
from model.evaluation.room import PreparedScene, assert_not_trained_on, prepare_scene
from model.evaluation.scenery import recovered_scenery
from model.evaluation.suite import MapsMethod, Method, NetworkMethod, Suite, TruthMethod
from model.evaluation.unwrapped_geometry import geometry_for
from model.reconstruction.atlas.atlas import MAP_NAMES
from model.reconstruction.infer import infer
from model.reconstruction.infer_options import InferOptions
from model.reconstruction.predict.sources import CheckpointMaps
from model.reconstruction.stages import MapSource

_MEASURES = 1
"""Revision of the figures: those of another are measured anew."""


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
        scene = open_scene(suite, recipe, prepared, tell)
        _check_maps(suite, scene)
        methods = tuple(_judge(suite, scene, method, lpips, tell) for method in suite.methods)
        scenes.append(scene.result(methods))
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


def _check_maps(suite: Suite, scene: OpenedScene) -> None:
    """Refuse faulty maps of other methods before hours are spent on others."""
    problems: list[Problem] = []
    for method in suite.methods:
        if isinstance(method, MapsMethod):
            try:
                maps_files(method.folder / scene.recipe.name, scene.input_capture())
            except InputError as error:
                problems += error.problems
    if problems:
        raise InputError(*problems)


# ---- a method


def _judge(suite: Suite, scene: OpenedScene, method: Method, lpips: Lpips, tell: Tell) -> MethodResult:
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
    folder = scene.root / f"{method.name}-{key_of(own, weights, suite.atlas, scene.inputs, maps)}"
    lights = {light: s.configuration.model_dump(mode="json") for light, s in scene.sceneries.items()}
    how = [_MEASURES, scene.novel, suite.render.model_dump(mode="json"), lights, not lpips.absence]
    path = folder / f"result-{key_of(how)}.json"
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
    suite: Suite, scene: OpenedScene, method: Method, folder: Path, lpips: Lpips, tell: Tell
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
        target = scene.render_folder(other, views, suite.render)
        rendered = render_scenery(other, views, target, suite.render, told(tell, f"render, {light}"))
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
    scene: OpenedScene, light: str, views: tuple[str, ...], rendered: dict[str, JudgedView], lpips: Lpips
) -> dict[str, float | None]:
    truth = {name: scene.truth[light][name] for name in views}
    return image_figures(rendered, truth, scene.exposures[light], lpips)


def _reconstruct(
    suite: Suite, scene: OpenedScene, method: Method, folder: Path, tell: Tell
) -> tuple[Path, dict[str, Any]]:
    """The asset of a method, and what ``materials infer`` says of it; made where it is not there."""
    geometry, seconds = geometry_for(scene.capture.geometry, method.geometry, scene.root, tell)
    capture = replace(scene.input_capture(), geometry=geometry)
    options = InferOptions(atlas=suite.atlas, is_checked=False, has_exr=False)
    source: MapSource
    if isinstance(method, NetworkMethod):
        source = CheckpointMaps(Path(method.checkpoint))
        options = replace(
            options,
            is_filtered=method.is_filtered,
            weights=method.weights,
            is_leveled=method.is_leveled,
        )
    else:
        assert not isinstance(method, TruthMethod)
        source = given_maps(method, scene.recipe.name, capture, folder / "views", scene.inputs)
    if not (folder / "report.json").is_file():
        infer(capture, folder, source, options, tell)
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


def _per_view(scene: OpenedScene, folder: Path) -> MapSums:
    """Errors of the maps as they were predicted."""
    sums = MapSums()
    for name in scene.inputs:
        maps = decode_view(folder / "views" / f"{name}.exr", MAP_NAMES)
        sums.add(maps, scene.truth[OWN][name])
    return sums
