# SPDX-License-Identifier: MIT
"""Renders an environment package as it is, with its own materials, lights and cameras.

``python -m datagen.inspection.render_package PACKAGE... --out OUT`` writes ``OUT/<folder>/view_000.exr`` and
so on, one linear EXR file per camera. The Blender add-on's fidelity report runs this module in a separate
process, since Blender and Mitsuba cannot share a process.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from datagen.foundation.command_line import run_function
from datagen.foundation.errors import input_error


def render_package(
    package_path: Path, out: Path, samples: int = 64, max_depth: int = 8, denoise: bool = False
) -> list[Path]:
    """Render every camera of a package; return the EXR files in the order of the cameras."""
    import numpy as np

    from datagen.formats.base import write_bytes_atomically
    from datagen.formats.configuration import configuration_of
    from datagen.formats.recipe import RenderRecipe
    from datagen.foundation.exr import encode_channels
    from datagen.library import Library
    from datagen.rendering.renderer import SceneRenderer

    library = Library([package_path])
    (package,) = library
    configuration = configuration_of(package)
    recipe = RenderRecipe(path_samples=samples, auxiliary_samples=4, max_depth=max_depth, denoise=denoise)
    renderer = SceneRenderer(configuration, library, recipe)
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for view in renderer.render_views(range(len(configuration.cameras))):
        path = out / f"{configuration.cameras[view.index].name}.exr"
        beauty = view.buffers["beauty"].astype(np.float32)
        write_bytes_atomically(path, encode_channels({"RGB": beauty}))
        written.append(path)
    return written


def main(
    packages: Annotated[list[Path], typer.Argument(help="Environment packages.")],
    out: Annotated[Path, typer.Option(help="Folder of the result, with a folder for each package.")],
    samples: Annotated[int, typer.Option(min=1, help="Light paths per pixel.")] = 64,
    max_depth: Annotated[int, typer.Option(min=1, help="Maximum number of segments of a light path.")] = 8,
    denoise: Annotated[bool, typer.Option("--denoise", help="Denoise the images.")] = False,
) -> None:
    """Render environment packages with their own materials, lights and cameras."""
    names = [package.name for package in packages]
    if len(set(names)) < len(names):
        remedy = "render one at a time, each to its own --out"
        raise input_error(
            "packages", "", ", ".join(names), "different names, since each names a folder in --out", remedy
        )
    for package in packages:
        for path in render_package(package, out / package.name, samples, max_depth, denoise):
            typer.echo(path)


if __name__ == "__main__":
    run_function(main)
