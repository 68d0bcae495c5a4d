# SPDX-License-Identifier: MIT
"""Seconds by stage and peak memory of ``materials infer``, with networks of full size.

    python -m benchmarks.bench_infer --views 160 --size 640x384 --atlas 16384
    python -m benchmarks.bench_infer --capture SHARD --photographs 160 --atlas auto
    python -m benchmarks.bench_infer --capture SHARD --views 160 --size 640x384 --atlas 16384

Without ``--capture`` the capture is a room of 24 triangles, whose geometry takes no time, so the work per
pixel, view and texel is measured. With a rendered capture and ``--views``, its cameras are used in turn,
moved by up to 0.3 m and rotated by up to 20 degrees per axis; the images are the capture's true albedo, lit
from the camera, so no photograph needs to be rendered. Without ``--checkpoint`` the weights are random; only
the solver's time depends on them. Writes JSON with ``--json``.

Memory is stated without and with the resident pages of the atlas's files, which the system can drop.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.bench_merge_quality import open_room
from benchmarks.timing import Stopwatch, write_report
from datagen.formats.capture import Capture, CaptureView
from datagen.geometry.texture_lookup import looked_up, pixel_uv
from mitsuba_plugins.variant import select_variant
from model.checkpoint import CheckpointCard, save_checkpoint
from model.confidence import ConfidenceNets
from model.networks import MaterialNetwork, NetworkConfig
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from model.reconstruction.infer import InferOptions, InferReport, infer
from model.reconstruction.predict.sources import CheckpointMaps
from oracles.textured_room import MapSource, room_capture

PAPER_MINUTES = {"statistics": 7.56, "prediction": 3.93, "texturing": 3 * 3.12}
"""The paper's minutes by stage: Veach Ajar, 160 views, 16K atlas, three maps; Xeon 5218, Quadro RTX 5000."""
STAGES = {
    "statistics": ("trace", "check", "statistics"),
    "prediction": ("predict", "write maps"),
    "texturing": ("unwrap", "merge", "fill", "export"),
}


def random_checkpoint(folder: Path) -> Path:
    """Write a checkpoint of untrained networks of full size to ``folder``; returns its path."""
    torch.manual_seed(0)
    card = CheckpointCard(network=NetworkConfig(), loss="none", phase="untrained", step=0)
    path = folder / "random.safetensors"
    save_checkpoint(path, card, MaterialNetwork(card.network), ConfidenceNets())
    return path


def shot_again(shard: Path, library: Sequence[Path], num: int, size: tuple[int, int]) -> Capture:
    """Replace the views of the rendered capture ``shard`` by ``num`` new ones of ``size`` (width, height)."""
    select_variant()
    room = open_room(shard, library)
    albedo = room.merged(room.truth, min(room.auto, 4096), None).maps["diffuse_albedo"]
    rng = np.random.default_rng(0)
    views: list[CaptureView] = []
    while len(views) < num:
        near = room.capture.cameras[len(views) % len(room.capture.cameras)]
        pose = near.world_from_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.radians(rng.uniform(-20, 20, 3))).as_matrix()
        pose[:3, 3] += rng.uniform(-0.3, 0.3, 3) * [1, 1, 0.5]
        camera = replace(near.scaled(*size), world_from_camera=pose)
        seen = room.traced.geometry.trace_view(camera)
        if (seen.depth_z_m < 0.3).mean() > 0.1:
            continue  # inside an object
        uv = pixel_uv(room.mesh, camera, seen)
        on_surface = ~np.isnan(uv[..., 0])
        cosine = seen.cosine(camera)[..., None]
        color = np.full((size[1], size[0], 3), 0.5, np.float32)
        color[on_surface] = (looked_up(albedo, uv[on_surface]) * cosine[on_surface]).astype(np.float32)
        views.append(CaptureView(f"view-{len(views):03d}", camera, MapSource({"diffuse_albedo": color})))
    return replace(room.capture, views=tuple(views))


class MemoryWatch:
    """Peaks in GiB of this process's memory without and with mapped files, sampled ten times a second."""

    def __init__(self) -> None:
        self.own_gb, self.resident_gb = 0.0, 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        status = Path("/proc/self/status")
        while not self._stop.wait(0.1):
            fields = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
            own, resident = (int(fields[key].split()[0]) / 2**20 for key in ("RssAnon", "VmRSS"))
            self.own_gb, self.resident_gb = max(self.own_gb, own), max(self.resident_gb, resident)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


def measure(
    capture: Capture, options: InferOptions, checkpoint: Path | None, scratch: Path | None
) -> InferReport:
    """Run inference once into a temporary folder, below ``scratch`` if given."""
    with tempfile.TemporaryDirectory(prefix="bench-infer-", dir=scratch) as folder:
        source = CheckpointMaps(checkpoint or random_checkpoint(Path(folder)))
        return infer(capture, Path(folder) / "out", source, options)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--library", type=Path, action="append", default=[])
    parser.add_argument("--views", type=int, help="number of views; default: 24, or all of --capture")
    parser.add_argument("--photographs", type=int, help="number of the first photographs of --capture used")
    parser.add_argument("--size", default="640x384")
    parser.add_argument("--atlas", default="auto")
    parser.add_argument("--precision", default="auto", choices=("auto", "float32", "bfloat16"))
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--no-exr", action="store_true")
    parser.add_argument("--scratch", type=Path, help="folder of the temporary result")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    width, height = (int(side) for side in arguments.size.split("x"))
    if arguments.capture and arguments.views:
        capture = shot_again(arguments.capture, arguments.library, arguments.views, (width, height))
    elif arguments.capture:
        capture = read_capture(arguments.capture, CaptureOptions(library=tuple(arguments.library)))
        capture = replace(capture, views=capture.views[: arguments.photographs])
    else:
        capture = room_capture(arguments.views or 24, (width, height))
    atlas: Any = "auto" if arguments.atlas == "auto" else int(arguments.atlas)
    options = InferOptions(atlas=atlas, precision=arguments.precision, has_exr=not arguments.no_exr)
    memory, watch = MemoryWatch(), Stopwatch()
    with watch.stage("infer"):
        report = measure(capture, options, arguments.checkpoint, arguments.scratch)
    memory.stop()
    (cpu_s,) = watch.cpu["infer"]
    print(f"{report.num_views} views, {report.num_triangles} triangles, atlas {report.atlas_size}")
    print(report.table())
    for name, stages in STAGES.items():
        minutes = sum(report.seconds.get(stage, 0.0) for stage in stages) / 60
        print(f"{name:<12}{minutes:>8.2f} min   (paper, Veach Ajar's load, GPU: {PAPER_MINUTES[name]:.2f})")
    print(f"processor time {cpu_s:.0f} s, {torch.get_num_threads()} threads, {report.precision}")
    print(f"peak memory {memory.own_gb:.1f} GB, with mapped files {memory.resident_gb:.1f} GB")
    peaks = {"peak_own_gb": memory.own_gb, "peak_resident_gb": memory.resident_gb}
    result = {**asdict(report), **peaks, "cpu_s": cpu_s, "threads": torch.get_num_threads()}
    write_report(result, arguments.json, is_printed=False, indent=2, sort_keys=True)


if __name__ == "__main__":
    main()
