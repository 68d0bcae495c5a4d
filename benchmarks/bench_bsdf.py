# SPDX-License-Identifier: MIT
"""Time of the BSDF ``cook_torrance`` in a room of 20 materials, against Mitsuba's built-in ``roughplastic``.

The same room (walls, 20 objects, a lamp and a window) is rendered with each BSDF in turn, in one process;
a pair's ratio is that of two renders that follow each other. ``python -m benchmarks.bench_bsdf`` writes JSON
with medians and quartiles; the target is a median ratio of at most 1.10.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

NUM_MATERIALS = 20
TARGET_RATIO = 1.10
VARIANTS = ("roughplastic", "cook_torrance", "cook_torrance in twosided", "cook_torrance, roughness textures")
BASELINE = "roughplastic"


def _material(variant: str, index: int) -> dict[str, Any]:
    """Material ``index`` of the room: even ones have constants, odd ones have textures."""
    import mitsuba as mi

    rng = np.random.default_rng(index)
    color, specular = rng.uniform(0.1, 0.8, 3), float(rng.uniform(0.02, 0.3))
    roughness = float(rng.uniform(0.2, 0.9))
    diffuse: dict[str, Any] = {"type": "rgb", "value": color.tolist()}
    rough: Any = roughness
    if index % 2:
        texels = rng.uniform(0.1, 0.8, (64, 64, 3)).astype(np.float32)
        diffuse = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
        if variant.endswith("roughness textures"):
            texels = rng.uniform(0.2, 0.9, (64, 64, 1)).astype(np.float32)
            rough = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    if variant == "roughplastic":
        plastic = {
            "type": "roughplastic",
            "distribution": "beckmann",
            "alpha": roughness**2,
            "diffuse_reflectance": diffuse,
            "specular_reflectance": {"type": "rgb", "value": [min(1.0, specular / 0.04)] * 3},
        }
        return {"type": "twosided", "nested": plastic}
    own = {
        "type": "cook_torrance",
        "diffuse_albedo": diffuse,
        "specular_albedo": {"type": "rgb", "value": [specular] * 3},
        "roughness": rough,
    }
    if variant == "cook_torrance in twosided":
        return {"type": "twosided", "nested": {**own, "two_sided": False}}
    return own


def make_room(variant: str, width: int, height: int) -> Any:
    """A 6 x 6 x 3 m room with 20 objects, each with a material of its own."""
    import mitsuba as mi

    transform = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8},
        "sensor": {
            "type": "perspective",
            "fov": 70,
            "to_world": transform().look_at([-2.7, -2.7, 1.7], [0.5, 0.5, 0.7], [0, 0, 1]),
            "film": film,
            "sampler": {"type": "independent"},
        },
        "shell": {
            "type": "cube",
            "to_world": transform().translate([0, 0, 1.5]).scale([3, 3, 1.5]),
            "bsdf": _material(variant, 0),
        },
        "lamp": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, 2.95]).rotate([1, 0, 0], 180).scale(0.5),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [12.0, 11.0, 9.0]}},
        },
        "window": {
            "type": "rectangle",
            "to_world": transform().translate([2.95, 0, 1.5]).rotate([0, 1, 0], -90).scale([0.8, 1.2, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 4.0, 6.0]}},
        },
    }
    rng = np.random.default_rng(0)
    for i in range(1, NUM_MATERIALS):
        x, y = -1.6 + 1.0 * (i % 5), -1.6 + 1.0 * (i // 5)
        size = float(rng.uniform(0.2, 0.4))
        place = transform().translate([x, y, size]).rotate([0, 0, 1], float(rng.uniform(0, 90))).scale(size)
        kind = ("sphere", "cube", "cylinder")[i % 3]
        if kind == "cylinder":
            place = place @ transform().translate([0, 0, -1])
        scene[f"object_{i}"] = {"type": kind, "to_world": place, "bsdf": _material(variant, i)}
    return mi.load_dict(scene, optimize=False)


def _seconds(scene: Any, spp: int, seed: int) -> tuple[float, float]:
    """(wall time, processor time of all threads) of one render; the second hardly notices a busy machine."""
    import drjit as dr
    import mitsuba as mi

    start, start_cpu = time.perf_counter(), time.process_time()
    image = mi.render(scene, spp=spp, seed=seed)
    dr.eval(image)
    dr.sync_thread()
    return time.perf_counter() - start, time.process_time() - start_cpu


def _quartiles(values: list[float]) -> dict[str, float]:
    low, middle, high = np.percentile(values, [25, 50, 75])
    return {"median": float(middle), "q25": float(low), "q75": float(high)}


def run(width: int, height: int, spp: int, num_pairs: int) -> dict[str, Any]:
    """Render every variant ``num_pairs`` times, interleaved, and summarise seconds and ratios."""
    from mitsuba_plugins import register, select_variant

    variant = select_variant()
    register()
    scenes, compile_s = {}, {}
    for name in VARIANTS:
        scenes[name] = make_room(name, width, height)
        compile_s[name] = _seconds(scenes[name], spp, 0)[0]
        _seconds(scenes[name], spp, 1)
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in VARIANTS}
    for pair in range(num_pairs):
        for name in VARIANTS if pair % 2 else reversed(VARIANTS):
            seconds[name].append(_seconds(scenes[name], spp, 2 + pair))
    results = {}
    for name in VARIANTS:
        pairs = list(zip(seconds[name], seconds[BASELINE], strict=True))
        wall = [own[0] for own in seconds[name]]
        samples = width * height * spp
        results[name] = {
            "seconds": _quartiles(wall),
            "ratio_to_roughplastic": _quartiles([own[0] / base[0] for own, base in pairs]),
            "processor_time_ratio": _quartiles([own[1] / base[1] for own, base in pairs]),
            "megasamples_per_s": samples / float(np.median(wall)) / 1e6,
            "first_render_s": compile_s[name],
        }
    ratio = results["cook_torrance"]["ratio_to_roughplastic"]["median"]
    return {
        "benchmark": "bsdf",
        "machine": {"processor": platform.machine(), "variant": variant, "python": platform.python_version()},
        "settings": {"width": width, "height": height, "spp": spp, "pairs": num_pairs, "max_depth": 8},
        "results": results,
        "target_ratio": TARGET_RATIO,
        "is_within_target": bool(ratio <= TARGET_RATIO),
    }


def main() -> int:
    """Command line; exit code 1 where the target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=384)
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--pairs", type=int, default=15)
    parser.add_argument("--out", type=Path, help="also write the JSON to this file")
    arguments = parser.parse_args()
    text = json.dumps(
        run(arguments.width, arguments.height, arguments.spp, arguments.pairs), indent=2, sort_keys=True
    )
    print(text)
    if arguments.out:
        arguments.out.write_text(text + "\n")
    return 0 if json.loads(text)["is_within_target"] else 1


if __name__ == "__main__":
    sys.exit(main())
