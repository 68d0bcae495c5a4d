# SPDX-License-Identifier: MIT
"""Detection rate and false warnings of ``materials check``.

    python -m benchmarks.bench_capture_check SHARD ... --trials 4

The check runs on rendered captures with each of these changes: none; one camera in five rotated by 1 degree
about an axis perpendicular to its view direction, rolled by 2 degrees, or moved by 10 cm along its view
direction; the mesh moved by 2 cm in a random direction, or enlarged by 2 %. ``--snap 0.02`` coarsens the
mesh, as retopology does.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.formats.capture import Capture, CaptureGeometry, GeometryPart
from datagen.foundation.axes import affine
from datagen.foundation.meshes.mesh import Mesh, without_degenerate
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from model.reconstruction.check.capture_check import CheckReport, check_capture


def changed(
    capture: Capture, rng: np.random.Generator, change: Callable[[np.random.Generator], NDArray]
) -> tuple[Capture, set[str]]:
    """Move one camera in five by a transform (4, 4) of ``change``; returns capture and moved views' names."""
    wrong = rng.choice(len(capture.views), max(1, len(capture.views) // 5), replace=False)
    views = list(capture.views)
    for index in wrong:
        pose = views[index].camera.world_from_camera @ change(rng)
        views[index] = replace(views[index], camera=replace(views[index].camera, world_from_camera=pose))
    return replace(capture, views=tuple(views)), {views[index].name for index in wrong}


def turned(rng: np.random.Generator) -> NDArray:
    """Rotation (4, 4) by 1 degree about a random axis perpendicular to the view."""
    angle = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(angle), np.sin(angle), 0.0])
    return affine(Rotation.from_rotvec(np.radians(1.0) * axis).as_matrix())


def rolled(rng: np.random.Generator) -> NDArray:
    """Rotation (4, 4) by 2 or -2 degrees about the view direction."""
    angle = np.radians(2.0) * rng.choice([-1.0, 1.0])
    return affine(Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix())


def advanced(rng: np.random.Generator) -> NDArray:
    """Translation (4, 4) by 10 or -10 cm along the view direction."""
    return affine(np.eye(3), (0.0, 0.0, 0.1 * rng.choice([-1.0, 1.0])))


def transformed(capture: Capture, matrix: NDArray) -> Capture:
    """Return the capture with its mesh transformed by ``matrix`` (4, 4)."""
    mesh = capture.geometry.mesh.transformed(matrix)
    return replace(capture, geometry=replace(capture.geometry, mesh=mesh))


def moved(capture: Capture, rng: np.random.Generator, metres: float) -> tuple[Capture, np.ndarray]:
    """Move the mesh by ``metres`` in a random direction; returns the capture and the offset (3,)."""
    direction = rng.normal(size=3)
    offset = metres * direction / np.linalg.norm(direction)
    return transformed(capture, affine(np.eye(3), offset)), offset


def enlarged(capture: Capture, factor: float) -> Capture:
    """Return the capture with its mesh scaled by ``factor`` about the cameras' mean position."""
    middle = np.mean([camera.position_m for camera in capture.cameras], axis=0)
    return transformed(capture, affine(factor * np.eye(3), (1 - factor) * middle))


def snapped(capture: Capture, grid_m: float) -> Capture:
    """Return the capture with vertices rounded to multiples of ``grid_m``; lamps become ordinary surfaces."""
    mesh = capture.geometry.mesh
    positions = (np.round(mesh.positions / grid_m) * grid_m).astype(np.float32)
    made = without_degenerate(Mesh(positions, mesh.faces))
    return replace(capture, geometry=CaptureGeometry(made, (GeometryPart("mesh", 0, len(made.faces)),)))


def warned_views(report: CheckReport) -> set[str]:
    """Names of the views with a warning about edges."""
    words = ("edges", "the mesh looks")
    return {view.name for view in report.views if any(word in w for w in view.warnings for word in words)}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("shards", type=Path, nargs="+")
    parser.add_argument("--library", type=Path, action="append", default=[])
    parser.add_argument("--trials", type=int, default=4, help="trials of each change per capture")
    parser.add_argument("--snap", type=float, help="move the mesh's vertices to a grid of this many metres")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    counts: Counter[str] = Counter()
    errors: list[float] = []
    scales: list[float] = []
    start = time.process_time()
    num_checked = 0
    for shard in arguments.shards:
        capture = read_capture(shard, CaptureOptions(library=tuple(arguments.library)))
        if arguments.snap:
            capture = snapped(capture, arguments.snap)
        report = check_capture(capture)
        counts["captures"] += 1
        counts["views"] += len(capture.views)
        counts["false views"] += len(warned_views(report))
        counts["false for all"] += len(report.warnings)
        for _ in range(arguments.trials):
            for change in (turned, rolled, advanced):
                wrong, names = changed(capture, rng, change)
                found = warned_views(check_capture(wrong))
                counts[change.__name__] += len(names)
                counts[f"found {change.__name__}"] += len(names & found)
                counts[f"correct with {change.__name__}"] += len(capture.views) - len(names)
                counts[f"false with {change.__name__}"] += len(found - names)
            mistaken, offset = moved(capture, rng, 0.02)
            report = check_capture(mistaken)
            counts["moved"] += 1
            counts["views warned with moved"] += len(warned_views(report))
            if report.offset_m is not None:
                counts["found moved"] += 1
                errors.append(float(np.linalg.norm(np.array(report.offset_m) - offset)))
            report = check_capture(enlarged(capture, 1.02))
            counts["enlarged"] += 1
            counts["views warned with enlarged"] += len(warned_views(report))
            if report.scale != 1:
                counts["found enlarged"] += 1
                scales.append(abs(report.scale - 1.02))
            num_checked += 5 * len(capture.views)
        num_checked += len(capture.views)
        print(shard.name, dict(counts), flush=True)
    cpu_s = (time.process_time() - start) / num_checked
    print(
        f"processor time {1000 * cpu_s:.0f} ms per view; offset off by {1000 * np.median(errors or [0]):.1f} "
        f"mm, scale by {100 * np.median(scales or [0]):.2f} %"
    )
    if arguments.json:
        found_all = {**counts, "offset_errors_m": errors, "scale_errors": scales, "cpu_s": cpu_s}
        arguments.json.write_text(json.dumps(found_all, indent=2))


if __name__ == "__main__":
    main()
