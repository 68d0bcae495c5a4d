# SPDX-License-Identifier: MIT
"""Ablation of light buffers as network inputs: errors with and without them, trained on the same views.

    python -m benchmarks.bench_light_inputs ROOM.tar ... --held-out ROOM.tar ... --out DIR

Rooms are shards of rendered datasets or of evaluations' captures; every so many views of each are made
small, with statistics and light as ``datagen run --only stats`` makes them. For each set of inputs and each
seed a network of the tracks' kind is trained for the same steps on the same crops, and judged on whole views
of the rooms held out: mean squared errors of D, S and R, beside the training mean. Writes ``table.md`` and
``results.json`` into DIR; interrupted runs continue.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from datagen.formats.base import canonical_json, sha256_file, sha256_hex
from datagen.formats.capture import CaptureView
from datagen.formats.configuration import Split, ViewCamera
from datagen.formats.shard import ShardReader, ShardRecord, write_shard
from datagen.foundation.buffers import LIGHT_BUFFERS, MATERIAL_MAPS, STATISTICS_BUFFERS
from datagen.foundation.cameras import Camera
from datagen.foundation.exr import encode_view
from datagen.geometry.views import trace_capture
from datagen.light.view_light import ViewLight
from datagen.multiview.statistics import compute_statistics
from mitsuba_plugins.variant import select_variant
from model.checkpoint import load_checkpoint
from model.reconstruction.captures import read_capture
from model.training.config import TrainingConfig, parse_overrides, resolve_config
from model.training.dataset import buffer_names
from model.training.sources import open_data, spread
from model.training.train import Trainer
from model.training.validation import (
    ALL_TRACKS,
    constant_predictor,
    evaluate,
    mean_maps,
    network_predictor,
    whole_views,
)
from oracles.dataset_index import index_of

STORED = (
    "beauty",
    *MATERIAL_MAPS,
    "surface_mask",
    "normal_world",
    "depth_z_m",
    *STATISTICS_BUFFERS,
    *LIGHT_BUFFERS,
)
INPUTS: dict[str, tuple[str, ...]] = {
    "radiance": (),
    "with reflectance, known share": ("reflectance", "known_share"),
    "with mirror images, too": LIGHT_BUFFERS,
}
"""Light that the networks are fed with, by name in the table."""
SETTINGS = (
    "network.base_channels=16", "network.global_channels=32", "data.crop_px=96", "data.crops_per_view=4",
    "data.block_views=64", "data.spread_jitter_stops=0.2", "data.exposure_jitter_stops=2.0", "data.workers=0",
    "loss.num_point_lights=0", "loss.num_area_lights=0", "loss.map_l2_weight=50", "loss.perceptual_weight=0",
    "batch_size=6", "channels_last=true", "learning_rate=1e-3", "final_learning_rate=2e-5",
    "gradient_clip_norm=50", "validation.num_views=0", "log_every_steps=20", "checkpoint_every_steps=100",
)  # fmt: skip
"""Small and short, squared errors of maps alone: what the inputs bring, not what training can."""


def small_camera(camera: Camera, width: int) -> Camera:
    """The same view in fewer pixels."""
    factor = width / camera.width_px
    height = round(camera.height_px * factor)
    lens = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    return Camera(width, height, *(value * factor for value in lens), camera.world_from_camera)


def small_shard(
    shard: Path, out: Path, split: Split, num_views: int, width: int
) -> tuple[ShardRecord, float]:
    """A room in few small views with statistics and light; its record, and processor seconds of light."""
    reader, capture = ShardReader(shard), read_capture(shard)
    step = max(1, len(capture.views) // num_views)
    chosen = capture.views[::step][:num_views]
    views = tuple(CaptureView(v.name, small_camera(v.camera, width), v.source) for v in chosen)
    traced = trace_capture(replace(capture, views=views))
    statistics = list(compute_statistics(traced.statistics))
    start = time.process_time()
    light = ViewLight(traced.views, traced.geometry, traced.capture.geometry.emitter_mask())
    lit = [light.buffers(index, found["color_median"]) for index, found in enumerate(statistics)]
    seconds = time.process_time() - start
    records = {record.name: record for record in reader.records()}
    members, scratch = [], out / "views" / capture.name
    scratch.mkdir(parents=True, exist_ok=True)
    for index, view in enumerate(traced.views):
        size = (view.camera.width_px, view.camera.height_px)
        stored = views[index].source.read_maps((*MATERIAL_MAPS, "surface_mask"))
        buffers = {
            "beauty": view.color,
            **{name: _smaller(values, size) for name, values in stored.items()},
            "normal_world": view.geometry.normal_world,
            "depth_z_m": view.geometry.depth_z_m,
            **statistics[index],
            **lit[index],
        }
        exr = encode_view(buffers)
        camera = ViewCamera.from_camera(view.name, view.camera)
        changed = {"camera": camera, "buffers": tuple(sorted(buffers)), "exr_sha256": sha256_hex(exr)}
        changed["split"] = split
        text = canonical_json(records[view.name].model_copy(update=changed))
        for suffix, content in (("exr", exr), ("json", text)):
            path = scratch / f"{view.name}.{suffix}"
            path.write_bytes(content)
            members.append((f"{capture.name}/{path.name}", path))
    path = out / "shards" / f"{shard.stem}.tar"
    path.parent.mkdir(exist_ok=True)
    configuration = reader.configuration()
    with path.open("wb") as file:
        write_shard(file, canonical_json(configuration), members)
    record = ShardRecord(
        file=f"shards/{path.name}",
        sha256=sha256_file(path),
        num_bytes=path.stat().st_size,
        configuration=configuration.id,
        split=split,
        num_views=len(views),
        seed=configuration.seed,
        assets=(),
    )
    return record, seconds


def _smaller(values: NDArray, size: tuple[int, int]) -> NDArray[np.float32]:
    """Means over areas."""
    found = cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(found, np.float32).reshape(size[1], size[0], -1)


def small_dataset(
    rooms: dict[Split, list[Path]], out: Path, num_views: int, width: int
) -> tuple[Path, dict[str, float]]:
    """The dataset folder of all rooms, made once, and processor seconds of light a view, by room."""
    told = out / "light.json"
    if told.is_file():
        return out, json.loads(told.read_text())
    select_variant()
    records, seconds = [], {}
    for split, shards in rooms.items():
        for shard in shards:
            record, taken = small_shard(shard, out, split, num_views, width)
            records.append(record)
            seconds[shard.stem] = taken / record.num_views
            told_s = f"light {seconds[shard.stem]:.2f} s each"
            print(f"{shard.stem}: {record.num_views} views, {told_s}", flush=True)
    with (out / "index.json").open("wb") as file:
        file.write(canonical_json(index_of("small", records, STORED)))
    told.write_text(json.dumps(seconds))
    return out, seconds


def configured(inputs: Sequence[str], seed: int, steps: int) -> TrainingConfig:
    """The training of one network."""
    settings = [*SETTINGS, f"seed={seed}", f"network.light_inputs=[{', '.join(inputs)}]"]
    return resolve_config(
        "smoke", None, parse_overrides([*settings, f"phases=[{{name: joint, steps: {steps}}}]"])
    )


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rooms", nargs="+", type=Path)
    parser.add_argument("--held-out", nargs="+", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=2)
    args = parser.parse_args()
    rooms: dict[Split, list[Path]] = {"train": args.rooms, "validation": args.held_out}
    (args.out / "data").mkdir(parents=True, exist_ok=True)
    data, seconds = small_dataset(rooms, args.out / "data", args.views, args.width)
    rows: dict[str, list[dict[str, float]]] = {label: [] for label in INPUTS}
    for seed in range(args.seeds):
        for label, inputs in INPUTS.items():
            config = configured(inputs, seed, args.steps)
            run = args.out / f"{len(inputs)}-inputs-seed-{seed}"
            final = Trainer(config, [data], run, device=torch.device("cpu")).run()
            network = load_checkpoint(final).network
            names = buffer_names(config.network)
            places = open_data([data], config.network, 1).validation
            batches = whole_views(places, names, torch.device("cpu"))
            found = evaluate(network_predictor(network, ALL_TRACKS), batches)
            rows[label].append(found)
            print(f"{label}, seed {seed}: " + _figures(found), flush=True)
    opened = open_data([data], configured((), 0, 1).network, 1)
    names = buffer_names(configured((), 0, 1).network)
    means = mean_maps(whole_views(spread(opened.train, 80), names, torch.device("cpu")))
    constant = evaluate(constant_predictor(means), whole_views(opened.validation, names, torch.device("cpu")))
    (args.out / "results.json").write_text(
        json.dumps({"networks": rows, "constant": constant, "light_s_a_view": seconds}, indent=1)
    )
    lines = ["| inputs | D | S | R |", "|---|---:|---:|---:|"]
    lines.append(f"| none: the training mean | {_figures(constant)} |")
    for label, figures in rows.items():
        means_of = {name: float(np.mean([one[name] for one in figures])) for name in figures[0]}
        lines.append(f"| {label} | {_figures(means_of)} |")
    (args.out / "table.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


def _figures(found: dict[str, float]) -> str:
    return " | ".join(f"{found[f'{name}_mse']:.4f}" for name in MATERIAL_MAPS)


if __name__ == "__main__":
    main()
