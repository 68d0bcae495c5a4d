# SPDX-License-Identifier: MIT
"""The sky guide: its density is normalised, it is unbiased, reduces noise, and is absent where not needed."""

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
from datagen.rendering.transport.sky_guide import OPENINGS
from oracles.rendering_scenes import GREY, SmallScene, quad, renderer

pytestmark = pytest.mark.usefixtures("mitsuba_variant")

RECIPE = RenderRecipe(path_samples=4, auxiliary_samples=4, denoise=False)
CAMERAS = [Camera(24, 16, 16, 16, 12, 8, look_at([x, -1.8, 1.2], [0.3, 1.0, 0.6])) for x in (-1.0, 1.0)]
SKY = EnvironmentLight(name="sky", radiance=(3.0, 3.2, 3.6))
# the sun is behind the house, so only sky light enters
DAYLIGHT = SkyLight(
    name="daylight", sun_direction=(0.2, -0.7, 0.5), turbidity=3.0, sky_scale=20, sun_scale=10
)
LAMP = AreaLight(
    name="lamp", origin_m=(-1, -1, 1.95), edge_u_m=(0, 2, 0), edge_v_m=(2, 0, 0), radiance=(300, 300, 300)
)


def walled_room(*, window: bool = True, curtain: bool = False) -> SmallScene:
    """Return a room of 4 x 4 x 2 m, closed except for a window of 0.6 x 0.8 m in the wall at y = 2."""
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
    """Return independent images (count, H, W, 3) of the first view, with or without the guide."""
    tracer, guide = room.tracer, room.tracer.sky_guide
    assert guide is not None
    tracer.use_sky_guide(guide if guided else None)
    sensor = room.sensor(CAMERAS[0])
    found = [tracer.render(sensor, samples, 50 + seed, with_visible_emission=False) for seed in range(count)]
    tracer.use_sky_guide(guide)
    return np.stack(found).astype(np.float64)


@pytest.mark.parametrize("case", ["constant", "sky", "curtain"])
def test_the_guide_reduces_noise_without_bias(tmp_path: Path, case: str) -> None:
    light = DAYLIGHT if case == "sky" else SKY
    room = rendered(tmp_path, walled_room(curtain=case == "curtain"), light)
    guided = images(room, 256, 8, guided=True)
    plain = images(room, 256, 8, guided=False)
    means = [sample.mean(axis=(1, 2, 3)) for sample in (guided, plain)]
    error = np.sqrt(sum(mean.var(ddof=1) / len(mean) for mean in means))
    assert abs(means[0].mean() - means[1].mean()) < 4 * error
    assert error < 0.02 * means[1].mean()  # the test is sensitive
    variance = [np.median(sample.var(axis=0, ddof=1).mean(axis=-1)) for sample in (guided, plain)]
    assert variance[0] < 0.35 * variance[1]


def test_the_density_matches_the_samples(tmp_path: Path) -> None:
    import drjit as dr
    import mitsuba as mi

    guide = rendered(tmp_path, walled_room(), SKY).tracer.sky_guide
    assert guide is not None
    count, num_openings = 1 << 20, len(guide.shares)
    assert num_openings == OPENINGS
    sampler: Any = mi.load_dict({"type": "independent"})
    sampler.seed(5, count)
    for place in ([0.0, 0.0, 1.0], [-1.99, -1.99, 0.01], [0.7, 1.9, 1.2]):
        point = mi.Point3f(place) + dr.zeros(mi.Point3f, count)
        opening: Any = dr.arange(mi.UInt32, count) % num_openings
        direction = guide.sample(point, opening, sampler.next_1d(), sampler.next_2d())
        found, pdf = guide.pdf(point, direction)
        # except where rounding moves a direction to the next cell
        assert (np.array(pdf) > 0.0).mean() > 0.9999 and np.array(found == opening).mean() > 0.9999
        # from all three points, most of the integral of f(w) = 1 / (0.2 + |w - a|^2) is within the openings
        target = dr.normalize(mi.Vector3f(0.3, 1.0, 0.0))
        by_guide = np.array(1.0 / (0.2 + dr.squared_norm(direction - target))).astype(np.float64)
        sphere: Any = mi.warp.square_to_uniform_sphere(sampler.next_2d())
        density = np.array(guide.pdf(point, sphere)[1]).astype(np.float64) / num_openings
        value = np.array(1.0 / (0.2 + dr.squared_norm(sphere - target))).astype(np.float64)
        integral = 4.0 * np.pi * density
        assert abs(integral.mean() - 1.0) < 5 * integral.std() / np.sqrt(count)
        expected = (integral * value).mean()
        error = np.hypot((integral * value).std(), by_guide.std()) / np.sqrt(count)
        assert abs(by_guide.mean() - expected) < 5 * error


def test_directions_point_to_the_window(tmp_path: Path) -> None:
    import drjit as dr
    import mitsuba as mi

    guide = rendered(tmp_path, walled_room(), SKY).tracer.sky_guide
    assert guide is not None and guide.shares.sum() == pytest.approx(0.5)
    count = 4096
    sampler: Any = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    point = mi.Point3f(-1.0, 0.0, 1.0) + dr.zeros(mi.Point3f, count)
    opening: Any = dr.arange(mi.UInt32, count) % len(guide.shares)
    direction = np.array(guide.sample(point, opening, sampler.next_1d(), sampler.next_2d())).T
    at_wall = np.array([-1.0, 0.0, 1.0]) + direction * (2.0 / direction[:, 1:2])
    x, z = at_wall[:, 0], at_wall[:, 2]
    assert ((x > 0.4) & (x < 1.0) & (z > 0.8) & (z < 1.6) & (direction[:, 1] > 0)).mean() > 0.6


def test_points_outside_of_the_box_use_emitter_sampling(tmp_path: Path) -> None:
    import mitsuba as mi

    lights = rendered(tmp_path, walled_room(), SKY).tracer.emitters.light_sampler
    assert lights is not None and lights.guide is not None
    direction, own, first = mi.Vector3f(0.0, 1.0, 0.0), mi.Float(0.25), mi.UInt32(0)
    outside, inside = mi.Point3f(0.7, 9.0, 1.2), mi.Point3f(0.7, 1.0, 1.2)
    assert [np.array(lights.guide.contains(point))[0] for point in (outside, inside)] == [False, True]
    assert np.array(lights.pdf(outside, direction, own, first, first)).tolist() == [0.25]
    density = np.array(lights.pdf(inside, direction, own, first, first))
    assert np.isfinite(density).all() and density[0] > 0.25


@pytest.mark.parametrize("case", ["no environment", "sealed", "lamp outshines it", "nothing but sky"])
def test_no_guide_without_an_enclosing_room(tmp_path: Path, case: str) -> None:
    lights: tuple[Any, ...] = {"no environment": (LAMP,), "lamp outshines it": (LAMP, SKY)}.get(case, (SKY,))
    scene = walled_room(window=case != "sealed")
    if case == "nothing but sky":  # a small floor under an open sky encloses no camera
        scene = SmallScene({"floor": (quad([-2, -2, 0], [0.1, 0, 0], [0, 0.1, 0]), "grey")}, {"grey": GREY})
    room = rendered(tmp_path, scene, *lights)
    assert room.tracer.sky_guide is None
    assert np.isfinite(room.render_view(0).buffers["beauty"]).all()


def test_the_guide_is_the_same_each_time(tmp_path: Path) -> None:
    first, second = (rendered(tmp_path / name, walled_room(), SKY).tracer.sky_guide for name in "ab")
    assert first is not None and second is not None
    for one, other in zip(first.arrays(), second.arrays(), strict=True):
        assert np.array_equal(np.array(one), np.array(other))


# ---- guides fitted to synthetic observations ---------------------------------------------------------------


def observed(count: int = 4096, **more: Any) -> Any:
    """Return observations of a room of 4 x 2 x 1 m with ``count`` points and a quarter as many rays.
    The rays start 0.2 to 0.4 m above the floor and leave through one point of the ceiling."""
    from datagen.rendering.transport.sky_observation import SkyObservations

    points = np.random.default_rng(1).random((count, 3)) * [4, 2, 1]
    through = np.array([3.1, 0.4, 1.0])
    origins = points[::4] * [1, 1, 0.2] + [0, 0, 0.2]
    fields = {
        "points_m": points,
        "origins_m": origins,
        "directions": (through - origins) / np.linalg.norm(through - origins, axis=1, keepdims=True),
        "radiance": np.ones(len(origins)),
        "environment": 0.0,
        "others": 0.0,
    }
    return SkyObservations(**{**fields, **more})


def open_sky() -> Any:
    import mitsuba as mi

    return mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "ball": {"type": "sphere"}})


def test_the_share_of_the_sky_is_relative_to_all_direct_light() -> None:
    """A quarter of the cosine-distributed rays hit sky of radiance 1, so its irradiance is pi / 4."""
    quarter = np.pi / 4
    assert observed().sky_share() == 1.0
    assert observed(others=quarter).sky_share() == pytest.approx(0.5)
    assert observed(environment=quarter / 2, others=quarter).sky_share() == pytest.approx(0.5)
    # emitter sampling includes the sun, which is direct light but not sky
    assert observed(environment=3 * quarter, others=quarter).sky_share() == pytest.approx(0.25)
    assert observed(radiance=np.zeros(1024)).sky_share() == 0.0
    assert observed(radiance=np.zeros(0), others=1.0).sky_share() == 0.0


def test_rays_that_met_the_sun_count_as_sky() -> None:
    radiance = np.ones(1024)
    radiance[::300] = 1e6
    calm = observed(radiance=radiance, others=np.pi / 4)
    assert calm.clamped_radiance().max() == pytest.approx(1.0) and calm.sky_share() == pytest.approx(0.5)
    radiance[::100] = 1e6  # too frequent for the sun
    assert observed(radiance=radiance).clamped_radiance().max() > 1e5


def test_a_guide_covers_the_opening_and_a_margin() -> None:
    import mitsuba as mi

    from datagen.rendering.transport.room_box import CELLS, MARGIN
    from datagen.rendering.transport.sky_guide import NEIGHBOUR_SHARE, fit_sky_guide

    found = fit_sky_guide(open_sky(), observed(others=3 * np.pi / 4))
    assert found is not None and found.shares.sum() == pytest.approx(0.25)
    low, high = np.percentile(observed().points_m, [2, 98], axis=0)
    margin = MARGIN * np.ptp(np.percentile(observed().points_m[:, 0], [10, 90]))  # of the longest side
    *others, top = found.box_m.ravel()
    np.testing.assert_allclose(others, [*(low - margin), *(high + margin)[:2]], rtol=1e-6)
    assert (
        1.0 < top < 1.0 + margin
    )  # near the plane of the opening, instead of at a margin from the points as the other faces
    side = found.box_m[1] - found.box_m[0]
    areas = np.repeat([side[1] * side[2], side[0] * side[2], side[0] * side[1]], 2) / CELLS**2
    opening = np.array(found.opening_of_cell).reshape(6, CELLS, CELLS)
    shares = found.shares / found.shares.sum()
    chance = shares[opening] * np.array(found.density).reshape(6, CELLS, CELLS) * areas[:, None, None]
    assert len(shares) == OPENINGS and shares.min() > 0.01
    assert chance.sum() == pytest.approx(1.0, abs=1e-3)
    # the rays meet just below the box's upper face, so they leave it through few cells
    column, row = (int(c) for c in (np.array([3.1, 0.4]) - found.box_m[0, :2]) / side[:2] * CELLS)
    assert chance[5, column - 3 : column + 4, row - 3 : row + 4].sum() == pytest.approx(1.0, abs=1e-3)
    centre = mi.Point3f(*(float(c) for c in found.box_m.mean(axis=0)))
    assert bool(found.contains(centre)[0]) and not bool(found.contains(mi.Point3f(0.0, 0.0, 9.0))[0])
    straight_up = observed(directions=np.tile([0.0, 0.0, 1.0], (1024, 1)), origins_m=np.full((1024, 3), 0.5))
    one = fit_sky_guide(open_sky(), straight_up)
    assert one is not None and one.shares.sum() == pytest.approx(0.5)  # the maximum share
    side = one.box_m[1] - one.box_m[0]
    by_cell = np.array(one.density) * np.repeat(side.prod() / side, 2 * CELLS**2) / CELLS**2
    chance = np.sort(2.0 * one.shares[np.array(one.opening_of_cell)] * by_cell)[::-1]
    whole = 1 + 8 * NEIGHBOUR_SHARE
    assert chance[0] == pytest.approx(1 / whole, abs=1e-3)
    assert chance[1:9] == pytest.approx([NEIGHBOUR_SHARE / whole] * 8, abs=1e-3) and chance[9] == 0.0


def test_little_sky_few_rays_or_none_from_inside_give_no_guide() -> None:
    from datagen.rendering.transport.sky_guide import MIN_ESCAPES, fit_sky_guide

    quarter = np.pi / 4
    assert fit_sky_guide(open_sky(), observed(others=8 * quarter)) is not None
    assert fit_sky_guide(open_sky(), observed(others=10 * quarter)) is None
    for extra, is_guide in ((0, True), (-1, False)):
        few = observed(4 * (MIN_ESCAPES + extra))
        assert (fit_sky_guide(open_sky(), few) is not None) == is_guide
    assert fit_sky_guide(open_sky(), observed(origins_m=np.full((1024, 3), 9.0))) is None
    assert fit_sky_guide(open_sky(), observed(points_m=np.zeros((4096, 3)))) is None


def test_surfaces_outside_do_not_enlarge_the_box() -> None:
    """The box ends at the window, x = 4 m, although most escaping rays start on the ground beyond it."""
    from datagen.rendering.transport.room_box import MARGIN, room_box

    random = np.random.default_rng(4)
    room = random.random((16000, 3)) * [4, 4, 2.5]
    outside = random.random((1500, 3)) * [3, 4, 0] + [4, 0, 0]
    window = random.random((400, 3)) * [0, 1, 1] + [4, 1.5, 0.8]
    sky = random.normal(size=(1500, 3))
    sky = sky / np.linalg.norm(sky, axis=1, keepdims=True) + [0, 0, 1]
    directions = np.concatenate([window - room[:400], sky])
    points = np.concatenate([room, outside])
    found = room_box(
        observed(
            points_m=points,
            origins_m=np.concatenate([room[:400], outside]),
            directions=directions / np.linalg.norm(directions, axis=1, keepdims=True),
            radiance=np.ones(1900),
        )
    )
    assert found is not None
    low, high = np.percentile(points, [2, 98], axis=0)
    margin = MARGIN * np.ptp(np.percentile(points[:, 0], [10, 90]))
    assert high[0] > 6.0 and found[1, 0] == pytest.approx(4.0, abs=0.15)
    others = np.array([*found[0], *found[1, 1:]])
    assert others == pytest.approx([*(low - margin), *(high + margin)[1:]], abs=1e-6)


def test_openings_are_parts_of_windows() -> None:
    """The openings are parts of two windows in opposite walls, divided by probability."""
    from datagen.rendering.transport.room_box import CELLS
    from datagen.rendering.transport.sky_guide import SkyGuide

    chance = np.zeros((6, CELLS, CELLS))
    chance[0, 4:8, 4:8], chance[1, 20:28, 10:18], chance[3, 0, 0] = 3.0, 1.0, 1e-6
    guide = SkyGuide(open_sky(), np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 2.5]]), chance.ravel(), 0.5, 1.0)
    opening = np.array(guide.opening_of_cell).reshape(6, CELLS, CELLS)
    first, second = (set(opening[face][chance[face] > 0].tolist()) for face in (0, 1))
    assert not first & second and first | second == set(range(OPENINGS)) and min(len(first), len(second)) > 1
    assert guide.shares.sum() == pytest.approx(0.5) and guide.shares.min() > 0.02


def test_rays_leave_the_box_at_the_exact_positions() -> None:
    import mitsuba as mi

    from datagen.rendering.transport.room_box import CELLS, exit_cell

    random = np.random.default_rng(2)
    low, high = np.array([-1.0, 0.0, 2.0]), np.array([3.0, 1.0, 4.0])
    points = low + (high - low) * random.random((2000, 3))
    directions = random.normal(size=(2000, 3))
    directions[:6] = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    corners = mi.Point3f(*low.tolist()), mi.Point3f(*high.tolist())
    cell, t, along = (
        np.array(part)
        for part in exit_cell(
            *corners, mi.Point3f(points.T.astype("f4")), mi.Vector3f(directions.T.astype("f4"))
        )
    )
    with np.errstate(divide="ignore"):
        distance = np.where(directions > 0, high - points, low - points) / directions
    distance[directions == 0] = np.inf
    axis = distance.argmin(axis=1)
    rows = np.arange(2000)
    np.testing.assert_allclose(t, distance.min(axis=1), rtol=1e-4, atol=2e-6)  # float32 in metres
    np.testing.assert_allclose(along, directions[rows, axis], rtol=1e-5)
    place = (points + t[:, None] * directions - low) / (high - low) * CELLS
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    column, row = (np.clip(np.floor(place[rows, others[:, k]]), 0, CELLS - 1) for k in (0, 1))
    expected = ((2 * axis + (directions[rows, axis] > 0)) * CELLS + column) * CELLS + row
    assert (cell == expected).mean() > 0.998  # except where rounding moves a position to the next cell


def test_rays_along_an_edge_of_the_box_leave_through_its_last_cells() -> None:
    """Points on faces of the box, whose normalised position is exactly 0 or 1, count as inside."""
    import mitsuba as mi

    from datagen.rendering.transport.room_box import CELLS, exit_cell

    corners = mi.Point3f(-1.0, 0.0, 2.0), mi.Point3f(3.0, 1.0, 4.0)
    points = mi.Point3f(np.array([[0, 1, 4], [0, 0, 2], [3, 0.5, 4], [-1, 0.5, 2]], np.float32).T)
    directions = mi.Vector3f(np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], np.float32).T)
    face, rest = np.divmod(np.array(exit_cell(*corners, points, directions)[0]), CELLS**2)
    last = CELLS - 1
    assert face.tolist() == [1, 0, 3, 2]
    assert rest.tolist() == [last * CELLS + last, 0, last * CELLS + last, 0]


def test_lanes_without_a_vertex_stay_inside_the_table() -> None:
    """Rays without a hit have NaN or infinite positions, but their cells are still looked up."""
    import mitsuba as mi

    from datagen.rendering.transport.room_box import CELLS, exit_cell

    corners = mi.Point3f(-1.0, 0.0, 2.0), mi.Point3f(3.0, 1.0, 4.0)
    values = np.array([np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0], np.float32)
    points, directions = (g.ravel() for g in np.meshgrid(values, values))
    cell = exit_cell(
        *corners,
        mi.Point3f(points, np.zeros_like(points), points),
        mi.Vector3f(directions, directions, np.ones_like(directions)),
    )[0]
    assert int(np.array(cell).max()) < 6 * CELLS**2
