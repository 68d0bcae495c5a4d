# SPDX-License-Identifier: MIT
"""Time of the ground-truth pass relative to Mitsuba's built-in ``aov`` integrator, on a Mitsuba scene file.

    python -m benchmarks.bench_material_buffers ../shared/data/scenes/staircase/scene.xml

Each BSDF of the scene is replaced by a ``cook_torrance`` with the same diffuse reflectance, which preserves
the texture lookups. The passes run in turn on the same view; ``aov`` outputs albedo, shading normal, depth
and shape index, the ground-truth pass all 17 channels. Writes JSON with medians and quartiles.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import Action, Stopwatch, interleaved, machine, summary, write_report


def _reflectance(bsdf: Any) -> Any:
    """The first diffuse reflectance texture in a tree of BSDFs, or None."""
    import mitsuba as mi

    from mitsuba_plugins.texture_checks import exposed

    children, _ = exposed(bsdf)
    for name in ("reflectance", "diffuse_reflectance"):
        if name in children:
            return children[name]
    for child in children.values():
        if isinstance(child, mi.BSDF):
            return _reflectance(child)
    return None


def load_scene(path: Path, width: int, height: int, merged: bool) -> tuple[Any, Any]:
    """Load a scene and its sensor, with ``cook_torrance`` for every BSDF; ``merged``: merge its shapes."""
    import mitsuba as mi

    scene = mi.load_file(str(path), optimize=merged)
    replacements: dict[int, Any] = {}
    originals = []
    for shape in scene.shapes():
        if shape.is_emitter():
            continue
        bsdf = shape.bsdf()
        originals.append(bsdf)
        if id(bsdf) not in replacements:
            texture = _reflectance(bsdf)
            albedo = {"diffuse_albedo": texture} if texture is not None else {}
            replacements[id(bsdf)] = mi.load_dict({"type": "cook_torrance", "roughness": 0.3, **albedo})
        shape.set_bsdf(replacements[id(bsdf)])
    to_world = np.array(scene.sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    sensor = mi.load_dict(
        {"type": "perspective", "fov": 50, "to_world": mi.ScalarTransform4f(to_world.tolist()), "film": film}
    )
    return scene, sensor


def _render(scene: Any, sensor: Any, integrator: Any, spp: int) -> None:
    import mitsuba as mi

    np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=mi.UInt32(1)))


def run(path: Path, width: int, height: int, num_pairs: int) -> dict[str, Any]:
    """Seconds of each pass at 8 and 64 samples per pixel, on separate and on merged shapes."""
    from mitsuba_plugins import register, select_variant

    variant = select_variant()
    register()
    import mitsuba as mi

    from mitsuba_plugins.material_buffers import render_material_buffers
    from mitsuba_plugins.surface_material import SceneMaterials

    results = []
    for merged in (False, True):
        scene, sensor = load_scene(path, width, height, merged)
        watch = Stopwatch()
        with watch.stage("tables"):
            materials = SceneMaterials(scene)
        aov = mi.load_dict({"type": "aov", "aovs": "a:albedo,n:sh_normal,d:depth,i:shape_index"})
        for spp in (8, 64):
            passes: dict[str, Action] = {
                "aov": partial(_render, scene, sensor, aov, spp),
                "material_buffers": partial(render_material_buffers, scene, sensor, spp, 1, materials),
            }
            seconds = {
                name: [own.wall for own in times] for name, times in interleaved(passes, num_pairs).items()
            }
            ratios = [o / a for o, a in zip(seconds["material_buffers"], seconds["aov"], strict=True)]
            results.append(
                {
                    "spp": spp,
                    "num_shapes": len(scene.shapes()),
                    "merged": merged,
                    "tables_s": watch.wall["tables"][0],
                    "aov_s": summary(seconds["aov"]),
                    "material_buffers_s": summary(seconds["material_buffers"]),
                    "ratio": summary(ratios),
                }
            )
    return {
        "benchmark": "material_buffers",
        "machine": {**machine(), "variant": variant},
        "settings": {"scene": path.name, "width": width, "height": height, "pairs": num_pairs},
        "results": results,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=384)
    parser.add_argument("--pairs", type=int, default=9)
    parser.add_argument("--out", type=Path, help="also write the JSON to this file")
    arguments = parser.parse_args()
    report = run(arguments.scene, arguments.width, arguments.height, arguments.pairs)
    write_report(report, arguments.out)


if __name__ == "__main__":
    main()
