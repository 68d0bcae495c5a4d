# SPDX-License-Identifier: MIT
"""Light that short paths miss in bundled rooms, by the formula of ``max_energy_left`` and as measured.

python -m benchmarks.bench_path_depth [--rooms bathroom living_room]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from datagen.assembly.plan import assemble
from datagen.formats.recipe import AssetFilter, Recipe, RenderRecipe
from datagen.library import Library, resolve_library_paths
from datagen.rendering.path_depth import depth_for, reflectance_met, truncation
from datagen.rendering.renderer import SceneRenderer

DEPTHS = (2, 4, 8)
LONGEST = 32
SAMPLES = 64


def missing_light(room: str, size: tuple[int, int] = (48, 30)) -> dict[str, Any]:
    """Mean reflectance along paths, the depth that it requires, and the energy truncated at each depth."""
    from datagen.rendering.transport.integrator import PathTracer

    library = Library(resolve_library_paths(("bundled",), Path()))
    recipe = Recipe(
        name=f"error-{room}",
        seed=72,
        configurations=1,
        views=5,
        resolution=size,
        environments=AssetFilter(include=(room,)),
    )
    configuration = assemble(recipe, 0, library)
    renderer = SceneRenderer(configuration, library, RenderRecipe(path_samples=1))
    reflectance = reflectance_met(list(renderer.scene.coarse_maps()))
    sensor = renderer.sensor(configuration.cameras[0].camera())
    light = {
        depth: PathTracer(renderer.built, depth, 2 * LONGEST).accumulate(sensor, SAMPLES, 1).radiance.sum()
        for depth in (*DEPTHS, LONGEST)
    }
    return {
        "reflectance": round(reflectance, 3),
        "depth_for_1_percent": depth_for(reflectance, 0.01),
        "left": {
            depth: {
                "formula": round(truncation(reflectance, depth), 4),
                "measured": round(float(1 - light[depth] / light[LONGEST]), 4),
            }
            for depth in DEPTHS
        },
    }


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rooms", nargs="+", default=["bathroom", "living_room"])
    for room in parser.parse_args().rooms:
        print(json.dumps({room: missing_light(room)}, indent=1))


if __name__ == "__main__":
    main()
