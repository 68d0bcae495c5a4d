# SPDX-License-Identifier: MIT
"""Renders views of a :class:`Scenery` (configuration and packages) to EXR files; a rerun resumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import write_bytes_atomically
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.buffers import MATERIAL_MAPS, surface_pixels
from datagen.foundation.errors import InputError
from datagen.foundation.exr import decode_view, encode_view
from datagen.foundation.progress import Advance, no_advance
from datagen.library import Library
from datagen.rendering.error import relative_mse
from model.evaluation.scenery import Scenery

if TYPE_CHECKING:
    from datagen.rendering.sample_budget import ErrorEstimate
    from datagen.rendering.view_job import IsEnough

BUFFERS = ("beauty", *MATERIAL_MAPS, "surface_mask", "depth_z_m", "normal_world")


@dataclass(frozen=True)
class JudgedView:
    """Image of a view with its maps.

    ``color`` (H, W, 3) is linear radiance; ``maps`` (H, W, 3 or 1) are by name; ``surface_mask`` (H, W) marks
    pixels at least half covered by reflecting surface, ``emission_mask`` (H, W) emitters without material.
    """

    color: NDArray[np.float32]
    maps: dict[str, NDArray[np.float32]]
    surface_mask: NDArray[np.bool_]
    emission_mask: NDArray[np.bool_]


def judged_view(buffers: dict[str, NDArray]) -> JudgedView:
    """Convert stored :data:`BUFFERS`, (H, W, C) by name, to a judged view."""
    maps = {name: np.clip(buffers[name].astype(np.float32), 0, 1) for name in MATERIAL_MAPS}
    color, surface = buffers["beauty"].astype(np.float32), surface_pixels(buffers)
    emits = ~surface & (buffers["depth_z_m"][..., 0] > 0) & (color.max(axis=2) > 0)
    return JudgedView(color, maps, surface, emits)


@dataclass(frozen=True)
class Rendering:
    """Images of some ``views`` of a :class:`Scenery` with one seed, stored as ``VIEW.exr`` in ``folder``.

    Existing files are reused, so the folder's name must depend on everything that affects pixels.
    """

    seed: int
    views: tuple[str, ...]
    folder: Path

    def missing(self) -> list[str]:
        """Names of the views whose files are missing or damaged."""
        return [name for name in self.views if _read(self.folder / f"{name}.exr") is None]

    def read(self) -> dict[str, JudgedView]:
        """The rendered views by name, without missing and damaged ones."""
        found = {name: _read(self.folder / f"{name}.exr") for name in self.views}
        return {name: view for name, view in found.items() if view is not None}


@dataclass(frozen=True)
class EnoughOf:
    """Criterion that stops the rendering of a view once noise hardly affects its difference from the truth.

    A view is finished when e + s <= ``share`` (d - e), where e is the estimated relMSE due to noise, s the
    standard error of e, and d the relMSE of the view against ``truth``.
    """

    truth: Mapping[str, JudgedView]
    share: float

    def decides(self, names: Sequence[str]) -> IsEnough:
        """Return the criterion as a function for the renderer; its view indices refer to ``names``."""

        def is_enough(index: int, image: NDArray[np.floating], estimate: ErrorEstimate) -> bool:
            difference = relative_mse(image, self.truth[names[index]].color, exposed=True)
            bound = self.share * (difference - estimate.rel_mse)
            return estimate.rel_mse + estimate.standard_error <= bound

        return is_enough


def render_scenery(
    scenery: Scenery,
    cameras: Sequence[str],
    renderings: Sequence[Rendering],
    render: RenderRecipe,
    enough: EnoughOf | None = None,
    tell: Advance = no_advance,
) -> None:
    """Render the missing views of ``renderings`` in the quality ``render``.

    ``enough`` stops views early; ``tell`` receives the numbers of finished and of all views. Irradiance cache
    and sky guide are always estimated from all ``cameras``, even if few views are missing.
    """
    missing = [(rendering, names) for rendering in renderings if (names := rendering.missing())]
    if not missing:
        return
    from datagen.rendering.renderer import SceneRenderer

    first = missing[0][0]
    seen = scenery.seen_by(cameras).with_seed(first.seed)
    done, total = 0, sum(len(names) for _, names in missing)
    with Library(seen.library) as library:
        decides = None if enough is None else enough.decides(cameras)
        renderer = SceneRenderer(seen.configuration, library, render, is_enough=decides)
        try:
            for rendering, names in missing:
                rendering.folder.mkdir(parents=True, exist_ok=True)
                if rendering is not first:
                    renderer.reseed(rendering.seed)
                for view in renderer.render_views([list(cameras).index(name) for name in names]):
                    stored = {buffer: view.buffers[buffer] for buffer in BUFFERS}
                    path = rendering.folder / f"{cameras[view.index]}.exr"
                    write_bytes_atomically(path, encode_view(stored))
                    done += 1
                    tell(done, total)
        finally:
            renderer.close()


def _read(path: Path) -> JudgedView | None:
    """Read a rendered view; None if the file is missing or damaged."""
    if not path.is_file():
        return None
    try:
        return judged_view(decode_view(path, BUFFERS))
    except InputError:
        return None
