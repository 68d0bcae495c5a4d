# SPDX-License-Identifier: MIT
"""Re-renderings of recovered materials, compared with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from datagen.foundation.progress import Advance
from model.evaluation.lpips import Lpips
from model.evaluation.metrics import image_figures
from model.evaluation.noise import seed_spread
from model.evaluation.opened_scene import INSERTED, RENDER_SEED, SECOND_SEED, OpenedScene
from model.evaluation.rendering import EnoughOf, JudgedView, Rendering, render_scenery
from model.evaluation.scenery import Scenery
from model.evaluation.suite import Method, Suite, TruthMethod


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
