# SPDX-License-Identifier: MIT
"""Time of the BSDF ``cook_torrance`` in a room of 20 materials, relative to Mitsuba's ``roughplastic``.

The same room (walls, 19 objects, a lamp and a window) is rendered with each BSDF in turn, in one process;
ratios are formed within each turn. ``python -m benchmarks.bench_bsdf`` writes JSON with medians and
quartiles; the target is a median ratio of at most 1.10.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import interleaved, machine, summary, timed, write_report

NUM_MATERIALS = 20
TARGET_RATIO = 1.10
VARIANTS = ("roughplastic", "cook_torrance", "cook_torrance in twosided", "cook_torrance, roughness textures")
BASELINE = "roughplastic"


def _material(variant: str, index: int) -> dict[str, Any]:
    """Mitsuba dictionary of material ``index`` of the room: constant for even indices, textured for odd."""
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
    """Scene of a room of 6 x 6 x 3 m with 19 objects and 20 materials of the BSDF ``variant``."""
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


def _render(scene: Any, spp: int) -> None:
    import drjit as dr
    import mitsuba as mi

    image = mi.render(scene, spp=spp, seed=mi.UInt32(1))
    dr.eval(image)
    dr.sync_thread()


def run(width: int, height: int, spp: int, num_pairs: int) -> dict[str, Any]:
    """Render the BSDFs in turn, ``num_pairs`` times with ``spp`` paths per pixel; returns the report."""
    from mitsuba_plugins import register, select_variant

    variant = select_variant()
    register()
    renders = {name: partial(_render, make_room(name, width, height), spp) for name in VARIANTS}
    compile_s = {name: timed(render).wall for name, render in renders.items()}
    seconds = interleaved(renders, num_pairs)
    results: dict[str, dict[str, Any]] = {}
    for name in VARIANTS:
        pairs = list(zip(seconds[name], seconds[BASELINE], strict=True))
        wall = [own.wall for own in seconds[name]]
        samples = width * height * spp
        results[name] = {
            "seconds": summary(wall),
            "ratio_to_roughplastic": summary([own.wall / base.wall for own, base in pairs]),
            "processor_time_ratio": summary([own.cpu / base.cpu for own, base in pairs]),
            "megasamples_per_s": samples / float(np.median(wall)) / 1e6,
            "first_render_s": compile_s[name],
        }
    ratio = results["cook_torrance"]["ratio_to_roughplastic"]["median"]
    return {
        "benchmark": "bsdf",
        "machine": {**machine(), "variant": variant},
        "settings": {"width": width, "height": height, "spp": spp, "pairs": num_pairs, "max_depth": 8},
        "results": results,
        "target_ratio": TARGET_RATIO,
        "is_within_target": bool(ratio <= TARGET_RATIO),
    }


def main() -> int:
    """Run the command; the exit code is 1 if the target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=384)
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--pairs", type=int, default=15)
    parser.add_argument("--out", type=Path, help="also write the JSON to this file")
    arguments = parser.parse_args()
    report = run(arguments.width, arguments.height, arguments.spp, arguments.pairs)
    write_report(report, arguments.out)
    return 0 if report["is_within_target"] else 1


if __name__ == "__main__":
    sys.exit(main())
