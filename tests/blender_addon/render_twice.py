# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders a package's first camera with Mitsuba, twice: ``python -m ... PACKAGE OUT SAMPLES``.

``OUT/mitsuba.npy`` contains two linear images (2, H, W, 3) with independent noise.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from tests.blender_addon.living_room import MITSUBA_DEPTH


def main(package_path: Path, out: Path, samples: int) -> None:
    from datagen.formats.configuration import configuration_of
    from datagen.formats.package import open_package
    from datagen.formats.recipe import RenderRecipe
    from datagen.library import Library
    from datagen.rendering.renderer import SceneRenderer

    configuration = configuration_of(open_package(package_path))
    camera = configuration.cameras[0]
    pair = (camera, camera.model_copy(update={"name": "again"}))  # seeds differ by the index of the view
    configuration = configuration.model_copy(update={"cameras": pair})
    recipe = RenderRecipe(path_samples=samples, auxiliary_samples=8, max_depth=MITSUBA_DEPTH, denoise=False)
    renderer = SceneRenderer(configuration, Library([package_path]), recipe)
    np.save(out / "mitsuba.npy", np.stack([v.buffers["beauty"] for v in renderer.render_views(range(2))]))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
