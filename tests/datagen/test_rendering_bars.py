# SPDX-License-Identifier: MIT
"""Window bars one pixel wide keep their radiance between bright panes, and the recorded error is correct."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.formats.asset import SlotMaterial
from datagen.formats.base import parse_model
from datagen.formats.lights import AreaLight
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import exposure_for, luminance
from datagen.rendering.error import relative_mse
from datagen.rendering.noisy_share import blended, noisy_share
from datagen.rendering.transport.integrator import PathTracer
from datagen.rendering.view_job import RenderedView
from oracles.rendering_scenes import SmallScene, quad, renderer

WIDTH, HEIGHT = 96, 64
WALL_M = 3.0  # distance of the window from the camera
PIXEL_M = WALL_M / WIDTH
COLUMNS, ROWS = (38, 57), (20, 33)  # half-open pixel ranges of the window
BAR_COLUMNS, BAR_ROWS = (42, 46, 52), (24, 29)


@dataclass
class Window:
    """A view through a window with bars, its noisy image and two independent references."""

    view: RenderedView
    noisy: NDArray[np.float32]
    truth: tuple[NDArray[np.float32], NDArray[np.float32]]

    def of_bars(self, image: NDArray) -> NDArray[np.float64]:
        """Return the exposed luminance (N,) of the pixels of the bars, except their ends."""
        scale = exposure_for(0.5 * (self.truth[0] + self.truth[1]))
        window = np.zeros(image.shape[:2], bool)
        for column in BAR_COLUMNS:
            window[ROWS[0] + 1 : ROWS[1] - 1, column] = True
        for row in BAR_ROWS:
            window[row, COLUMNS[0] + 1 : COLUMNS[1] - 1] = True
        return scale * luminance(image[window].astype(np.float64))


def behind_bars() -> SmallScene:
    """Return a wall with a barred window and a board behind it, all of one material and orientation, so that
    neither albedo nor normal separates a bar from the board."""

    def x(column: float) -> float:
        return (column - WIDTH / 2) * PIXEL_M

    def z(row: float) -> float:
        return (HEIGHT / 2 - row) * PIXEL_M

    def front(left: float, right: float, top: float, bottom: float) -> tuple:
        return quad([right, WALL_M, bottom], [left - right, 0, 0], [0, 0, top - bottom]), "grey"

    parts = {
        "board": (quad([3, 5, -1.5], [-6, 0, 0], [0, 0, 3]), "grey"),
        "left": front(-2, x(COLUMNS[0]), 1.5, -1.5),
        "right": front(x(COLUMNS[1]), 2, 1.5, -1.5),
        "above": front(x(COLUMNS[0]), x(COLUMNS[1]), 1.5, z(ROWS[0])),
        "below": front(x(COLUMNS[0]), x(COLUMNS[1]), z(ROWS[1]), -1.5),
        "floor": (quad([-2, -1, -1.5], [4, 0, 0], [0, 4, 0]), "grey"),
    }
    for column in BAR_COLUMNS:
        parts[f"bar_{column}"] = front(x(column), x(column + 1), z(ROWS[0]), z(ROWS[1]))
    for row in BAR_ROWS:
        parts[f"rail_{row}"] = front(x(COLUMNS[0]), x(COLUMNS[1]), z(row), z(row + 1))
    return SmallScene(
        parts, {"grey": SlotMaterial(diffuse_albedo=(0.4,) * 3, specular_albedo=(0.0,) * 3, roughness=1.0)}
    )


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> Window:
    lights = (
        AreaLight(
            name="sun", origin_m=(-1, 4, 1.5), edge_u_m=(0, 0.5, 0), edge_v_m=(2, 0, 0), radiance=(200.0,) * 3
        ),
        AreaLight(
            name="lamp", origin_m=(-1, -0.5, 0.2), edge_u_m=(0, 0, 1), edge_v_m=(2, 0, 0), radiance=(2.0,) * 3
        ),
    )
    camera = Camera(WIDTH, HEIGHT, WIDTH, WIDTH, WIDTH / 2, HEIGHT / 2, look_at([0, 0, 0], [0, 1, 0]))
    recipe = parse_model(RenderRecipe, {"quality": "standard", "keep_noisy": True}, "recipe.yaml")
    room = renderer(tmp_path_factory.mktemp("bars"), behind_bars(), [camera], recipe, lights=lights)
    view = room.render_view(0)
    plain, sensor = PathTracer(room.built, room.materials, 65, 5), room.sensor(camera)
    truth = tuple(plain.render(sensor, 1024, seed) for seed in (101, 102))
    room.close()
    return Window(view, view.buffers["beauty_noisy"], (truth[0], truth[1]))


def test_bars_keep_their_values(window: Window) -> None:
    """The panes exceed 20 times white; denoising alone would double the brightness of the bars."""
    truth = 0.5 * (window.truth[0] + window.truth[1])
    assert exposure_for(truth) * truth.max() > 20
    ratios = window.of_bars(window.view.buffers["beauty"]) / window.of_bars(truth)
    assert np.median(ratios) == pytest.approx(1.0, abs=0.15)
    assert np.percentile(ratios, 90) < 1.6 and np.percentile(ratios, 10) > 0.6


def test_recorded_error_of_bars_is_the_true_error(window: Window) -> None:
    """The recorded error is exact to a factor of 2; without the noise of undenoised pixels it is too low."""
    recorded = window.view.render.estimated_rel_mse
    true = relative_mse(window.view.buffers["beauty"], *window.truth, exposed=True)
    assert recorded is not None and 0.5 * true < recorded < 2.0 * true


SHAPE = (48, 64, 3)


def halves_of(truth: NDArray, noise: float, seed: int = 1) -> tuple[NDArray, NDArray]:
    rng = np.random.default_rng(seed)
    return truth * (1 + rng.normal(0, noise, SHAPE)), truth * (1 + rng.normal(0, noise, SHAPE))


def test_only_noisy_pixels_beside_bright_ones_are_kept() -> None:
    truth = np.full(SHAPE, 0.5)
    truth[20:28, 30:34], truth[20:28, 32] = 40.0, 0.3
    halves, black = halves_of(truth, 0.15), np.zeros(SHAPE)
    bled = truth.copy()
    bled[20:28, 32] = 1.2
    share = noisy_share(halves, bled, black)[..., 0]
    assert share.shape == SHAPE[:2] and share[20:28, 32].mean() > 0.7
    elsewhere = share.copy()
    elsewhere[20:28, 32] = 0.0
    assert elsewhere[20:28, 30:34].mean() < 0.2 and not share[:, :25].any()
    assert noisy_share(halves, truth, black)[20:28, 32].mean() < 0.2  # a correct bar is unchanged
    dim = truth.copy()
    dim[20:28, 30:34], dim[20:28, 32] = 1.8, 0.3  # panes little brighter than white hardly bleed
    wrong = dim.copy()
    wrong[20:28, 32] = 1.2
    assert not noisy_share(halves_of(dim, 0.15), wrong, black).any()


def test_fireflies_of_one_half_are_not_kept() -> None:
    truth = np.full(SHAPE, 0.5)
    a, b = halves_of(truth, 0.15)
    a[10:40:6, 10:50:6] = 60.0
    assert not noisy_share((a, b), truth, np.zeros(SHAPE)).any()


def test_shares_blend_and_none_changes_nothing() -> None:
    clean, noisy = np.ones(SHAPE, np.float32), np.full(SHAPE, 3.0, np.float32)
    share = np.zeros((*SHAPE[:2], 1), np.float32)
    assert blended(clean, noisy, share) is clean
    share[3, 4] = 0.25
    mixed = blended(clean, noisy, share)
    assert mixed[3, 4] == pytest.approx([1.5] * 3) and mixed.sum() == pytest.approx(clean.sum() + 1.5)
