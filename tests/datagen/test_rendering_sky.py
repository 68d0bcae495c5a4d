# SPDX-License-Identifier: MIT
"""The guide to where the sky shines in: a density that is one, no bias, less noise, and none without need."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.formats.asset import SlotMaterial
from datagen.formats.lights import AreaLight, EnvironmentLight, SkyLight
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.rendering.renderer import SceneRenderer
from tests.datagen.rendering_scenes import GREY, SmallScene, quad, renderer

pytestmark = pytest.mark.usefixtures("mitsuba_variant")

RECIPE = RenderRecipe(path_samples=4, auxiliary_samples=4, denoise=False)
CAMERAS = [Camera(24, 16, 16, 16, 12, 8, look_at([x, -1.8, 1.2], [0.3, 1.0, 0.6])) for x in (-1.0, 1.0)]
SKY = EnvironmentLight(name="sky", radiance=(3.0, 3.2, 3.6))
# the sun stands behind the house: what comes in is sky
DAYLIGHT = SkyLight(
    name="daylight", sun_direction=(0.2, -0.7, 0.5), turbidity=3.0, sky_scale=20, sun_scale=10
)
LAMP = AreaLight(
    name="lamp", origin_m=(-1, -1, 1.95), edge_u_m=(0, 2, 0), edge_v_m=(2, 0, 0), radiance=(300, 300, 300)
)


def walled_room(*, window: bool = True, curtain: bool = False) -> SmallScene:
    """4 x 4 x 2 m, closed but for a window of 0.6 x 0.8 m in the wall at y = 2."""
    parts: dict[str, Any] = {
        "floor": (quad([-2, -2, 0], [4, 0, 0], [0, 4, 0]), "grey"),
        "ceiling": (quad([-2, 2, 2], [4, 0, 0], [0, -4, 0]), "grey"),
        "left": (quad([-2, -2, 0], [0, 4, 0], [0, 0, 2]), "grey"),
        "right": (quad([2, 2, 0], [0, -4, 0], [0, 0, 2]), "grey"),
        "front": (quad([2, -2, 0], [-4, 0, 0], [0, 0, 2]), "grey"),
        "beside": (quad([-2, 2, 0], [2.4, 0, 0], [0, 0, 2]), "grey"),
        "other_side": (quad([1, 2, 0], [1, 0, 0], [0, 0, 2]), "grey"),
        "below": (quad([0.4, 2, 0], [0.6, 0, 0], [0, 0, 0.8]), "grey"),
        "above": (quad([0.4, 2, 1.6], [0.6, 0, 0], [0, 0, 0.4]), "grey"),
    }
    slots = {"grey": GREY}
    if not window:
        parts["shutter"] = (quad([0.4, 2, 0.8], [0.6, 0, 0], [0, 0, 0.8]), "grey")
    if curtain:
        parts["curtain"] = (quad([0.4, 1.95, 0.8], [0.6, 0, 0], [0, 0, 0.8]), "sheer")
        slots["sheer"] = SlotMaterial(diffuse_albedo=(0.7, 0.7, 0.7), opacity=0.4)
    return SmallScene(parts, slots)


def rendered(folder: Path, scene: SmallScene, *lights: Any, recipe: RenderRecipe = RECIPE) -> SceneRenderer:
    return renderer(folder, scene, CAMERAS, recipe, lights=lights)


def images(room: SceneRenderer, samples: int, count: int, *, guided: bool) -> NDArray[np.float64]:
    """Independent images (count, H, W, 3) of the first view, with or without the guide."""
    tracer, guide = room._tracer, room._tracer.sky_guide
    assert guide is not None
    tracer.guide_by(guide if guided else None)
    sensor = room._sensor(CAMERAS[0])
    found = [tracer.render(sensor, samples, 50 + seed, with_seen_lights=False) for seed in range(count)]
    tracer.guide_by(guide)
    return np.stack(found).astype(np.float64)


@pytest.mark.parametrize("case", ["constant", "sky", "curtain"])
def test_the_guide_takes_noise_away_and_no_light(tmp_path: Path, case: str) -> None:
    light = DAYLIGHT if case == "sky" else SKY
    room = rendered(tmp_path, walled_room(curtain=case == "curtain"), light)
    guided = images(room, 256, 8, guided=True)
    plain = images(room, 256, 8, guided=False)
    means = [sample.mean(axis=(1, 2, 3)) for sample in (guided, plain)]
    error = np.sqrt(sum(mean.var(ddof=1) / len(mean) for mean in means))
    assert abs(means[0].mean() - means[1].mean()) < 4 * error
    assert error < 0.02 * means[1].mean()  # the comparison tells something
    variance = [np.median(sample.var(axis=0, ddof=1).mean(axis=-1)) for sample in (guided, plain)]
    assert variance[0] < 0.35 * variance[1]


def test_the_density_is_that_of_the_samples(tmp_path: Path) -> None:
    import drjit as dr
    import mitsuba as mi

    guide = rendered(tmp_path, walled_room(), SKY)._tracer.sky_guide
    assert guide is not None
    count = 1 << 20
    sampler: Any = mi.load_dict({"type": "independent"})
    sampler.seed(5, count)
    for place in ([0.0, 0.0, 1.0], [-1.99, -1.99, 0.01], [0.7, 1.9, 1.2]):
        point = mi.Point3f(place) + dr.zeros(mi.Point3f, count)
        direction = guide.sample(point, sampler.next_1d(), sampler.next_2d())
        pdf = np.array(guide.pdf(point, direction))
        assert (pdf > 0.0).mean() > 0.9999  # but where rounding takes a direction to the cell beside
        # f(w) = 1 / (0.2 + |w - a|^2) has most of its weight where openings are, from all three places
        target = dr.normalize(mi.Vector3f(0.3, 1.0, 0.0))
        by_guide = np.array(1.0 / (0.2 + dr.squared_norm(direction - target))).astype(np.float64)
        sphere: Any = mi.warp.square_to_uniform_sphere(sampler.next_2d())
        density = np.array(guide.pdf(point, sphere)).astype(np.float64)
        value = np.array(1.0 / (0.2 + dr.squared_norm(sphere - target))).astype(np.float64)
        integral = 4.0 * np.pi * density
        assert abs(integral.mean() - 1.0) < 5 * integral.std() / np.sqrt(count)
        expected = (integral * value).mean()
        error = np.hypot((integral * value).std(), by_guide.std()) / np.sqrt(count)
        assert abs(by_guide.mean() - expected) < 5 * error


def test_directions_lead_to_the_window(tmp_path: Path) -> None:
    import drjit as dr
    import mitsuba as mi

    guide = rendered(tmp_path, walled_room(), SKY)._tracer.sky_guide
    assert guide is not None and guide.share == 0.5
    count = 4096
    sampler: Any = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    point = mi.Point3f(-1.0, 0.0, 1.0) + dr.zeros(mi.Point3f, count)
    direction = np.array(guide.sample(point, sampler.next_1d(), sampler.next_2d())).T
    at_wall = np.array([-1.0, 0.0, 1.0]) + direction * (2.0 / direction[:, 1:2])
    x, z = at_wall[:, 0], at_wall[:, 2]
    assert ((x > 0.4) & (x < 1.0) & (z > 0.8) & (z < 1.6) & (direction[:, 1] > 0)).mean() > 0.6


def test_points_outside_of_the_box_are_left_to_the_lights_own_sampling(tmp_path: Path) -> None:
    import mitsuba as mi

    lights = rendered(tmp_path, walled_room(), SKY)._tracer.lights
    assert lights is not None and lights.guide is not None
    direction, own, first = mi.Vector3f(0.0, 1.0, 0.0), mi.Float(0.25), mi.UInt32(0)
    outside, inside = mi.Point3f(0.7, 9.0, 1.2), mi.Point3f(0.7, 1.0, 1.2)
    assert [np.array(lights.guide.contains(point))[0] for point in (outside, inside)] == [False, True]
    assert np.array(lights.pdf(outside, direction, own, first, first)).tolist() == [0.25]
    density = np.array(lights.pdf(inside, direction, own, first, first))
    assert np.isfinite(density).all() and density[0] > 0.25


@pytest.mark.parametrize("case", ["no environment", "sealed", "lamp outshines it", "nothing but sky"])
def test_no_guide_where_it_would_not_pay(tmp_path: Path, case: str) -> None:
    lights: tuple[Any, ...] = {"no environment": (LAMP,), "lamp outshines it": (LAMP, SKY)}.get(case, (SKY,))
    scene = walled_room(window=case != "sealed")
    if case == "nothing but sky":  # a floor under an open sky: cameras and points have no box around them
        scene = SmallScene({"floor": (quad([-2, -2, 0], [0.1, 0, 0], [0, 0.1, 0]), "grey")}, {"grey": GREY})
    room = rendered(tmp_path, scene, *lights)
    assert room._tracer.sky_guide is None
    assert np.isfinite(room.render_view(0).buffers["beauty"]).all()


def test_the_guide_is_the_same_each_time(tmp_path: Path) -> None:
    first, second = (rendered(tmp_path / name, walled_room(), SKY)._tracer.sky_guide for name in "ab")
    assert first is not None and second is not None
    for one, other in zip(first.arrays(), second.arrays(), strict=True):
        assert np.array_equal(np.array(one), np.array(other))
