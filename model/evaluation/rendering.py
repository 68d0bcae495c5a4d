# SPDX-License-Identifier: MIT
"""Views of a scenery on disk: rendered once, one EXR each, continued where it stopped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import write_bytes_atomically
from datagen.formats.capture import CaptureView
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.buffers import MATERIAL_MAPS, surface_pixels
from datagen.foundation.errors import InputError
from datagen.foundation.exr import decode_view, encode_view
from datagen.library import Library
from model.evaluation.scenery import Scenery

BUFFERS = ("beauty", *MATERIAL_MAPS, "surface_mask", "depth_z_m", "normal_world")


@dataclass(frozen=True)
class JudgedView:
    """A view with its maps. ``color`` (H, W, 3) linear; ``maps`` by name (H, W, 3 or 1); ``surface_mask``
    (H, W): pixels that reflecting surface covers at least half; ``emission_mask`` (H, W): pixels of surface
    that shines and has no material."""

    color: NDArray[np.float32]
    maps: dict[str, NDArray[np.float32]]
    surface_mask: NDArray[np.bool_]
    emission_mask: NDArray[np.bool_]


def judged_view(buffers: dict[str, NDArray]) -> JudgedView:
    """From stored buffers."""
    maps = {name: np.clip(buffers[name].astype(np.float32), 0, 1) for name in MATERIAL_MAPS}
    color, surface = buffers["beauty"].astype(np.float32), surface_pixels(buffers)
    shines = ~surface & (buffers["depth_z_m"][..., 0] > 0) & (color.max(axis=2) > 0)
    return JudgedView(color, maps, surface, shines)


def stored_view(view: CaptureView) -> JudgedView:
    """A view of a rendered capture as it is stored."""
    return judged_view(view.source.read_maps(BUFFERS))


def render_scenery(
    scenery: Scenery,
    views: Sequence[str],
    folder: Path,
    render: RenderRecipe,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, JudgedView]:
    """``views`` of a scenery. ``folder`` keeps ``VIEW.exr``; those that are there are not rendered again, so
    the folder must be named by all that decides the pixels."""
    missing = [name for name in views if _read(folder / f"{name}.exr") is None]
    if missing:
        _render(scenery.seen_by(views), [list(views).index(name) for name in missing], folder, render, tell)
    found = {name: _read(folder / f"{name}.exr") for name in views}
    return {name: view for name, view in found.items() if view is not None}


def _render(
    scenery: Scenery,
    indices: Sequence[int],
    folder: Path,
    render: RenderRecipe,
    tell: Callable[[int, int], None],
) -> None:
    from datagen.rendering.renderer import SceneRenderer

    folder.mkdir(parents=True, exist_ok=True)
    with Library(scenery.library) as library:
        renderer = SceneRenderer(scenery.configuration, library, render)
        try:
            for number, view in enumerate(renderer.render_views(indices), start=1):
                name = scenery.configuration.cameras[view.index].name
                stored = {buffer: view.buffers[buffer] for buffer in BUFFERS}
                write_bytes_atomically(folder / f"{name}.exr", encode_view(stored))
                tell(number, len(indices))
        finally:
            renderer.close()


def _read(path: Path) -> JudgedView | None:
    """A rendered view; None where it is not there or damaged."""
    if not path.is_file():
        return None
    try:
        return judged_view(decode_view(path, BUFFERS))
    except InputError:
        return None
