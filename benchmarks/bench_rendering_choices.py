# SPDX-License-Identifier: MIT
"""The measurements behind docs/decisions/0007: shapes, textures and the denoiser's guides.

    python benchmarks/bench_rendering_choices.py shapes       merged, separate and instanced meshes
    python benchmarks/bench_rendering_choices.py scene        the staircase as 775 shapes and merged by BSDF
    python benchmarks/bench_rendering_choices.py denoiser     guides and qualities, relMSE and CPU seconds

Variants take turns in one process; CPU seconds (all threads) are medians, because they suffer less than wall
seconds from what else the machine does. ``denoiser`` needs the references that bench_view.py makes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import trimesh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.bench_view import (
    RESULTS,
    SHARED_DATA,
    configuration_of,
    converted,
    cpu_seconds,
    references,
    summary,
)
from datagen.cameras import Camera, look_at
from datagen.formats.recipe import RenderRecipe
from datagen.meshes import Mesh, joined, vertex_normals
from datagen.rendering.denoiser import QUALITIES, OidnDenoiser, auxiliary_albedo
from datagen.rendering.error import relative_mse
from datagen.rendering.renderer import SceneRenderer, view_seed
from datagen.rendering.scene_builder import BuiltScene, sensor_for
from mitsuba_plugins.variant import select_variant

SIZE = (640, 384)
REPEATS = 9


def built(scene: Any) -> BuiltScene:
    """A bare Mitsuba scene as the path tracer wants it."""
    return BuiltScene(scene, {}, {}, {}, {}, set())


def in_turns(runs: dict[str, Callable[[], Any]], repeats: int = REPEATS) -> dict[str, Any]:
    """CPU and wall seconds of each run, after one that compiles."""
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    wall: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(repeats):
        for name, run in runs.items():
            start, wall_start = cpu_seconds(), time.perf_counter()
            run()
            seconds[name].append(cpu_seconds() - start)
            wall[name].append(time.perf_counter() - wall_start)
    return {name: {"cpu_s": summary(seconds[name]), "wall_s": summary(wall[name])} for name in runs}


def compare_shapes() -> dict[str, Any]:
    """40 spheres of 20,480 triangles: one mesh, 40 meshes, or 40 instances of one."""
    import mitsuba as mi

    from datagen.rendering.geometry import in_world, make_shape
    from datagen.rendering.path_tracer import PathTracer
    from datagen.rendering.plugins import register_rendering_plugins

    register_rendering_plugins()
    rng = np.random.default_rng(0)
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.2)
    raw = Mesh(np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces, np.int32))
    mesh = Mesh(raw.positions, raw.faces, vertex_normals(raw))
    poses = [np.eye(4) for _ in range(40)]
    for pose in poses:
        pose[:3, 3] = [*rng.uniform(-2, 2, 2), rng.uniform(0.2, 1.0)]
    ground = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], np.float32)
    floor = Mesh(ground, np.array([[0, 1, 2], [0, 2, 3]], np.int32))

    def scene(kind: str) -> Any:
        bsdf = mi.load_dict({"type": "cook_torrance", "roughness": 0.3})
        parts: dict[str, Any] = {
            "type": "scene",
            "light": {"type": "constant"},
            "floor": make_shape("floor", floor, bsdf),
        }
        if kind == "merged":
            parts["all"] = make_shape("all", joined([in_world(mesh, pose, 1.0) for pose in poses]), bsdf)
        elif kind == "separate":
            for k, pose in enumerate(poses):
                parts[f"one_{k}"] = make_shape(f"one_{k}", in_world(mesh, pose, 1.0), bsdf)
        else:
            parts["group"] = {"type": "shapegroup", "one": make_shape("one", mesh, bsdf)}
            for k, pose in enumerate(poses):
                parts[f"instance_{k}"] = {
                    "type": "instance",
                    "to_world": mi.ScalarTransform4f(pose),
                    "group": {"type": "ref", "id": "group"},
                }
        return mi.load_dict(parts, optimize=False)

    camera = Camera(*SIZE, 500, 500, 320, 192, look_at([0, -4, 2.5], [0, 0, 0.3]))
    runs: dict[str, Callable[[], Any]] = {}
    building: dict[str, dict[str, float]] = {}
    for kind in ("merged", "separate", "instanced"):
        memory, start = psutil.Process().memory_info().rss, cpu_seconds()
        tracer = PathTracer(built(scene(kind)), 8, 5)
        building[kind] = {
            "build_cpu_s": round(cpu_seconds() - start, 2),
            "build_mb": round((psutil.Process().memory_info().rss - memory) / 1e6, 1),
        }
        runs[kind] = lambda tracer=tracer: tracer.render(sensor_for(camera), 4, 1)
    timed = in_turns(runs)
    return {kind: timed[kind] | building[kind] for kind in runs}


def compare_scene() -> dict[str, Any]:
    """The staircase with Mitsuba's own BSDFs, one shape a mesh and merged by BSDF."""
    import mitsuba as mi

    from datagen.rendering.path_tracer import PathTracer
    from datagen.rendering.plugins import register_rendering_plugins

    register_rendering_plugins()
    path = str(SHARED_DATA / "scenes" / "staircase" / "scene.xml")
    runs: dict[str, Callable[[], Any]] = {}
    shapes: dict[str, int] = {}
    loading: dict[str, list[float]] = {}
    for kind, is_merged in (("separate", False), ("merged", True)):
        loading[kind] = []
        for _ in range(3):
            start = cpu_seconds()
            scene: Any = mi.load_file(path, optimize=is_merged)
            loading[kind].append(cpu_seconds() - start)
        matrix = np.array(scene.sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)
        camera = Camera(*SIZE, 550, 550, 320, 192, matrix @ np.diag([-1.0, -1, 1, 1]))
        tracer = PathTracer(built(scene), 8, 5)
        shapes[kind] = len(scene.shapes())
        runs[kind] = lambda tracer=tracer, camera=camera: tracer.render(sensor_for(camera), 2, 1)
    timed = in_turns(runs)
    return {
        kind: timed[kind] | {"shapes": shapes[kind], "load_cpu_s": summary(loading[kind])} for kind in runs
    }


def compare_denoisers(view: int) -> dict[str, Any]:
    """relMSE (two definitions) and CPU seconds of qualities and guides, for 2, 4 and 8 path samples."""
    library = converted("staircase", RESULTS)
    configuration = configuration_of(library, 40, SIZE)
    renderer = SceneRenderer(configuration, library, RenderRecipe(path_samples=2))
    (first, second) = references(renderer, RESULTS, [view], 256)[view]
    begun = renderer._begin(view)
    buffers, seen_lights = begun.buffers, begun.seen_lights
    sensor = renderer._sensor(configuration.cameras[view].camera())
    mask, normal = buffers["surface_mask"], buffers["normal_world"]
    both = auxiliary_albedo(buffers["diffuse_albedo"], buffers["specular_albedo"], mask)
    guides = {"D + S": both, "D": mask * buffers["diffuse_albedo"]}
    result: dict[str, Any] = {}
    for samples in (2, 4, 8):
        noisy = [
            renderer._tracer.render(sensor, samples, view_seed(k, view, "path"), with_seen_lights=False)
            for k in range(3)
        ]
        for quality in QUALITIES:
            for guide, albedo in guides.items():
                denoiser = OidnDenoiser(quality=quality)
                denoiser.denoise(noisy[0], albedo, normal)
                start = cpu_seconds()
                images = [denoiser.denoise(image, albedo, normal) + seen_lights for image in noisy]
                seconds = (cpu_seconds() - start) / len(images)
                denoiser.close()
                result[f"{samples} samples, {quality}, {guide}"] = {
                    "rel_mse": round(float(np.mean([relative_mse(i, first, second) for i in images])), 5),
                    "rel_mse_exposed": round(
                        float(np.mean([relative_mse(i, first, second, exposed=True) for i in images])), 5
                    ),
                    "cpu_s": round(seconds, 3),
                }
    return result


def main() -> None:
    """Parse, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("shapes", "scene", "denoiser"))
    parser.add_argument("--view", type=int, default=0)
    arguments = parser.parse_args()
    select_variant("llvm_ad_rgb")
    if arguments.what == "denoiser":
        result = compare_denoisers(arguments.view)
    else:
        result = compare_shapes() if arguments.what == "shapes" else compare_scene()
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / f"bench_rendering_{arguments.what}.json"
    path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
