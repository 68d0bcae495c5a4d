# SPDX-License-Identifier: MIT
"""How often ``materials check`` notices what is wrong, and how often it warns of what is right.

    python -m benchmarks.bench_capture_check SHARD ... --trials 4

On rendered captures: nothing changed; one camera in five turned by 1 degree about an axis across its view;
the mesh moved by 2 cm in a random direction. ``--snap 0.02`` makes the mesh as coarse as retopology does.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from datagen.formats.capture import Capture, CaptureGeometry, GeometryPart
from datagen.meshes import Mesh, without_degenerate
from model.reconstruction.captures import CaptureOptions, read_capture
from model.reconstruction.check import CheckReport, check_capture


def turned(capture: Capture, rng: np.random.Generator, degrees: float) -> tuple[Capture, set[str]]:
    """One view in five turned about an axis across its view; their names."""
    wrong = rng.choice(len(capture.views), max(1, len(capture.views) // 5), replace=False)
    views = list(capture.views)
    for index in wrong:
        angle = rng.uniform(0, 2 * np.pi)
        axis = np.array([np.cos(angle), np.sin(angle), 0.0])
        pose = views[index].camera.world_from_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
        views[index] = replace(views[index], camera=replace(views[index].camera, world_from_camera=pose))
    return replace(capture, views=tuple(views)), {views[index].name for index in wrong}


def moved(capture: Capture, rng: np.random.Generator, metres: float) -> tuple[Capture, np.ndarray]:
    """The mesh moved in a random direction; the offset."""
    way = rng.normal(size=3)
    offset = metres * way / np.linalg.norm(way)
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    geometry = replace(capture.geometry, mesh=capture.geometry.mesh.transformed(matrix))
    return replace(capture, geometry=geometry), offset


def snapped(capture: Capture, grid_m: float) -> Capture:
    """With every vertex moved to a grid, as coarse retopology does; lamps are no longer told apart."""
    mesh = capture.geometry.mesh
    positions = (np.round(mesh.positions / grid_m) * grid_m).astype(np.float32)
    made = without_degenerate(Mesh(positions, mesh.faces))
    return replace(capture, geometry=CaptureGeometry(made, (GeometryPart("mesh", 0, len(made.faces)),)))


def warned_views(report: CheckReport) -> set[str]:
    """Names of the views that are warned of for their edges."""
    return {view.name for view in report.views if any("edges" in w for w in view.warnings)}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("shards", type=Path, nargs="+")
    parser.add_argument("--library", type=Path, action="append", default=[])
    parser.add_argument("--trials", type=int, default=4, help="of each kind and capture")
    parser.add_argument("--snap", type=float, help="move the mesh's vertices to a grid of this many metres")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    counts = dict.fromkeys(
        ("views", "false views", "captures", "false offsets", "turned", "found turned", "beside turned",
         "false beside turned", "moved", "found moved"), 0
    )  # fmt: skip
    errors: list[float] = []
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
        counts["false offsets"] += report.offset_m is not None
        for _ in range(arguments.trials):
            changed, names = turned(capture, rng, 1.0)
            found = warned_views(check_capture(changed))
            counts["turned"] += len(names)
            counts["found turned"] += len(names & found)
            counts["beside turned"] += len(capture.views) - len(names)
            counts["false beside turned"] += len(found - names)
            changed, offset = moved(capture, rng, 0.02)
            report = check_capture(changed)
            counts["moved"] += 1
            if report.offset_m is not None:
                counts["found moved"] += 1
                errors.append(float(np.linalg.norm(np.array(report.offset_m) - offset)))
            num_checked += 2 * len(capture.views)
        num_checked += len(capture.views)
        print(shard.name, counts, flush=True)
    cpu_s = (time.process_time() - start) / num_checked
    print(
        f"processor time {1000 * cpu_s:.0f} ms a view; offset off by {1000 * np.median(errors or [0]):.1f} mm"
    )
    if arguments.json:
        arguments.json.write_text(json.dumps({**counts, "offset_errors_m": errors, "cpu_s": cpu_s}, indent=2))


if __name__ == "__main__":
    main()
