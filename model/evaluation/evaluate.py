# SPDX-License-Identifier: MIT
"""Evaluation of all methods of a suite on all its scenes, with results cached in these folders:

CACHE/geometries/               unwrapped meshes that methods use
CACHE/features/                 LPIPS features of the truth
CACHE/<scene>-<key>/            the rendered scene (``room``)
CACHE/<scene>-<key>/results/
    predictions-<key>/          maps of a checkpoint, shared by methods that differ in later stages only
    <method>-<key>/             output of ``materials infer``, views/ and result-<key>.json
    renders/<key>/              VIEW.exr; the key is a hash of all inputs that affect the pixels
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import canonical_json, sha256_file, write_bytes_atomically
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.errors import InputError, Problem, raise_problems
from datagen.foundation.exr import decode_view
from datagen.foundation.peak_memory import forget_peak, peak_mb, processor_s
from datagen.foundation.versions import LIGHT_REVISION
from model.checkpoint import read_card
from model.evaluation.baselines import given_maps, maps_files
from model.evaluation.camera_faults import CameraFaults, as_taken
from model.evaluation.lpips import Lpips
from model.evaluation.map_measures import MapMeasures
from model.evaluation.mesh_errors import geometry_for
from model.evaluation.metrics import means
from model.evaluation.opened_scene import (
    INSERTED,
    OWN,
    OpenedScene,
    Tell,
    key_of,
    light_revision,
    link_files,
    mesh_revision,
    open_scene,
    predictions_folder,
    stage_progress,
)
from model.evaluation.rendering import JudgedView
from model.evaluation.rerendering import (
    figures_of,
    merged_confidence,
    recovered_sceneries,
    renderings_of,
    spread_of,
)
from model.evaluation.results import MethodResult, SuiteResult, read_result
from model.evaluation.room import PlannedScene, assert_not_trained_on, photograph, plan_scene
from model.evaluation.suite import MapsMethod, Method, NetworkMethod, Suite, TruthMethod
from model.reconstruction.infer import infer
from model.reconstruction.infer_options import InferOptions
from model.reconstruction.predict.sources import CheckpointMaps
from model.reconstruction.stages import MapSource

_MEASURES = 5
"""Revision of the measures; cached figures of a different revision are measured again."""
_RECONSTRUCTION = 31
"""Revision of ``materials infer``; cached maps of a different revision are computed again."""
_TRUE_SCENE = 17
"""Revision of methods of kind ``truth``, which render the scene again."""
_MATERIALS_FROM_LIGHT = 41
"""Revision, besides ``LIGHT_REVISION``, of materials fitted to the recorded light (option ``materials``)."""
_TAKEN = 1
"""Revision of photographs with camera faults."""


@dataclass(frozen=True)
class Evaluation:
    """Result of a suite; ``truth``: true views under each scene's own light, by scene and view."""

    result: SuiteResult
    truth: dict[str, dict[str, JudgedView]]


def evaluate(suite: Suite, cache: Path, tell: Tell = lambda stage, done, total: None) -> Evaluation:
    """Evaluate every method on every scene of a suite; ``cache`` is the folder of intermediate results.

    Before any rendering, all scenes are imported and compared with the training data of the checkpoints. A
    scene that fails (a bad source, faulty maps, a checkpoint trained on it) is listed in the result's
    ``failures`` with the reason.
    """
    lpips = Lpips(cache / "features")
    failures: dict[str, str] = {}
    planned: dict[str, PlannedScene] = {}
    for recipe in suite.scenes:
        tell(f"{recipe.name}: plan", 0, 1)
        try:
            planned[recipe.name] = plan_scene(recipe, cache)
            if not suite.may_be_known:
                _assert_unknown(suite, planned[recipe.name])
        except InputError as error:
            failures[recipe.name] = str(error)
    scenes, shown = [], {}
    for recipe in suite.scenes:
        if recipe.name in failures:
            continue
        try:
            quality = suite.judging(recipe)
            scene = _opened(quality, planned[recipe.name], tell)
            methods = tuple(
                judge(quality, scene, method, camera, lpips, tell)
                for camera in (None, *suite.cameras)
                for method in suite.methods
                if camera is None or not isinstance(method, TruthMethod)
            )
        except InputError as error:
            failures[recipe.name] = str(error)
            continue
        scenes.append(scene.result(methods))
        shown[recipe.name] = scene.truth[OWN]
    result = SuiteResult(
        suite=suite.name,
        may_be_known=suite.may_be_known,
        lpips_absence=lpips.absence,
        scenes=tuple(scenes),
        failures=failures,
    )
    return Evaluation(result, shown)


def _opened(suite: Suite, planned: PlannedScene, tell: Tell) -> OpenedScene:
    """Render a planned scene, open it, and check the files of methods of kind ``maps``."""
    name = planned.recipe.name
    prepared = photograph(planned, lambda stage, done, total: tell(f"{name}: {stage}", done, total))
    scene = open_scene(suite, planned.recipe, prepared, tell)
    _check_maps(suite, scene)
    return scene


def _assert_unknown(suite: Suite, planned: PlannedScene) -> None:
    problems: list[Problem] = []
    for method in suite.methods:
        if isinstance(method, NetworkMethod) and Path(method.checkpoint).is_file():
            try:
                assert_not_trained_on(planned, read_card(Path(method.checkpoint)))
            except InputError as error:
                problems += error.problems
    raise_problems(problems)


def _check_maps(suite: Suite, scene: OpenedScene) -> None:
    """Raise :class:`InputError` for invalid files of methods of kind ``maps``, before other methods run."""
    problems: list[Problem] = []
    for method in suite.methods:
        if isinstance(method, MapsMethod):
            try:
                maps_files(method.folder / scene.recipe.name, scene.input_capture())
            except InputError as error:
                problems += error.problems
    raise_problems(problems)


# ---- a method


def judge(
    suite: Suite, scene: OpenedScene, method: Method, camera: CameraFaults | None, lpips: Lpips, tell: Tell
) -> MethodResult:
    """Evaluate a method on photographs of a scene with the faults ``camera``, or read the cached result."""
    name = scene.recipe.name
    base = MethodResult(
        scene=name,
        method=method.name,
        kind=method.kind,
        geometry=method.geometry.describe() if method.geometry else "true",
        camera=camera.name if camera else "",
    )
    weights = ""
    further: list[Any] = []
    if isinstance(method, NetworkMethod):
        if not Path(method.checkpoint).is_file():
            return base.model_copy(update={"skipped": f"no checkpoint at {Path(method.checkpoint).name}"})
        weights = sha256_file(Path(method.checkpoint))
        base = base.model_copy(update={"checkpoint": f"{Path(method.checkpoint).stem} {weights[:12]}"})
        of_stage = [LIGHT_REVISION, _MATERIALS_FROM_LIGHT]
        further = light_revision(method) if method.materials == "network" else of_stage
    own = method.model_dump(mode="json", exclude={"checkpoint", "folder"})
    maps = _maps_identity(method, name)
    further += [_TAKEN, camera.model_dump(mode="json")] if camera else []
    further += mesh_revision(method, camera)
    revision = _TRUE_SCENE if method.kind == "truth" else _RECONSTRUCTION
    key = key_of(revision, own, weights, suite.atlas, scene.inputs, maps, *further)
    folder = scene.root / f"{'-'.join([method.name, *([camera.name] if camera else [])])}-{key}"
    lights = {light: s.configuration.model_dump(mode="json") for light, s in scene.sceneries.items()}
    rendering = [None if r is None else r.model_dump(mode="json") for r in (suite.render, suite.truth)]
    how = [_MEASURES, scene.novel, rendering, suite.seed_views, suite.noise_share, lights, not lpips.absence]
    path = folder / f"result-{key_of(how)}.json"
    done = read_result(path)
    if done is not None:
        # the cache may have been moved, or its renderings removed
        renders = {light: scene.renderings / Path(kept).name for light, kept in done.renders.items()}
        if all(kept.is_dir() for kept in renders.values()):
            places = {light: str(kept) for light, kept in renders.items()}
            return done.model_copy(update={"folder": str(folder), "renders": places})
    folder.mkdir(parents=True, exist_ok=True)
    forget_peak()
    before_s = processor_s()

    def report(stage: str, number: int, total: int) -> None:
        tell(f"{name}, {base.label}: {stage}", number, total)

    measured = measure(suite, scene, method, camera, folder, lpips, report)
    measured |= {
        "folder": str(folder),
        "peak_memory_mb": round(peak_mb(), 1),
        "processor_s": round(processor_s() - before_s, 1),
    }
    result = base.model_copy(update=measured)
    write_bytes_atomically(path, canonical_json(result))
    return result


def _maps_identity(method: Method, scene: str) -> list[str]:
    """Name, size and modification time of each file of a method of kind ``maps``; empty for other methods."""
    folder = getattr(method, "folder", None)
    if folder is None:
        return []
    files = sorted((folder / scene).rglob("*.exr"))
    return [f"{path.name} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in files]


def measure(
    suite: Suite,
    scene: OpenedScene,
    method: Method,
    camera: CameraFaults | None,
    folder: Path,
    lpips: Lpips,
    tell: Tell,
) -> dict[str, Any]:
    found: dict[str, Any] = {}
    seconds: dict[str, float] = {}
    confidence: dict[str, NDArray[np.float64]] = {}
    if isinstance(method, TruthMethod):
        sceneries = scene.sceneries
    else:
        found = _reconstruct(suite, scene, method, camera, folder, tell)
        seconds = found["seconds"]
        found |= _map_results("per_view", _per_view(scene, folder))
        sceneries = recovered_sceneries(scene, folder / "asset")
        confidence = merged_confidence(folder, {n: scene.view(n).camera for n in scene.inputs})
    start = time.perf_counter()
    renders, images, merged = {}, {}, MapMeasures()
    spread: dict[str, dict[str, float]] = {}
    for light, scenery in sceneries.items():
        progress = stage_progress(tell, f"render, {light}")
        first, again = renderings_of(suite, scene, method, light, scenery, progress)
        renders[light] = str(first.folder)
        if light == INSERTED:
            continue
        rendered = first.read()
        of_light = lpips if light == OWN else None
        images[light] = {
            "input": figures_of(scene, light, scene.inputs, rendered, of_light),
            "novel": figures_of(scene, light, scene.novel, rendered, of_light),
        }
        spread[light] = spread_of(scene, light, again, images[light], of_light)
        if light == OWN:
            for name in scene.inputs:
                view, true, sure = rendered[name], scene.truth[OWN][name], confidence.get(name)
                merged.add(name, view.maps, true, scene.surfaces(name), rendered=view, confidence=sure)
    seconds["render and compare"] = round(time.perf_counter() - start, 2)
    return {
        **found,
        **_map_results("merged", merged, found),
        "covered_share": merged.covered_share,
        "images": {light: {k: means(rows) for k, rows in sets.items()} for light, sets in images.items()},
        "image_views": images,
        "seed_spread": spread,
        "renders": renders,
        "seconds": seconds,
    }


def _reconstruct(
    suite: Suite, scene: OpenedScene, method: Method, camera: CameraFaults | None, folder: Path, tell: Tell
) -> dict[str, Any]:
    """Run ``infer`` for a method unless its report exists; return its times, figures and notes."""
    error = method.geometry or (camera.geometry if camera else None)
    geometry, seconds = geometry_for(scene.capture.geometry, error, scene.geometries, tell)
    capture = replace(scene.input_capture(), geometry=geometry)
    if camera is not None:
        capture = as_taken(capture, camera)
    options = InferOptions(atlas=suite.atlas, is_checked=False, has_exr=False)
    source: MapSource
    if isinstance(method, NetworkMethod):
        source = CheckpointMaps(Path(method.checkpoint))
        options = replace(
            options,
            is_filtered=method.is_filtered,
            weights=method.weights,
            is_leveled=method.is_leveled,
            materials=method.materials,
        )
    else:
        assert not isinstance(method, TruthMethod)
        source = given_maps(method, scene.recipe.name, capture, folder / "views", scene.inputs)
    if not (folder / "report.json").is_file():
        if isinstance(method, NetworkMethod):
            shared = predictions_folder(scene, method, camera, source.identity)
            link_files(shared, folder / "views")
            infer(capture, folder, source, options, tell)
            link_files(folder / "views", shared)
        else:
            infer(capture, folder, source, options, tell)
    report = json.loads((folder / "report.json").read_bytes())
    stages = {name: round(value, 2) for name, value in report["seconds"].items()}
    stages["unwrap"] = round(stages.get("unwrap", 0.0) + seconds, 2)
    return {
        "seconds": stages,
        "seen_share": report["seen_share"],
        "atlas_size": report["atlas_size"],
        "notes": tuple(report["notes"]),
    }


def _per_view(scene: OpenedScene, folder: Path) -> MapMeasures:
    """Errors of the maps predicted for the judged input views, before they are merged."""
    measures = MapMeasures()
    for name in scene.inputs:
        maps = decode_view(folder / "views" / f"{name}.exr", MATERIAL_MAPS)
        sure = folder / "views" / f"{name}.confidence.npy"
        confidence = np.load(sure) if sure.is_file() else None
        measures.add(name, maps, scene.truth[OWN][name], scene.surfaces(name), confidence=confidence)
    return measures


def _map_results(stage: str, measures: MapMeasures, earlier: dict[str, Any] | None = None) -> dict[str, Any]:
    """Fields of :class:`MethodResult` for the maps of a stage, merged with those of ``earlier`` stages."""
    found = earlier or {}
    return {
        f"maps_{stage}": measures.mse(),
        "map_figures": {**found.get("map_figures", {}), stage: measures.figures()},
        "map_views": {**found.get("map_views", {}), stage: measures.views},
        "by_kind": {**found.get("by_kind", {}), stage: measures.by_kind()},
        "calibration": measures.calibration() or found.get("calibration", {}),
    }
