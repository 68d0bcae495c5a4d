# SPDX-License-Identifier: MIT
"""Renders recovered materials under the scene's lights and under recovered lights, compares the images with
the truth, and looks up the confidence of an atlas at the pixels of views.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import EnvironmentAsset
from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.formats.configuration import configuration_of
from datagen.formats.package import open_package
from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.ply import read_ply
from datagen.foundation.progress import Advance
from datagen.geometry.texture_lookup import looked_up, pixel_uv
from datagen.geometry.traced import TracedGeometry
from datagen.rendering.capture_geometry import light_of_part
from model.evaluation.lpips import Lpips
from model.evaluation.metrics import image_figures
from model.evaluation.noise import seed_spread
from model.evaluation.opened_scene import (
    INSERTED,
    MODIFIED,
    OWN,
    RECOVERED,
    RENDER_SEED,
    SECOND_SEED,
    OpenedScene,
)
from model.evaluation.rendering import EnoughOf, JudgedView, Rendering, render_scenery
from model.evaluation.scenery import Scenery, recovered_scenery
from model.evaluation.suite import Method, Suite, TruthMethod

Emission = dict[str, tuple[float, float, float]]


def renderings_of(
    suite: Suite,
    scene: OpenedScene,
    method: Method,
    light: str,
    scenery: Scenery,
    tell: Advance,
) -> tuple[Rendering, Rendering]:
    """Render ``scenery`` from all judged views under ``light``, and from some of them with a second seed.

    Both seeds differ from that of the truth. A :class:`TruthMethod` is never stopped early.
    """
    enough: EnoughOf | None = None
    stopped_by: list[Any] = []
    if suite.noise_share is not None and not isinstance(method, TruthMethod):
        enough = EnoughOf(scene.truth[light], suite.noise_share)
        stopped_by = [suite.noise_share, Path(scene.renders.get(light, scene.prepared.capture)).name]
    some = (*scene.inputs[: suite.seed_views], *scene.novel[: suite.seed_views])
    some = () if light == INSERTED else some
    first = scene.rendering(scenery, light, RENDER_SEED, suite.render, None, *stopped_by)
    again = scene.rendering(scenery, light, SECOND_SEED, suite.render, some, *stopped_by)
    render_scenery(scenery, scene.views_of(light), [first, again], suite.render, enough, tell)
    return first, again


def spread_of(
    scene: OpenedScene,
    light: str,
    again: Rendering,
    first: dict[str, dict[str, dict[str, float | None]]],
    lpips: Lpips | None,
) -> dict[str, float]:
    """Standard deviation of each figure of a view due to the renderer's noise, from the rendering ``again``
    with a second seed and the figures ``first`` (by set, view and name) with the first seed."""
    if not again.views:
        return {}
    second = figures_of(scene, light, again.views, again.read(), lpips)
    rows = {name: row for views in first.values() for name, row in views.items()}
    return seed_spread([(rows[name], second[name]) for name in again.views])


def figures_of(
    scene: OpenedScene,
    light: str,
    views: tuple[str, ...],
    rendered: dict[str, JudgedView],
    lpips: Lpips | None,
) -> dict[str, dict[str, float | None]]:
    """Figures of the views ``views`` in ``rendered``, by view and name; LPIPS is None without ``lpips``."""
    truth = {name: scene.truth[light][name] for name in views}
    return image_figures(rendered, truth, scene.exposures[light], lpips)


def merged_confidence(folder: Path, cameras: Mapping[str, Camera]) -> dict[str, NDArray[np.float64]]:
    """Confidence (H, W, 3) of D, S and R in [0, 1] in each view, by name; empty for an atlas without it.

    ``folder`` is the output of ``materials infer``.
    """
    from PIL import Image

    path = folder / "atlas" / "confidence.png"
    if not path.is_file():
        return {}
    with Image.open(path) as image:
        atlas = np.asarray(image.convert("RGB"), np.float32) / 255
    mesh = read_ply(folder / "asset" / "surface.ply")
    traced = TracedGeometry(CaptureGeometry(mesh, (GeometryPart("surface", 0, len(mesh.faces)),)))
    found = {}
    for name, camera in cameras.items():
        uv = pixel_uv(mesh, camera, traced.trace_view(camera))
        is_surface = ~np.isnan(uv[..., 0])
        found[name] = np.zeros((camera.height_px, camera.width_px, 3))
        found[name][is_surface] = looked_up(atlas, uv[is_surface])
    return found


def recovered_sceneries(scene: OpenedScene, asset: Path) -> dict[str, Scenery]:
    """Return a :class:`Scenery` of ``asset`` for each light of the scene and for recovered lights, if any."""
    parts, sceneries = scene.capture.geometry.parts, {}
    lamps = {name for part in parts if (name := light_of_part(part.name)) is not None}
    for light, truth in scene.sceneries.items():
        gain = scene.modified_gain if light == MODIFIED else 1.0
        sceneries[light] = recovered_scenery(truth, asset, own_emission(asset, parts, gain), lamps)
    report = json.loads((asset.parent / "report.json").read_bytes())
    if report["light"].get("lights"):
        sceneries[RECOVERED] = relit_scenery(scene.sceneries[OWN], asset)
    return sceneries


def own_emission(asset: Path, parts: Iterable[GeometryPart], gain: float) -> Emission:
    """RGB radiance by emissive slot of the package ``asset`` that reproduces the scene's lamps.

    Slot ``lamp-N`` (``export.slots``) gets the radiance of the N-th emissive part times ``gain``; all other
    slots get 0.
    """
    emitted = [part.emission for part in parts if part.emission is not None]
    lamps = {f"lamp-{number}": radiance for number, radiance in enumerate(emitted)}
    room, found = open_package(asset).asset, {}
    assert isinstance(room, EnvironmentAsset)
    for slot, material in room.materials.items():
        if material.emission is not None:
            red, green, blue = (gain * channel for channel in lamps.get(slot, (0.0, 0.0, 0.0)))
            found[slot] = (red, green, blue)
    return found


def relit_scenery(truth: Scenery, asset: Path) -> Scenery:
    """Return the package ``asset`` under only its own lights, with the cameras of ``truth``."""
    lights = configuration_of(open_package(asset)).lights
    scenery = recovered_scenery(truth, asset, {})
    return Scenery(scenery.configuration.model_copy(update={"lights": lights}), scenery.library)
