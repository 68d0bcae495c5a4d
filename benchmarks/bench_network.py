# SPDX-License-Identifier: MIT
"""Time of the network and of a training step, by part.

    python -m benchmarks.bench_network [--preset paper] [--batch 8] [--threads 2] [--device cpu] [--out FILE]
    python -m benchmarks.bench_network --padding      effect of padding on the maps (docs/decisions/0010)

Prints, and writes as JSON, median times of: the forward pass of one track (U-Net) at 640 x 384 in float32 and
bfloat16; a training step of each phase of the preset, split into forward, render, perceptual, backward and
optimiser (with ``--peak-tflops``, also the share of the GPU's bfloat16 peak); decoding of a view, and the
resulting crops per second. The batch is synthetic; decoding reads an EXR file in a temporary folder.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.timing import median_seconds, write_report
from datagen.foundation.buffers import BUFFERS, LIGHT_BUFFERS, VIEW_BUFFERS
from datagen.foundation.exr import decode_view, encode_view
from model.networks import NetworkConfig, Track
from model.training.config import PRESETS, TrainingConfig, resolve_config
from model.training.context import make_context
from model.training.dataset import buffer_names
from model.training.dry_run import synthetic_batch, timed_step
from model.training.phases import Phase
from model.training.sources import TrainingData
from model.training.stopwatch import Stopwatch

WIDTH, HEIGHT = 640, 384


def finished(run: Callable[[], Any], device: torch.device) -> Callable[[], None]:
    """Return a function that calls ``run`` and waits for the device."""

    def wait() -> None:
        run()
        if device.type == "cuda":
            torch.cuda.synchronize()

    return wait


def measure_forward(network: NetworkConfig, device: torch.device, repeats: int) -> dict[str, float]:
    """Median seconds of the diffuse track on a view of 640 x 384, by number format and memory layout."""
    x = torch.rand(1, 9, HEIGHT, WIDTH, device=device) * 2 - 1
    result = {}
    for layout in ("contiguous", "channels_last"):
        track = Track(9, 3, network).to(device).eval()
        image = x
        if layout == "channels_last":
            track.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
            image = x.contiguous(memory_format=torch.channels_last)
        for name in ("float32", "bfloat16"):
            with torch.no_grad(), torch.autocast(device.type, torch.bfloat16, enabled=name == "bfloat16"):
                seconds = median_seconds(finished(partial(track, image), device), repeats)
            result[f"{name}_{layout}_s"] = seconds
    return result


def measure_steps(
    config: TrainingConfig, device: torch.device, repeats: int, peak_tflops: float | None
) -> dict[str, dict[str, float]]:
    """Median seconds of a training step and mean seconds of its parts, by phase."""
    data = TrainingData((), (), (WIDTH, HEIGHT), ())
    batch = synthetic_batch(config.batch_size, config.data.crop_px, device)
    results: dict[str, dict[str, float]] = {}
    for index, phase_config in enumerate(config.phases):
        watch = Stopwatch(device)
        context = make_context(config, data, device, watch)
        phase = Phase(context, index, num_steps=1)
        timed_step(phase, batch, 0, watch)
        watch.seconds.clear()
        totals = [timed_step(phase, batch, k + 1, watch) for k in range(repeats)]
        result = {name: seconds / repeats for name, seconds in watch.seconds.items()}
        result["step"] = sorted(totals)[repeats // 2]
        result["crops_per_s"] = config.batch_size / result["step"]
        if peak_tflops is not None:
            from torch.utils.flop_counter import FlopCounterMode

            with FlopCounterMode(display=False) as counter:
                timed_step(phase, batch, 0, watch)
            result["tflop"] = counter.get_total_flops() / 1e12
            result["share_of_peak"] = result["tflop"] / result["step"] / peak_tflops
        results[phase_config.name] = result
    return results


def synthetic_view() -> bytes:
    """Bytes of the EXR of a 640 x 384 view with all buffers, smooth with some noise."""
    rng = np.random.default_rng(0)
    buffers = {}
    for name in (*VIEW_BUFFERS, *LIGHT_BUFFERS):
        buffer = BUFFERS[name]
        planes = [cv2.resize(rng.random((24, 40)), (WIDTH, HEIGHT)) for _ in range(buffer.num_channels)]
        values = np.stack(planes, axis=-1) + 0.01 * rng.random((HEIGHT, WIDTH, buffer.num_channels))
        buffers[name] = (values * 4).astype(np.uint32) if buffer.pixel_type == "uint" else values
    return encode_view(buffers)


def measure_decoding(config: TrainingConfig, repeats: int) -> dict[str, float]:
    """Seconds to read and decode a view in one process, and the resulting number of crops per second."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "view.exr"
        path.write_bytes(synthetic_view())
        names = buffer_names(config.network)
        seconds = median_seconds(lambda: decode_view(path.read_bytes(), names, num_threads=1), repeats)
    return {
        "view_s": seconds,
        "crops_per_s_one_process": config.data.crops_per_view / seconds,
        "crops_per_s_without_sharing": 1.0 / seconds,
    }


def measure_padding() -> list[dict[str, Any]]:
    """Change of an untrained track's output when its input is padded to a larger canvas, by size."""
    rows = []
    for ignores in (False, True):
        for height, width, canvas in ((368, 640, (384, 640)), (384, 640, (640, 640)), (256, 256, (384, 640))):
            torch.manual_seed(1)
            track = Track(9, 3, NetworkConfig(ignores_padding=ignores)).eval()
            generator = torch.Generator().manual_seed(2)
            small = torch.rand(1, 9, 24, 40, generator=generator)
            x = torch.nn.functional.interpolate(small, size=(height, width), mode="bilinear") * 2 - 1.3
            pad = (0, canvas[1] - width, 0, canvas[0] - height)
            with torch.no_grad():
                alone = track(x)
                change = (track(torch.nn.functional.pad(x, pad), (height, width)) - alone).abs()
            row: dict[str, Any] = {
                "ignores_padding": ignores,
                "image": f"{height} x {width}",
                "canvas": f"{canvas[0]} x {canvas[1]}",
            }
            row |= {"max": float(change.max()), "mean": float(change.mean())}
            row["mean_over_std"] = row["mean"] / float(alone.std())
            rows.append(row)
    return rows


def main() -> None:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("--preset", choices=PRESETS, default="paper")
    parser.add_argument("--batch", type=int)
    parser.add_argument("--loss", choices=("elpips", "gradient_ssim"))
    parser.add_argument("--precision", choices=("float32", "bfloat16"))
    parser.add_argument("--channels-last", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--peak-tflops", type=float)
    parser.add_argument("--padding", action="store_true")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    device = torch.device(args.device)
    if args.padding:
        for row in measure_padding():
            print(row)
        return
    overrides: dict[str, Any] = {}
    for key, value in (("batch_size", args.batch), ("precision", args.precision)):
        if value is not None:
            overrides[key] = value
    if args.channels_last:
        overrides["channels_last"] = True
    if args.loss:
        overrides["perceptual"] = {"kind": args.loss}
    config = resolve_config(args.preset, None, overrides)
    report = {
        "benchmark": "network",
        "preset": args.preset,
        "batch_size": config.batch_size,
        "precision": config.precision,
        "threads": args.threads,
        "device": args.device if device.type == "cpu" else torch.cuda.get_device_name(device),
        "torch": torch.__version__,
        "forward_640x384": measure_forward(config.network, device, args.repeats),
        "decoding": measure_decoding(config, args.repeats),
        "steps": measure_steps(config, device, args.repeats, args.peak_tflops),
    }
    write_report(report, args.out)


if __name__ == "__main__":
    main()
