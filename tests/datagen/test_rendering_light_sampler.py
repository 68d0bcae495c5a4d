# SPDX-License-Identifier: MIT
"""The light sampler: table slots, the warp of a random number, per-cell probabilities, unbiased images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.formats.lights import PointLight
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.rendering.renderer import SceneRenderer
from oracles.rendering_scenes import SmallScene, quad, renderer
from tests.datagen.test_rendering_sky_guide import CAMERAS, DAYLIGHT, LAMP, SKY, walled_room

pytestmark = pytest.mark.usefixtures("mitsuba_variant")

RECIPE = RenderRecipe(path_samples=4, auxiliary_samples=4, denoise=False, max_depth=8, irradiance_cache=True)
SIDES = (-1.0, 1.0)
DIM = LAMP.model_copy(update={"radiance": (0.3, 0.3, 0.3)})
"""A lamp so dim that a quarter of the light is sky light, for which a guide is built."""


def two_chambers(tmp_path: Path) -> SceneRenderer:
    """Return a renderer of two chambers with a camera each, one with a bright lamp and one with a dim one."""
    parts = {
        "floor": (quad([-2, -2, 0], [4, 0, 0], [0, 4, 0]), "grey"),
        "ceiling": (quad([-2, 2, 2], [4, 0, 0], [0, -4, 0]), "grey"),
        "left": (quad([-2, -2, 0], [0, 4, 0], [0, 0, 2]), "grey"),
        "wall_left": (quad([-0.1, 2, 0], [0, -4, 0], [0, 0, 2]), "grey"),
        "wall_right": (quad([0.1, -2, 0], [0, 4, 0], [0, 0, 2]), "grey"),
        "right": (quad([2, 2, 0], [0, -4, 0], [0, 0, 2]), "grey"),
        "front": (quad([2, -2, 0], [-4, 0, 0], [0, 0, 2]), "grey"),
        "back": (quad([-2, 2, 0], [4, 0, 0], [0, 0, 2]), "grey"),
    }
    lamps = tuple(
        PointLight(name=f"lamp {k}", position_m=(x, 0.0, 1.5), intensity=(power,) * 3)
        for k, (x, power) in enumerate(zip(SIDES, (50.0, 0.5), strict=True))
    )
    cameras = [Camera(24, 16, 12, 12, 12, 8, look_at([x, -1.5, 1.2], [x, 1.0, 0.6])) for x in SIDES]
    return renderer(tmp_path, SmallScene(parts), cameras, RECIPE, lights=lamps)


def spread(
    room: SceneRenderer, view: int, count: int = 8, samples: int = 64, limit: float = np.inf
) -> NDArray[np.float64]:
    """Return independent images (count, H, W, 3) of one view; ``limit`` is the clamp of indirect light."""
    sensor = room.sensor(room.configuration.cameras[view].camera())
    images = [room.tracer.accumulate(sensor, samples, 50 + k, limit=limit).mean() for k in range(count)]
    return np.stack(images).astype(np.float64)


def with_uniform_choice(room: SceneRenderer) -> None:
    """Replace per-cell probabilities by uniform ones, but keep the irradiance cache."""
    from datagen.rendering.transport.light_sampler import LightSampler

    tracer = room.tracer
    assert tracer.emitters.light_sampler is not None and tracer.irradiance is not None
    shape = (tracer.irradiance.num_records + 1, tracer.emitters.light_sampler.num_techniques)
    tracer.emitters.light_sampler = LightSampler(tracer.scene, tracer.sky_guide, np.ones(shape))
    tracer.forget_recordings()


def test_slots_follow_shares_and_none_is_zero() -> None:
    from datagen.rendering.transport.light_sampler import SLOTS, whole_slots

    shares = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1e-300, 1e-300, 2e-300], [1e30, 3e30, 0.0]])
    slots = whole_slots(shares)
    assert (slots.sum(axis=1) == SLOTS).all() and slots.min() == 1
    assert slots[0].tolist() == [SLOTS - 2, 1, 1]
    assert np.ptp(slots[1]) <= 1
    assert slots[2, 2] > 1.8 * slots[2, 0] and slots[3, 1] > 2.8 * slots[3, 0]
    many = whole_slots(np.random.default_rng(3).random((1000, 5)) ** 8)
    assert (many.sum(axis=1) == SLOTS).all() and many.min() == 1


def test_a_number_is_warped_into_a_technique_and_a_number(tmp_path: Path) -> None:
    import mitsuba as mi

    lights = two_chambers(tmp_path).tracer.emitters.light_sampler
    assert lights is not None and lights.num_techniques == 2
    count = 1 << 16
    numbers = mi.Float((np.arange(count, dtype=np.float32) + 0.5) / count)
    for place in (0, 1, 7):
        technique, rest = (np.array(found) for found in lights.choose(mi.UInt32(place), numbers))
        assert rest.min() >= 0.0 and rest.max() < 1.0
        for k in (0, 1):
            probability = np.array(lights.probability(mi.UInt32(place), mi.UInt32(k)))[0]
            assert (technique == k).mean() == pytest.approx(probability, abs=2 / count)
            histogram = np.histogram(rest[technique == k], 8, (0, 1))[0] / count
            assert histogram == pytest.approx([probability / 8] * 8, abs=4 / count)


def test_cells_choose_visible_lights(tmp_path: Path) -> None:
    """Cells mostly sample the lamp of their chamber, even if the hidden lamp is 100 times as bright."""
    import mitsuba as mi

    room = two_chambers(tmp_path)
    tracer = room.tracer
    assert tracer.emitters.light_sampler is not None and tracer.irradiance is not None
    x = np.repeat(SIDES, 200) + np.tile(np.linspace(-0.8, 0.8, 200), 2)
    point = mi.Point3f(x, np.zeros(400), np.zeros(400))
    place = tracer.irradiance.record(point, mi.Vector3f(0, 0, 1), mi.Bool(True))
    assert (np.array(place) > 0).mean() > 0.95
    own = np.array(tracer.emitters.light_sampler.probability(place, mi.UInt32(np.repeat([0, 1], 200))))
    assert np.median(own) > 0.95 and (own > 0.5).mean() > 0.9


def test_noise_behind_a_wall_falls_without_bias(tmp_path: Path) -> None:
    room = two_chambers(tmp_path)
    # One sample per image, because several would be stratified over the lights and show no difference.
    learned = spread(room, 1, 64, 1, limit=1e-20)
    with_uniform_choice(room)
    uniform = spread(room, 1, 64, 1, limit=1e-20)
    assert learned.mean() == pytest.approx(uniform.mean(), rel=0.01)
    variances = [images.var(axis=0, ddof=1).mean() for images in (learned, uniform)]
    assert variances[0] < 0.25 * variances[1]


def test_light_is_attributed_to_its_technique(tmp_path: Path) -> None:
    """Lamp light is attributed to the lamp, sky light to its opening, the sun to the environment emitter."""
    import drjit as dr
    import mitsuba as mi

    tracer = renderer(tmp_path, walled_room(), CAMERAS, RECIPE, lights=(DIM, DAYLIGHT)).tracer
    lights, scene = tracer.emitters.light_sampler, tracer.scene
    assert lights is not None and lights.guide is not None
    point, direction = mi.Point3f(0.0, 0.0, 1.0), mi.Vector3f(0.3, 1.0, 0.0)
    opening = lights.num_emitters + int(np.array(lights.guide.pdf(point, direction)[0])[0])
    brightest = float(lights.guide.brightest[0])
    for number, emitter in enumerate(scene.emitters()):
        ds = dr.zeros(mi.DirectionSample3f, 2)
        ds.emitter, ds.d = mi.EmitterPtr(emitter), direction
        brought = mi.Float([0.9 * brightest, 1.1 * brightest])
        found = np.broadcast_to(np.array(lights.technique(point, ds, brought)), 2).tolist()
        assert found == ([opening, number] if emitter.is_environment() else [number, number])
        assert int(np.array(lights.index(mi.EmitterPtr(emitter)))[0]) == number
    tracer.use_sky_guide(None)
    assert tracer.emitters.light_sampler is not None and tracer.emitters.light_sampler.guide is None
    for number, emitter in enumerate(scene.emitters()):
        ds = dr.zeros(mi.DirectionSample3f)
        ds.emitter = mi.EmitterPtr(emitter)
        assert int(np.array(tracer.emitters.light_sampler.technique(point, ds, mi.Float(0.0)))[0]) == number


def test_an_unfitted_sampler_is_uniform_except_for_the_guide() -> None:
    import mitsuba as mi

    from datagen.rendering.transport.light_sampler import MAX_TECHNIQUES, SLOTS, uniform_sampler

    def lamps(number: int) -> Any:
        bulb = {"type": "point", "position": [0.0, 0.0, 1.0]}
        return mi.load_dict({"type": "scene"} | {f"bulb {k}": bulb for k in range(number)})

    assert uniform_sampler(lamps(0), None) is None and uniform_sampler(lamps(1), None) is None
    assert uniform_sampler(lamps(MAX_TECHNIQUES + 1), None) is None
    for number in (2, 5, 20, MAX_TECHNIQUES):
        choice = uniform_sampler(lamps(number), None)
        assert choice is not None and choice.num_techniques == choice.num_emitters == number
        chances = np.array(choice.probabilities)
        assert chances.sum() == pytest.approx(1.0) and np.ptp(chances) <= 1 / max(SLOTS, 2 * number)


def test_a_guide_keeps_its_share_of_a_uniform_choice(tmp_path: Path) -> None:
    from datagen.rendering.transport.light_sampler import uniform_sampler

    tracer = renderer(tmp_path, walled_room(), CAMERAS, RECIPE, lights=(DIM, DAYLIGHT)).tracer
    guide = tracer.sky_guide
    assert guide is not None and 0.1 < guide.shares.sum() < 0.5
    choice = uniform_sampler(tracer.scene, guide)
    assert choice is not None
    chances = np.array(choice.probabilities)
    lights, guided = chances[: choice.num_emitters].tolist(), float(chances[choice.num_emitters :].sum())
    assert guided == pytest.approx(guide.shares.sum(), abs=len(guide.shares) / choice.num_slots)
    assert lights == pytest.approx([(1 - guided) / len(lights)] * len(lights), abs=1 / choice.num_slots)


@pytest.mark.parametrize("lights", [(LAMP, DAYLIGHT), (DAYLIGHT,)], ids=["lamp and daylight", "daylight"])
def test_the_choice_of_lights_is_unbiased(tmp_path: Path, lights: Any) -> None:
    """Per-cell and uniform probabilities give the same mean for an area light, the sun and the guided sky."""
    room = renderer(tmp_path, walled_room(), CAMERAS, RECIPE, lights=lights)
    assert room.tracer.sky_guide is not None or len(lights) == 2
    learned = spread(room, 0, 16, 128)
    with_uniform_choice(room)
    uniform = spread(room, 0, 16, 128)
    means = [sample.mean(axis=(1, 2, 3)) for sample in (learned, uniform)]
    error = np.sqrt(sum(mean.var(ddof=1) / len(mean) for mean in means))
    assert abs(means[0].mean() - means[1].mean()) < 4 * error
    assert error < 0.01 * means[1].mean()  # the test is sensitive


def test_many_lights_are_chosen_uniformly(tmp_path: Path) -> None:
    """With too many lights for per-cell probabilities, the guide to the window keeps its share."""
    from datagen.rendering.transport.light_sampler import MAX_LEARNED
    from datagen.rendering.transport.sky_guide import OPENINGS

    bulbs = tuple(
        PointLight(name=f"bulb {k}", position_m=(0.1 * k - 1.0, 0.0, 1.5), intensity=(1e-3, 1e-3, 1e-3))
        for k in range(MAX_LEARNED + 4)
    )
    room = renderer(tmp_path, walled_room(), CAMERAS, RECIPE, lights=(*bulbs, SKY))
    tracer = room.tracer
    lights = tracer.emitters.light_sampler
    assert tracer.sky_guide is not None and tracer.irradiance is not None and lights is not None
    assert lights.num_records == 1 and lights.num_techniques == len(bulbs) + 1 + OPENINGS
    guided = spread(room, 0)
    tracer.use_sky_guide(None)
    plain = spread(room, 0)
    means = [sample.mean(axis=(1, 2, 3)) for sample in (guided, plain)]
    error = np.sqrt(sum(mean.var(ddof=1) / len(mean) for mean in means))
    assert abs(means[0].mean() - means[1].mean()) < 0.03 * means[1].mean() + 4 * error
    assert error < 0.03 * means[1].mean()
