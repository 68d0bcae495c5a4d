# SPDX-License-Identifier: MIT
"""Growth of a worker's memory: 200 views of 20 different configurations in one process.

    python benchmarks/bench_memory.py [--configurations 20] [--views 10] [--size 96 64]

Each configuration has different random objects, textured materials, lights and colour adjustments, so scenes,
textures and kernels differ. Resident memory is read after each configuration, once unused memory is freed.
Growth is counted after --warm-up configurations, when libraries are loaded and caches filled; the limit is
100 MB.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.timing import RESULTS, Stopwatch, write_report
from datagen.formats.asset import Material, SlotMaterial, Texture
from datagen.formats.configuration import (
    ColorAdjustment,
    Configuration,
    MaterialAssignment,
    PlacedAsset,
    ViewCamera,
)
from datagen.formats.lights import AreaLight, EnvironmentLight, PointLight
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.images import encode_png
from datagen.library import Library
from datagen.rendering.renderer import SceneRenderer
from oracles.rendering_scenes import SmallScene, box, placed, quad

LIMIT_MB = 100.0
NUM_MATERIALS = 12
TEXTURE_PX = 512


def write_library(root: Path) -> Library:
    """Write a library with a room, a box and twelve textured materials."""
    rng = np.random.default_rng(0)
    parts = {
        "floor": (quad([-2, -2, 0], [4, 0, 0], [0, 4, 0]), "floor"),
        "back": (quad([-2, 2, 0], [4, 0, 0], [0, 0, 2.5]), "wall"),
        "left": (quad([-2, -2, 0], [0, 4, 0], [0, 0, 2.5]), "wall"),
        "ceiling": (quad([-2, 2, 2.5], [4, 0, 0], [0, -4, 0]), "ceiling"),
    }
    slots = {name: SlotMaterial(diffuse_albedo=(0.6, 0.6, 0.6)) for name in ("floor", "wall", "ceiling")}
    materials = {}
    for k in range(NUM_MATERIALS):
        noise = rng.integers(0, 255, (TEXTURE_PX, TEXTURE_PX, 3)).astype(np.uint8)
        texture = Texture(texture="t.png", encoding="srgb")
        material = Material(classes=("stone",), diffuse_albedo=texture, roughness=0.2 + 0.05 * k)
        materials[f"material-{k}"] = (material, {"t.png": encode_png(noise)})
    scene = SmallScene(parts, slots, objects={"box": (box(0.4), SlotMaterial())}, materials=materials)
    return scene.write(root)


def draw_configuration(library: Library, index: int, views: int, size: tuple[int, int]) -> Configuration:
    """Draw configuration ``index``: objects at random poses, random materials and lights."""
    rng = np.random.default_rng(1000 + index)

    def assignment() -> MaterialAssignment:
        adjustment = ColorAdjustment(
            hue_shift=float(rng.uniform(-0.5, 0.5)), value_scale=float(rng.uniform(0.7, 1.2))
        )
        asset = f"material-{rng.integers(NUM_MATERIALS)}"
        return MaterialAssignment(asset=asset, adjustment=adjustment)

    objects = tuple(
        PlacedAsset(
            name=f"box-{k}",
            asset="box",
            world_from_asset=placed(
                x=rng.uniform(-1.5, 1.5),
                y=rng.uniform(-1.5, 1.5),
                yaw=rng.uniform(0, 6),
                scale=rng.uniform(0.5, 1.5),
            ),
            materials={"skin": MaterialAssignment(adjustment=assignment().adjustment)},
        )
        for k in range(int(rng.integers(3, 9)))
    )
    lights = [
        AreaLight(
            name="ceiling",
            origin_m=(-0.5, -0.5, 2.4),
            edge_u_m=(0, 1, 0),
            edge_v_m=(1, 0, 0),
            radiance=(8, 8, 8),
        )
    ]
    if rng.random() < 0.5:
        lights.append(PointLight(name="p", position_m=(1, 1, 1.5), intensity=(1, 1, 1)))  # type: ignore[arg-type]
    if rng.random() < 0.5:
        lights.append(EnvironmentLight(name="e", radiance=(0.5, 0.5, 0.6)))  # type: ignore[arg-type]
    cameras = []
    for k in range(views):
        pose = look_at([*rng.uniform(-1, 1, 1), -3.0, 1.5], [*rng.uniform(-1, 1, 2), 0.6])
        cameras.append(
            ViewCamera.from_camera(
                f"view_{k}", Camera(*size, size[0], size[0], size[0] / 2, size[1] / 2, pose)
            )
        )
    return Configuration(
        id=f"memory-{index}",
        index=index,
        seed=index,
        environment=PlacedAsset(
            name="room", asset="room", materials={s: assignment() for s in ("floor", "wall", "ceiling")}
        ),
        objects=objects,
        lights=tuple(lights),
        cameras=tuple(cameras),
        assets={package.id: package.sha256 for package in library},
    )


def resident_mb() -> float:
    """Resident memory of this process in megabytes."""
    return psutil.Process().memory_info().rss / 1e6


def measure(configurations: int, views: int, size: tuple[int, int]) -> list[float]:
    """Render ``views`` views of each of ``configurations`` rooms; returns resident megabytes after each."""
    memory = []
    with tempfile.TemporaryDirectory() as folder:
        library = write_library(Path(folder))
        recipe = RenderRecipe(path_samples=4, auxiliary_samples=16)
        for index in range(configurations):
            renderer = SceneRenderer(draw_configuration(library, index, views, size), library, recipe)
            for _ in renderer.render_views(range(views)):
                pass
            renderer.close()
            del renderer
            gc.collect()
            memory.append(round(resident_mb(), 1))
            print(f"configuration {index}: {memory[-1]} MB", file=sys.stderr)
    return memory


def main() -> None:
    """Run the command; the exit code is 1 if memory grows by more than the limit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--configurations", type=int, default=20)
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 64))
    parser.add_argument("--warm-up", type=int, default=3)
    parser.add_argument("--out", type=Path, default=RESULTS / "bench_memory.json")
    arguments = parser.parse_args()
    if not 0 < arguments.warm_up < arguments.configurations:
        parser.error(f"--warm-up: expected 1 to {arguments.configurations - 1}, fewer than --configurations")
    watch = Stopwatch()
    with watch.stage("all"):
        memory = measure(arguments.configurations, arguments.views, tuple(arguments.size))
    growth = memory[-1] - memory[arguments.warm_up - 1]
    result = {
        "views": arguments.configurations * arguments.views,
        "configurations": arguments.configurations,
        "resident_mb": memory,
        "growth_mb": round(growth, 1),
        "limit_mb": LIMIT_MB,
        "seconds": round(watch.wall["all"][0], 1),
    }
    write_report(result, arguments.out, is_printed=False)
    print(json.dumps(result))
    sys.exit(growth > LIMIT_MB)


if __name__ == "__main__":
    main()
