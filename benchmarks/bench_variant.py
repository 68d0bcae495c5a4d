# SPDX-License-Identifier: MIT
"""Seconds by stage of a configuration's views in one Mitsuba variant, and differences from images of another.

    datagen plan light --out planned --configurations 1 --views 8
    SCENE_MATERIALS_VARIANT=llvm_ad_rgb python -m benchmarks.bench_variant planned --out llvm.npz
    SCENE_MATERIALS_VARIANT=cuda_ad_rgb python -m benchmarks.bench_variant planned --compare llvm.npz

Prints the mean time of a view and the median of each stage, without the first two views, which compile the
kernels; for each buffer, the largest difference and the share of pixels that differ beyond the rounding of
half floats; and the relMSE of the radiance. Differences are those of the worst view.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from benchmarks.timing import write_report
from datagen.farm.folder import DatasetFolder
from datagen.library import Library
from datagen.rendering.error import relative_mse
from datagen.rendering.renderer import SceneRenderer

COMPILING_VIEWS = 2
ROUNDING = 2.0**-10
"""Relative error of a half float, doubled since both images are rounded."""


def main() -> None:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("planned", type=Path, help="dataset folder with a plan")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--out", type=Path, help="file .npz of the views' buffers")
    parser.add_argument("--compare", type=Path, help="file .npz of another variant")
    parser.add_argument("--report", type=Path)
    args = parser.parse_args()
    folder = DatasetFolder(args.planned)
    configuration = folder.read_configuration(folder.read_plan().units[0])
    recipe = folder.read_recipe().render
    renderer = SceneRenderer(configuration, Library(folder.library_paths()), recipe)
    buffers: dict[str, np.ndarray] = {}
    seconds, stages, start = [], [], time.perf_counter()
    for view in renderer.render_views(range(args.views)):
        seconds.append(time.perf_counter() - start)
        stages.append(view.seconds)
        for name, values in view.buffers.items():
            is_float = values.dtype.kind == "f"
            buffers[f"{name}/{view.index}"] = values.astype(np.float16) if is_float else values
        start = time.perf_counter()
    if args.out is not None:
        np.savez_compressed(args.out, **buffers)
    report = {
        "variant": renderer.variant,
        "seconds_to_build": renderer.seconds_to_build,
        # The work of several views is interleaved, so the time of a single view is meaningless.
        "seconds_a_view": sum(seconds[COMPILING_VIEWS:]) / max(1, len(seconds) - COMPILING_VIEWS),
        "stages": {
            name: float(np.median([stage[name] for stage in stages[COMPILING_VIEWS:]])) for name in stages[0]
        },
    }
    if args.compare is not None:
        report["differences"] = _differences(buffers, np.load(args.compare))
    write_report(report, args.report)


def _differences(
    buffers: dict[str, np.ndarray], others: dict[str, np.ndarray]
) -> dict[str, dict[str, float]]:
    """Largest difference, share of differing pixels and relMSE (radiance) of the worst view, by buffer."""
    found: dict[str, dict[str, float]] = {}
    for key, values in buffers.items():
        name = key.partition("/")[0]
        ours, theirs = values.astype(np.float64), others[key].astype(np.float64)
        gap = np.abs(ours - theirs)
        row = found.setdefault(name, {"max": 0.0, "differing_share": 0.0})
        row["max"] = max(row["max"], float(gap.max()))
        row["differing_share"] = max(
            row["differing_share"], float((gap > ROUNDING * np.maximum(theirs, 1.0)).mean())
        )
        if name == "beauty":
            row["rel_mse"] = max(row.get("rel_mse", 0.0), float(relative_mse(ours, theirs)))
    return found


if __name__ == "__main__":
    main()
