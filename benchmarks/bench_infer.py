# SPDX-License-Identifier: MIT
"""Seconds by stage and peak memory of ``materials infer``, with networks of full size.

    python -m benchmarks.bench_infer --views 160 --size 640x384 --atlas 16384
    python -m benchmarks.bench_infer --capture SHARD --atlas auto

Without ``--capture`` the capture is a room of 24 triangles with a block in it, known analytically: its
geometry is free, so that what is measured is the work by pixel, view and texel. Weights are random: time
does not depend on them. Writes JSON with ``--json``.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
from dataclasses import asdict
from pathlib import Path

import torch

from datagen.formats.capture import Capture
from model.checkpoint import CheckpointCard, save_checkpoint
from model.confidence import ConfidenceNets
from model.networks import MaterialNetwork, NetworkConfig
from model.reconstruction.captures import CaptureOptions, read_capture
from model.reconstruction.infer import InferOptions, InferReport, infer
from tests.model.textured_room import room_capture

PAPER_MINUTES = {"statistics": 7.56, "prediction": 3.93, "texturing": 3 * 3.12}
"""Veach Ajar, 160 views, 16K atlas, three maps, on a Xeon 5218 and a Quadro RTX 5000."""
STAGES = {
    "statistics": ("trace", "check", "statistics"),
    "prediction": ("predict", "write maps"),
    "texturing": ("unwrap", "merge", "fill", "export"),
}


def random_checkpoint(folder: Path) -> Path:
    """Both tracks and the confidence networks at their full size, untrained."""
    torch.manual_seed(0)
    card = CheckpointCard(network=NetworkConfig(), loss="none", phase="untrained", step=0)
    path = folder / "random.safetensors"
    save_checkpoint(path, card, MaterialNetwork(card.network), ConfidenceNets())
    return path


def measure(capture: Capture, options: InferOptions) -> InferReport:
    """One run into a folder that is thrown away."""
    with tempfile.TemporaryDirectory(prefix="bench-infer-") as folder:
        checkpoint = random_checkpoint(Path(folder))
        return infer(capture, Path(folder) / "out", checkpoint, options)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--library", type=Path, action="append", default=[])
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--size", default="640x384")
    parser.add_argument("--atlas", default="auto")
    parser.add_argument("--precision", default="auto", choices=("auto", "float32", "bfloat16"))
    parser.add_argument("--no-exr", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if arguments.capture:
        capture = read_capture(arguments.capture, CaptureOptions(library=tuple(arguments.library)))
    else:
        width, height = (int(side) for side in arguments.size.split("x"))
        capture = room_capture(arguments.views, (width, height))
    atlas = "auto" if arguments.atlas == "auto" else int(arguments.atlas)
    options = InferOptions(atlas=atlas, precision=arguments.precision, has_exr=not arguments.no_exr)
    report = measure(capture, options)
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{report.num_views} views, {report.num_triangles} triangles, atlas {report.atlas_size}")
    print(report.table())
    for name, stages in STAGES.items():
        minutes = sum(report.seconds.get(stage, 0.0) for stage in stages) / 60
        print(f"{name:<12}{minutes:>8.2f} min   (paper, Veach Ajar's load, GPU: {PAPER_MINUTES[name]:.2f})")
    print(f"peak memory {peak_gb:.1f} GB, {torch.get_num_threads()} threads, {report.precision}")
    if arguments.json:
        result = {**asdict(report), "peak_memory_gb": peak_gb, "threads": torch.get_num_threads()}
        arguments.json.write_text(json.dumps(result, indent=2, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
