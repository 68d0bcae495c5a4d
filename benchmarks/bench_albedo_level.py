# SPDX-License-Identifier: MIT
"""Effect of the albedo scale: mean squared errors of the views' maps without and with it.

    python -m benchmarks.bench_albedo_level SUITE --cache DIR [--views 12 25] [--clip 0.02] [--always]

Renders the scenes of a suite, or reads them from the cache of ``materials evaluate``, and predicts the maps
of their photographs with the suite's networks, for all photographs or for the first ``--views``. ``--clip``:
share of pixels clipped by a simulated sensor. Errors are those of D over all surface pixels; "best gain" is
the factor on the room's predicted D that minimises the error.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import model.reconstruction.level.albedo_level as albedo_level
from datagen.formats.capture import Capture
from datagen.geometry.traced import smooth_regions
from datagen.geometry.views import TracedCapture, trace_capture
from datagen.multiview.statistics import StatisticsOptions, compute_statistics
from mitsuba_plugins.variant import select_variant
from model.checkpoint import load_checkpoint
from model.evaluation.room import TestScene, prepare_scene
from model.evaluation.suite import NetworkMethod, read_suite
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from model.reconstruction.predict.predictor import PredictOptions, Predictor, capture_exposure, view_tensors

COLUMNS = (
    "room | network | views | known | used | spread | impossible | room gain | best gain | before | after"
)


def captured(scene: TestScene, cache: Path) -> Capture:
    """Render a scene unless it is in ``cache``, and return the capture of its photographs."""
    prepared = prepare_scene(scene, cache)
    options = CaptureOptions(library=prepared.library, max_width_px=scene.resolution[0])
    capture = read_capture(prepared.capture, options)
    return replace(capture, views=tuple(v for v in capture.views if v.name in prepared.input_names))


def predicted(traced: TracedCapture, checkpoint: Path) -> Iterator[dict[str, NDArray]]:
    """Yield the maps (H, W, C) that ``checkpoint`` predicts for each view, by name."""
    views = traced.statistics
    predictor = Predictor(load_checkpoint(checkpoint, "cpu"), capture_exposure(views), PredictOptions())
    gathered = compute_statistics(views, StatisticsOptions())
    for view, statistics, buffers in zip(traced.views, gathered, views, strict=True):
        yield predictor.predict([view_tensors(view.camera, buffers, statistics)])[0]


def row(capture: Capture, name: str, checkpoint: Path, clip: float) -> str:
    """Table row of the network ``name`` on a capture, with the brightest share ``clip`` of pixels clipped."""
    traced = trace_capture(capture)
    region_of_face = smooth_regions(traced.geometry.mesh)
    if clip:
        limit = np.quantile(np.concatenate([v.color.max(axis=2).ravel() for v in traced.views]), 1 - clip)
        clipped = tuple(replace(v, color=np.minimum(v.color, limit)) for v in traced.views)
        traced = replace(traced, views=clipped)
    maps = list(predicted(traced, checkpoint))
    emits = capture.geometry.emitter_mask()
    level = albedo_level.find_level(traced.views, maps, traced.geometry, emits, region_of_face)
    sums = np.zeros(5)
    for view, view_maps, seen in zip(capture.views, maps, traced.views, strict=True):
        face = seen.geometry.face
        truth = view.source.read_maps(("diffuse_albedo", "surface_mask"))
        on_surface = truth["surface_mask"][..., 0] > 0.5
        region = np.where(face >= 0, region_of_face[np.maximum(face, 0)], -1)
        before = view_maps["diffuse_albedo"]
        after = level.corrected(before, region)[on_surface].astype(np.float64)
        true, before = truth["diffuse_albedo"][on_surface].astype(np.float64), before[on_surface]
        sums += [((before - true) ** 2).sum(), ((after - true) ** 2).sum(), (before * true).sum(),
                 (before * before).sum(), true.size]  # fmt: skip
    report = level.report
    found = (report.coverage, report.used_share, report.spread, report.impossible_share, report.gain[1])
    figures = [f"{value:.2f}" for value in (*found, sums[2] / sums[3])]
    figures += [f"{sums[k] / sums[4]:.4f}" for k in range(2)]
    remark = "" if report.is_applied else f" unchanged: {report.reason}"
    return f"| {capture.name} | {name} | {len(traced.views)} | {' | '.join(figures)} |{remark}"


def main() -> None:
    """Print the table of errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("suite", type=Path)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--views", type=int, nargs="*", default=[0], help="numbers of photographs; 0: all")
    parser.add_argument("--clip", type=float, default=0.0)
    parser.add_argument("--always", action="store_true", help="also correct with too little evidence")
    arguments = parser.parse_args()
    select_variant()
    if arguments.always:
        albedo_level.MIN_USED, albedo_level.IMPOSSIBLE, albedo_level.MAX_SPREAD = 0.0, (1.0, 2.0), np.inf
    suite = read_suite(arguments.suite)
    print(f"| {COLUMNS} |", "|---" * (COLUMNS.count("|") + 1) + "|", sep="\n")
    for scene in suite.scenes:
        whole = captured(scene, arguments.cache)
        for number in arguments.views:
            capture = replace(whole, views=whole.views[: number or None])
            for method in suite.methods:
                if isinstance(method, NetworkMethod):
                    print(row(capture, method.name, Path(method.checkpoint), arguments.clip), flush=True)


if __name__ == "__main__":
    main()
