# SPDX-License-Identifier: MIT
"""Renders an environment package with its own materials, lights and cameras, without assembly.

``python -m datagen.inspection.render_package PACKAGE... --out OUT`` writes ``OUT/<folder>/view_000.exr`` and
so on, one linear EXR file per camera. The Blender add-on's fidelity report runs it in a separate process,
since Blender and Mitsuba cannot share one.
"""

from __future__ import annotations

import argparse
from pathlib import Path


def render_package(
    package_path: Path, out: Path, samples: int = 64, max_depth: int = 8, denoise: bool = False
) -> list[Path]:
    """Render every camera of a package; returns the EXR files in the order of the cameras."""
    from datagen.formats.package import open_package
    from datagen.formats.recipe import RenderRecipe
    from datagen.formats.standalone import configuration_of
    from datagen.library import Library
    from datagen.rendering.renderer import SceneRenderer

    library = Library([package_path])
    package = open_package(package_path)
    configuration = configuration_of(package_path, package.sha256)
    recipe = RenderRecipe(path_samples=samples, auxiliary_samples=4, max_depth=max_depth, denoise=denoise)
    renderer = SceneRenderer(configuration, library, recipe)
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for view in renderer.render_views(range(len(configuration.cameras))):
        path = out / f"{configuration.cameras[view.index].name}.exr"
        _write_rgb(path, view.buffers["beauty"])
        written.append(path)
    return written


def _write_rgb(path: Path, pixels: object) -> None:
    import numpy as np
    import OpenEXR

    rgb = np.ascontiguousarray(pixels, dtype=np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": rgb}) as file:
        file.write(str(path))


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("packages", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--max-depth", type=int, default=8)
    parser.add_argument("--denoise", action="store_true")
    arguments = parser.parse_args()
    for package in arguments.packages:
        out = arguments.out / package.name
        options = (arguments.samples, arguments.max_depth, arguments.denoise)
        print(*render_package(package, out, *options), sep="\n")


if __name__ == "__main__":
    main()
