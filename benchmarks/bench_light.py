# SPDX-License-Identifier: MIT
"""Errors of each room's maps: as the network predicts them, with the albedo scale, and fitted to the light.

    python -m benchmarks.bench_light SUITE --cache DIR [--rooms NAME ...] [--views 12 80] [--sheet FOLDER]
        [--worse-mesh] [--camera PRESET] [--ablate] [--checkpoint FILE]

Renders the scenes of a suite, or reads them from the cache of ``materials evaluate``, and predicts the maps
of their first ``--views`` photographs with the bundled network, or with ``--checkpoint``. The method *light*
fits the maps to the light recorded in the photographs. Mean squared errors are over every third surface pixel
along both axes, in total and on metal (S > 0.2), white (D > 0.6) and glossy surfaces (R < 0.4). ``--sheet``
writes a picture of three views per room: D of network, light and ground truth, R of light and ground truth.
``--worse-mesh`` displaces vertices by 1 cm, keeps three tenths of the triangles and cuts holes in 5 % of the
area. ``--camera`` degrades the photographs (camera_faults.py). ``--ablate`` adds a row per omitted step.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.color import srgb_from_linear
from datagen.geometry.views import TracedCapture, trace_capture
from mitsuba_plugins.variant import select_variant
from model.checkpoint import bundled_checkpoint
from model.evaluation.camera_faults import PRESETS, as_taken
from model.evaluation.mesh_errors import with_errors
from model.evaluation.room import prepare_scene
from model.evaluation.suite import read_suite
from model.reconstruction.albedo_level import leveled
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from model.reconstruction.infer_options import InferOptions, InferReport
from model.reconstruction.light.map_stage import lit
from model.reconstruction.light.options import LightOptions
from model.reconstruction.mesh.smoothing import mended_mesh
from model.reconstruction.predict.sources import CheckpointMaps
from model.reconstruction.radiometry.completed import completed
from model.reconstruction.stages import Estimate, Maps, Run

ABLATIONS = {
    "no prior of the network": LightOptions(has_prior=False),
    "no correction of the shading": LightOptions(is_corrected=False),
    "no estimate of unseen surface": LightOptions(estimates_unseen=False),
    "edges not unmixed": LightOptions(unmixes_edges=False),
    "mixed surfels not bounded": LightOptions(bounds_mixed=False),
    "no sun": LightOptions(finds_sun=False),
    "estimates without gains": LightOptions(fits_estimates=False),
    "one round: metals pass their median on": LightOptions(num_rounds=1),
    "irradiance not smoothed": LightOptions(smoothing_neighbours=1),
    "a sixth of the points": LightOptions(max_points=4_000),
    "a fourth of the rays": LightOptions(irradiance_rays=36, solve_rays=6, specular_rays=3),
}
ALONG = 3
"""Stride of the measured pixels along both axes."""


def measured(maps: list[Maps], truth: list[dict[str, NDArray]]) -> str:
    """Table cells: mean squared errors of D, S and R by kind of surface."""
    on_surface = np.concatenate([t["surface_mask"][::ALONG, ::ALONG].ravel() for t in truth]) > 0.5

    def stacked(of: Sequence[dict[str, NDArray]], name: str) -> NDArray[np.float64]:
        parts = [m[name][::ALONG, ::ALONG].reshape(-1, m[name].shape[2]) for m in of]
        return np.concatenate(parts).astype(np.float64)[on_surface]

    diffuse, specular, roughness = true = [stacked(truth, name) for name in MATERIAL_MAPS]
    errors = [(stacked(maps, name) - wanted) ** 2 for name, wanted in zip(MATERIAL_MAPS, true, strict=True)]
    kinds = {
        "all": np.ones(len(diffuse), dtype=bool),
        "metal": specular.mean(axis=1) > 0.2,
        "white": diffuse.mean(axis=1) > 0.6,
        "glossy": roughness[:, 0] < 0.4,
    }
    cells = []
    for chosen in kinds.values():
        parts = [error[chosen].mean() if chosen.any() else np.nan for error in errors]
        cells.append(" ".join(f"{part:.5f}" for part in parts))
    return " | ".join(cells)


def draw_sheet(path: Path, network: list[Maps], light: list[Maps], truth: list[dict[str, NDArray]]) -> None:
    """Write a picture of three rows of views: D of network, light fit and truth; R of light fit and truth."""
    from PIL import Image

    def tile(maps: dict[str, NDArray], name: str) -> NDArray:
        values = np.clip(np.asarray(maps[name][::2, ::2], np.float64), 0, 1)
        shown = srgb_from_linear(values) if values.shape[2] == 3 else np.repeat(values, 3, axis=2)
        return np.round(255 * shown).astype(np.uint8)

    diffuse, _, roughness = MATERIAL_MAPS
    lines = []
    for k in (len(truth) // 4, len(truth) // 2, 3 * len(truth) // 4):
        shown = [(maps, diffuse) for maps in (network, light, truth)]
        shown += [(maps, roughness) for maps in (light, truth)]
        lines.append(np.hstack([tile(maps[k], name) for maps, name in shown]))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack(lines)).save(path, quality=88)


def rows(traced: TracedCapture, run: Run, checkpoint: Path, sheet: Path | None, ablates: bool) -> None:
    """Print a room's rows of the table, with a row per omitted step if ``ablates``; write its ``sheet``."""
    truth = [view.source.read_maps((*MATERIAL_MAPS, "surface_mask")) for view in traced.capture.views]
    name = f"{traced.capture.name} | {len(truth)}"
    source = CheckpointMaps(checkpoint)
    source.prepare(run.options)
    traced, doubt_at = completed(traced, run)
    network = Estimate(source.maps(traced, run), doubt_at)
    print(f"{name} | network | {measured(network.maps, truth)}", flush=True)
    level = leveled(traced, network, run)
    print(f"{name} | network, level | {measured(level.maps, truth)}", flush=True)
    maps = lit(traced, level, run).maps
    light = run.report.light
    print(f"{name} | light | {measured(maps, truth)}", flush=True)
    print(f"  light: {run.report.seconds['light']:.0f} s, {light['num_surfels']} surfels, "
          f"{light['photographed_share']:.2f} of their light photographed", flush=True)  # fmt: skip
    for label, options in ABLATIONS.items() if ablates else ():
        print(f"{name} | {label} | {measured(lit(traced, level, run, options).maps, truth)}", flush=True)
    if sheet is not None:
        draw_sheet(sheet / f"{traced.capture.name}.jpg", network.maps, maps, truth)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("suite", type=Path)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--rooms", nargs="*", help="scenes of the suite; default: all")
    parser.add_argument("--views", type=int, nargs="*", default=[4096], help="numbers of photographs")
    parser.add_argument("--sheet", type=Path, help="folder for pictures")
    parser.add_argument("--worse-mesh", action="store_true", help="use an inaccurate mesh")
    parser.add_argument("--camera", choices=tuple(PRESETS), help="degrade the photographs")
    parser.add_argument("--ablate", action="store_true", help="a row for each omitted step")
    parser.add_argument("--checkpoint", type=Path, default=bundled_checkpoint())
    options = parser.parse_args()
    faults = PRESETS[options.camera] if options.camera else None
    of_camera = None if faults is None else faults.geometry
    error = PRESETS["mesh"].geometry if options.worse_mesh else of_camera
    select_variant()
    print("room | views | method | all D S R | metal | white | glossy")
    for scene in read_suite(options.suite).scenes:
        if options.rooms and scene.name not in options.rooms:
            continue
        prepared = prepare_scene(scene, options.cache)
        reading = CaptureOptions(library=prepared.library, max_width_px=scene.resolution[0])
        capture = read_capture(prepared.capture, reading)
        if error is not None:
            capture = replace(capture, geometry=with_errors(capture.geometry, error))
        photographs = tuple(view for view in capture.views if view.name in prepared.input_names)
        for count in options.views:
            chosen = replace(capture, views=photographs[:count])
            changes = "-worse" if options.worse_mesh else ""
            if faults is not None:
                chosen = as_taken(chosen, faults)
                changes += f"-{faults.name}"
            identity = CheckpointMaps(options.checkpoint).identity[:8]
            name = f"{prepared.capture.stem}-{len(chosen.views)}{changes}-{identity}"
            out = options.cache / "light" / name
            (out / "views").mkdir(parents=True, exist_ok=True)
            report = InferReport(chosen.name, len(chosen.views), len(chosen.geometry.mesh.faces))
            run = Run(out, InferOptions(materials="both"), report, lambda *_: None)
            traced = trace_capture(mended_mesh(chosen, run))
            if "left_deg" in report.mesh:
                print(f"  mesh: {report.mesh}")
            rows(traced, run, options.checkpoint, options.sheet, options.ablate)


if __name__ == "__main__":
    main()
