# SPDX-License-Identifier: MIT
"""Small synthetic views and shards for tests that need no renderer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datagen.formats.base import canonical_json, sha256_hex
from datagen.formats.configuration import Configuration, PlacedAsset, ViewCamera
from datagen.formats.view import RenderRecord, StatisticsRecord, ViewRecord
from datagen.foundation.buffers import BUFFERS, VIEW_BUFFERS
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.exr import encode_view


def make_buffers(height: int, width: int, seed: int) -> dict[str, np.ndarray]:
    """Return every buffer (H, W, C) of a view by name, with random values in its valid range."""
    rng = np.random.default_rng(seed)
    buffers = {}
    for name in VIEW_BUFFERS:
        buffer = BUFFERS[name]
        shape = (height, width, buffer.num_channels)
        if buffer.pixel_type == "uint":
            buffers[name] = rng.integers(1, 5, shape).astype(np.uint32)
        elif name == "normal_world":
            normal = rng.normal(size=shape)
            buffers[name] = (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)
        elif name == "observation_count":
            buffers[name] = rng.integers(1, 13, shape).astype(np.float32)
        else:
            buffers[name] = rng.random(shape, dtype=np.float32)
    buffers["surface_mask"][:] = 1
    lowest = np.minimum(buffers["color_min"], buffers["color_max"])
    buffers["color_max"] = np.maximum(buffers["color_min"], buffers["color_max"])
    buffers["color_min"] = lowest
    buffers["color_median"] = (lowest + buffers["color_max"]) / 2
    return buffers


def make_configuration(num_views: int, width: int = 40, height: int = 24) -> Configuration:
    """Return a configuration of an environment with ``num_views`` cameras and without objects."""
    cameras = []
    for index in range(num_views):
        pose = look_at([0.3 * index, -2.0, 1.4], [0.0, 0.0, 1.0])
        camera = Camera(width, height, 30.0, 30.0, width / 2, height / 2, pose)
        cameras.append(ViewCamera.from_camera(f"view-{index:03d}", camera))
    return Configuration(
        id="small-00000",
        index=0,
        seed=5,
        environment=PlacedAsset(name="environment", asset="room"),
        cameras=tuple(cameras),
        assets={"room": "0" * 64},
    )


def make_view_files(folder: Path, configuration: Configuration) -> list[tuple[str, Path]]:
    """Write the EXR and JSON file of every view; return the (member name, path) pairs of the shard."""
    members = []
    for index, camera in enumerate(configuration.cameras):
        buffers = make_buffers(camera.height_px, camera.width_px, seed=index)
        data = encode_view(buffers)
        record = ViewRecord(
            configuration=configuration.id,
            name=camera.name,
            index=index,
            split=configuration.split,
            camera=camera,
            exposure=1.0,
            buffers=tuple(sorted(buffers)),
            instances={"1": "environment/wall"},
            materials={"1": "wall"},
            render=RenderRecord(
                variant="llvm_ad_rgb",
                seed=5,
                path_samples=1,
                auxiliary_samples=1,
                max_depth=2,
                russian_roulette_depth=5,
                denoiser="none",
            ),
            statistics=StatisticsRecord(
                num_views=len(configuration.cameras), best_views=12, visibility="depth", include_self=True
            ),
            versions={},
            exr_sha256=sha256_hex(data),
        )
        for suffix, content in (("exr", data), ("json", canonical_json(record))):
            path = folder / f"{camera.name}.{suffix}"
            path.write_bytes(content)
            members.append((f"{configuration.id}/{camera.name}.{suffix}", path))
    return members
