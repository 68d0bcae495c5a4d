# SPDX-License-Identifier: MIT
"""A small dataset folder, made without rendering: shards of views of a plane with smooth materials."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from datagen.formats.base import canonical_json, sha256_file, sha256_hex
from datagen.formats.configuration import Configuration, PlacedAsset, Split, ViewCamera
from datagen.formats.shard import ShardRecord, write_shard
from datagen.formats.view import RenderRecord, StatisticsRecord, ViewRecord
from datagen.foundation.buffers import LIGHT_BUFFERS, VIEW_BUFFERS
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.exr import encode_view
from model.training.run_log import CSV_FILE
from oracles.dataset_index import index_of

Change = Callable[[dict[str, np.ndarray], dict[str, Any]], None]
"""Function that damages a view's buffers and its record (as a dictionary) in place."""


def floor_buffers(camera: Camera, seed: int) -> dict[str, np.ndarray]:
    """All buffers (H, W, C) of a view of the plane z = 0, with materials that are smooth over the pixels."""
    rng = np.random.default_rng(seed)
    height, width = camera.height_px, camera.width_px

    def smooth(channels: int) -> np.ndarray:
        planes = [cv2.resize(rng.random((5, 6)), (width, height)) for _ in range(channels)]
        return np.stack(planes, axis=-1).astype(np.float32)

    directions = camera.ray_directions()
    hits = directions[..., 2] < -1e-3
    distance = np.where(hits, -camera.position_m[2] / np.minimum(directions[..., 2], -1e-3), 0.0)
    depth = distance * (directions @ camera.forward)
    mask = hits[..., None].astype(np.float32)
    diffuse, specular, roughness = 0.1 + 0.8 * smooth(3), 0.2 * smooth(3), 0.2 + 0.7 * smooth(1)
    image = (0.8 * diffuse + 0.3 * specular * (1 - roughness)) * mask + 0.5 * (1 - mask)
    buffers = {
        "beauty": image,
        "diffuse_albedo": diffuse * mask,
        "specular_albedo": specular * mask,
        "roughness": roughness * mask,
        "normal_world": np.array([0.0, 0.0, 1.0]) * mask,
        "depth_z_m": (depth * hits)[..., None],
        "surface_mask": mask,
        "instance_id": mask.astype(np.uint32),
        "material_id": mask.astype(np.uint32),
        "color_min": 0.9 * image,
        "color_median": image,
        "color_max": 1.1 * image,
        "observation_count": 3 * mask,
    }
    assert set(buffers) == set(VIEW_BUFFERS)
    return buffers


def light_buffers(buffers: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Made-up light buffers of a view with these ``buffers``, by name."""
    mask = buffers["surface_mask"]
    return {
        "reflectance": buffers["diffuse_albedo"],
        "known_share": 0.75 * mask,
        "mirror_sharp": 0.4 * buffers["beauty"],
        "mirror_broad": 0.3 * buffers["beauty"],
    }


def view_record(configuration: Configuration, index: int, exr: bytes) -> dict[str, Any]:
    """The JSON record of view ``index`` as a dictionary, with the hash of its file's bytes ``exr``."""
    record = ViewRecord(
        configuration=configuration.id,
        name=configuration.cameras[index].name,
        index=index,
        split=configuration.split,
        camera=configuration.cameras[index],
        exposure=1.2,
        buffers=tuple(sorted(VIEW_BUFFERS)),
        instances={"1": "environment/floor"},
        materials={"1": "floor"},
        render=RenderRecord(
            variant="llvm_ad_rgb",
            seed=1,
            path_samples=1,
            auxiliary_samples=1,
            max_depth=2,
            russian_roulette_depth=2,
            denoiser="none",
        ),
        statistics=StatisticsRecord(num_views=3, best_views=12, visibility="depth", include_self=True),
        versions={},
        exr_sha256=sha256_hex(exr),
    )
    return record.model_dump(mode="json")


def make_shard(
    folder: Path,
    name: str,
    num_views: int,
    *,
    split: Split = "train",
    seed: int = 0,
    width: int = 64,
    height: int = 48,
    has_light: bool = False,
    change: Change | None = None,
) -> Path:
    """Write ``shards/<name>.tar`` and return its path; ``change`` damages every view."""
    cameras = []
    names = VIEW_BUFFERS + (LIGHT_BUFFERS if has_light else ())
    for index in range(num_views):
        pose = look_at([0.4 * index - 0.5, -1.5, 1.2], [0.0, 0.3, 0.0])
        camera = Camera(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2, pose)
        cameras.append(ViewCamera.from_camera(f"view-{index:03d}", camera))
    environment = PlacedAsset(name="environment", asset="room")
    configuration = Configuration(
        id=name,
        index=0,
        seed=5,
        split=split,
        environment=environment,
        cameras=tuple(cameras),
        assets={"room": "0" * 64},
    )
    members = []
    scratch = folder / "scratch" / name
    scratch.mkdir(parents=True)
    for index, camera in enumerate(configuration.cameras):
        buffers = floor_buffers(camera.camera(), seed * 1000 + index)
        if has_light:
            buffers |= light_buffers(buffers)
        record = view_record(configuration, index, b"") | {"buffers": sorted(names)}
        if change is not None:
            change(buffers, record)
        exr = encode_view(buffers)
        record["exr_sha256"] = sha256_hex(exr)
        for suffix, content in (("exr", exr), ("json", canonical_json(record))):
            path = scratch / f"{camera.name}.{suffix}"
            path.write_bytes(content)
            members.append((f"{name}/{camera.name}.{suffix}", path))
    shard = folder / "shards" / f"{name}.tar"
    shard.parent.mkdir(exist_ok=True)
    with shard.open("wb") as file:
        write_shard(file, canonical_json(configuration), members)
    return shard


def make_dataset(
    folder: Path, splits: dict[str, tuple[Split, int]], *, change: Change | None = None, **options: Any
) -> Path:
    """Write a dataset with one shard for each of ``splits`` (name to split and number of views) and return
    ``folder``; ``options`` are those of :func:`make_shard`."""
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    for seed, (name, (split, num_views)) in enumerate(splits.items()):
        path = make_shard(folder, name, num_views, split=split, seed=seed, change=change, **options)
        records.append(
            ShardRecord(
                file=f"shards/{path.name}",
                sha256=sha256_file(path),
                num_bytes=path.stat().st_size,
                configuration=name,
                split=split,
                num_views=num_views,
                seed=5,
                assets=(),
            )
        )
    buffers = VIEW_BUFFERS + (LIGHT_BUFFERS if options.get("has_light") else ())
    index = index_of("tiny", records, buffers)
    (folder / "index.json").write_bytes(canonical_json(index))
    return folder


def read_log(folder: Path, kind: str, name: str) -> list[tuple[int, float]]:
    """Pairs (step, value) of the figure ``name`` in a run's CSV."""
    with (folder / CSV_FILE).open(newline="", encoding="utf-8") as file:
        return [
            (int(row["step"]), float(row["value"]))
            for row in csv.DictReader(file)
            if row["kind"] == kind and row["name"] == name
        ]
