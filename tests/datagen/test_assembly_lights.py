# SPDX-License-Identifier: MIT
"""The light probe agrees with closed forms and Mitsuba, lights are placed validly, and every room is lit."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from datagen.assembly import plan
from datagen.assembly.daylight import (
    directions_of_table,
    environment_image,
    environment_radiance,
    lookup,
    sky_radiance,
    sun_of,
)
from datagen.assembly.free_space import FreeSpace
from datagen.assembly.geometry import WorldScene, load_geometry
from datagen.assembly.light_levels import Lighting
from datagen.assembly.light_probe import LUMINANCE, Emitters, LightGroup, LightProbe
from datagen.assembly.lights import RoomToLight, is_blocked
from datagen.assembly.things import pose
from datagen.formats.asset import Box, LightSlot, SlotMaterial
from datagen.formats.base import canonical_json
from datagen.formats.configuration import Configuration
from datagen.formats.lights import (
    AreaLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
    SkyLight,
    SphereLight,
    SpotLight,
    moved_light,
    scaled,
)
from datagen.formats.recipe import Recipe
from datagen.foundation.color import color_of_temperature
from datagen.foundation.errors import InputError
from datagen.foundation.random import Draws
from datagen.library import Library
from tests.datagen.small_library import (
    box,
    write_object,
    write_objects,
    write_package_of,
    write_room,
    write_small_library,
)


def recipe(**fields: Any) -> Recipe:
    base: dict[str, Any] = {"name": "lights", "configurations": 100, "views": 2, "resolution": (64, 40)}
    return Recipe.model_validate({**base, **fields})


def scene_of(shape: trimesh.Trimesh, tmp_path: Path) -> WorldScene:
    write_package_of(tmp_path, "shell", {"shell": shape})
    return WorldScene(load_geometry(Library([tmp_path]).package("shell")), [])


def estimate(scene: WorldScene, albedo: float, group: LightGroup, points: Any, count: int = 600) -> float:
    probe = LightProbe(scene, np.full((len(scene.rays.faces), 3), albedo), [group], ())
    return float(probe.irradiance(np.repeat(points, count, axis=0), Draws(1)).mean())


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.8])
@pytest.mark.parametrize("error", [0.0, 0.05])
def test_probe_in_an_integrating_sphere(tmp_path: Path, albedo: float, error: float) -> None:
    """A point light I at the centre of a sphere of radius r irradiates its wall by I/r^2 / (1 - albedo)."""
    radius, intensity = 2.0, 3.0
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    scene = scene_of(trimesh.Trimesh(ball.vertices, ball.faces[:, ::-1], process=False), tmp_path)
    lamp = PointLight(name="lamp", position_m=(0, 0, 0), intensity=(intensity * (1 + error),) * 3)
    point = np.array([[0.9, 0.3, -0.2]])
    walls = intensity / radius**2 / (1 - albedo)
    expected = 0.25 * intensity / float((point**2).sum()) + albedo * walls
    got = estimate(scene, albedo, LightGroup((lamp,)), point)
    is_close = abs(got - expected) < 0.015 * expected
    assert is_close == (error == 0.0)


def test_lights_of_equal_power_agree(tmp_path: Path) -> None:
    """Far from a small sphere, disk, rectangle or spot light, fluence depends only on its intensity."""
    scene = scene_of(box([-9, -9, -9.2], [9, 9, -9]), tmp_path)  # a distant black floor
    point = np.array([[0.0, 0.0, -1.0]])
    size, radiance = 0.04, 50.0
    side = (0.5 * size, -0.5 * size, 0.0)
    rectangle = AreaLight(
        name="a",
        origin_m=(-side[0], side[0], 0),
        edge_u_m=(size, 0, 0),
        edge_v_m=(0, -size, 0),
        radiance=(radiance,) * 3,
    )
    disk = rectangle.model_copy(update={"shape": "disk"})
    sphere = SphereLight(name="s", position_m=(0, 0, 0), radius_m=0.5 * size, radiance=(radiance,) * 3)
    spot = SpotLight(
        name="p",
        position_m=(0, 0, 0),
        direction=(0, 0, -1),
        intensity=(radiance * size**2,) * 3,
        cutoff_rad=0.5,
        beam_width_rad=0.4,
    )
    fluence = {
        name: 4 * estimate(scene, 0.0, LightGroup((light,)), point, 12000)
        for name, light in {"rectangle": rectangle, "disk": disk, "sphere": sphere, "spot": spot}.items()
    }
    expected = radiance * size**2
    assert fluence["rectangle"] == pytest.approx(expected, rel=2e-3)
    assert fluence["spot"] == pytest.approx(expected, rel=2e-3)
    assert fluence["disk"] == pytest.approx(expected * math.pi / 4, rel=5e-3)
    assert fluence["sphere"] == pytest.approx(expected * math.pi / 4, rel=2.5e-2)
    outside = np.array([[1.0, 0.0, -1.0]])
    assert estimate(scene, 0.0, LightGroup((spot,)), outside) == 0.0
    behind = np.array([[0.0, 0.0, 1.0]])
    assert estimate(scene, 0.0, LightGroup((rectangle,)), behind) == 0.0


def test_emitting_triangles_are_an_area_light(tmp_path: Path) -> None:
    panel = trimesh.Trimesh(
        [[-0.5, -0.5, 2], [0.5, -0.5, 2], [0.5, 0.5, 2], [-0.5, 0.5, 2]],
        [[0, 2, 1], [0, 3, 2]],
        process=False,
    )
    scene = scene_of(panel, tmp_path)
    points = np.array([[0.3, 0.1, 0.5], [1.0, -2.0, 1.0]])
    light = AreaLight(
        name="a", origin_m=(-0.5, 0.5, 2 - 1e-4), edge_u_m=(1, 0, 0), edge_v_m=(0, -1, 0), radiance=(3, 3, 3)
    )
    emitters = Emitters(np.array([0, 1]), np.full((2, 3), 3.0))
    one = estimate(scene, 0.0, LightGroup((light,)), points, 4000)
    other = estimate(scene, 0.0, LightGroup((), emitters), points, 4000)
    assert one == pytest.approx(other, rel=0.02)


def test_sky_through_a_window_is_counted_once(tmp_path: Path) -> None:
    """Sampling the opening and tracing rays that leave the room give the same irradiance from the sky."""
    write_small_library(tmp_path)
    package = Library([tmp_path]).package("room-0")
    scene = WorldScene(load_geometry(package), [])
    sky = LightGroup(sky=lambda d: np.where(d[:, 2:] > 0, 2.0, 0.5) * np.ones((1, 3)))
    albedo = np.full((len(scene.rays.faces), 3), 0.6)
    points = np.random.default_rng(1).uniform([0.5, 0.5, 0.5], [4.5, 3.0, 2.0], (500, 3))
    at_opening = LightProbe(scene, albedo, [sky], package.asset.openings).irradiance(points, Draws(1), 16)  # type: ignore[union-attr]
    escaping = LightProbe(scene, albedo, [sky], ()).irradiance(points, Draws(2), 160)
    assert float(at_opening.mean()) == pytest.approx(float(escaping.mean()), rel=0.04)


def test_probe_agrees_with_mitsuba(tmp_path: Path, mitsuba_variant: str) -> None:
    """Mean luminance around the camera positions agrees with path tracing of the configuration."""
    import mitsuba as mi

    from datagen.rendering.scene_builder import build_scene

    library = Library([write_small_library(tmp_path)])
    kept: dict[str, Any] = {}
    original = plan.light_room

    def spy(room: RoomToLight, *rest: Any) -> Lighting:
        kept["room"], kept["lighting"] = room, original(room, *rest)
        return kept["lighting"]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "light_room", spy)
        lit = {
            "native_probability": 0,
            "area_probability": 1,
            "point_probability": 1,
            "daylight_probability": 1,
        }
        configuration = plan.assemble(recipe(lights=lit), 2, library)
    eyes, lighting = kept["room"].eyes, kept["lighting"]
    assert {light.type for light in configuration.lights} == {"area", "point", "sky"}
    origins = np.repeat(eyes, 400, axis=0)
    directions = Draws(1).sphere(len(origins))
    ray = mi.RayDifferential3f(
        o=mi.Point3f(*origins.T.astype(np.float32)), d=mi.Vector3f(*directions.T.astype(np.float32))
    )
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(origins))
    integrator = mi.load_dict({"type": "path", "max_depth": 16, "rr_depth": 100, "hide_emitters": True})
    radiance, _, _ = integrator.sample(build_scene(configuration, library).scene, sampler, ray)
    rendered = float((np.array(radiance).T @ LUMINANCE).mean())
    probed = float(
        lighting.luminance(np.repeat(eyes, 16, axis=0), Draws(2).sphere(16 * len(eyes)), Draws(3)).mean()
    )
    assert probed == pytest.approx(rendered, rel=0.15)


def test_irradiance_is_in_the_recipes_range(tmp_path: Path) -> None:
    library = Library([write_small_library(tmp_path)])
    for index in range(6):
        narrow = recipe(lights={"mean_irradiance": (1.9, 2.1)})
        kept: list[Lighting] = []
        with pytest.MonkeyPatch.context() as patch:
            original = plan.light_room
            patch.setattr(plan, "light_room", lambda *a, f=original, k=kept: k.append(f(*a)) or k[-1])
            plan.assemble(narrow, index, library)
        assert 1.9 * 0.999 <= kept[0].mean_irradiance <= 2.1 * 1.001


def lights_of(library: Library, index: int = 0, **fields: Any) -> Configuration:
    return plan.assemble(recipe(**fields), index, library)


ONLY_AREA = {
    "native_probability": 0,
    "area_probability": 1,
    "point_probability": 0,
    "daylight_probability": 0,
}
NONE_WANTED = {
    "native_probability": 0,
    "area_probability": 0,
    "point_probability": 0,
    "daylight_probability": 0,
}
NATIVE = {"native_probability": 1, "area_probability": 0, "point_probability": 0, "daylight_probability": 0}


def test_every_room_is_lit(tmp_path: Path) -> None:
    """A room without light slots, openings and lights gets a luminous panel under its ceiling."""
    write_room(tmp_path, "bare", light_slots=(), openings=())
    write_objects(tmp_path)
    library = Library([tmp_path])
    for wanted in (ONLY_AREA, NONE_WANTED, {**NONE_WANTED, "daylight_probability": 1}):
        configuration = lights_of(library, lights=wanted)
        assert len(configuration.lights) >= 1
        for light in configuration.lights:
            assert isinstance(light, AreaLight)
            assert 2.6 < light.origin_m[2] < 2.7 and np.cross(light.edge_u_m, light.edge_v_m)[2] < 0


def test_a_room_that_cannot_be_lit_is_reported(tmp_path: Path) -> None:
    """The only light is enclosed by a case, and the room has no ceiling for another light."""
    shapes = {
        "floor": box([0, 0, -0.1], [5, 5, 0]),
        "case": box([6, 1, 0], [7, 2, 1]),
        "table": box([1, 1, 0], [2, 2, 1]),
    }
    write_package_of(
        tmp_path,
        "open",
        shapes,
        camera_regions=(Box(minimum_m=(0.5, 0.5, 0), maximum_m=(4, 4, 2)),),
        lights=(PointLight(name="walled-in", position_m=(6.5, 1.5, 0.5), intensity=(1, 1, 1)),),
    )
    with pytest.raises(InputError, match=r"lights = no light reaches.*light.no_ceiling.*add light slots"):
        lights_of(Library([tmp_path]), lights=NATIVE, objects={"count": (0, 0)})


def test_lamps_inside_furniture_are_not_used(tmp_path: Path) -> None:
    slots = (
        LightSlot(
            name="in-table",
            kind="area",
            origin_m=(1.2, 1.8, 0.73),
            edge_u_m=(0.4, 0, 0),
            edge_v_m=(0, -0.4, 0),
        ),
        LightSlot(
            name="through-wall",
            kind="area",
            origin_m=(-0.5, 2.0, 2.0),
            edge_u_m=(1, 0, 0),
            edge_v_m=(0, -1, 0),
        ),
        LightSlot(name="point-in-wall", kind="point", origin_m=(-0.05, 2.0, 1.0)),
        LightSlot(
            name="good", kind="area", origin_m=(2.0, 2.5, 2.69), edge_u_m=(1, 0, 0), edge_v_m=(0, -0.8, 0)
        ),
    )
    write_room(tmp_path, "room", light_slots=slots)
    write_objects(tmp_path)
    wanted = {**ONLY_AREA, "point_probability": 1, "count_area": (3, 3)}
    configuration = lights_of(Library([tmp_path]), lights=wanted)
    assert [light.name for light in configuration.lights] == ["area-good"]
    assert configuration.rejections["light.blocked"] == 2
    assert configuration.rejections["light.inside_solid"] == 1


def test_a_bulb_in_a_lampshade_does_not_count_as_inside_a_wall(tmp_path: Path) -> None:
    """Most rays from a bulb in a single-sheet shade hit back faces, but light leaves its open ends."""
    shade = trimesh.creation.cylinder(radius=0.15, height=0.3, sections=32)
    sides = shade.faces[np.abs(shade.face_normals[:, 2]) < 0.5]  # open at both ends
    sheet = trimesh.Trimesh(np.array(shade.vertices) + np.array([2.5, 2.0, 2.3]), sides, process=False)
    shapes = {"shade": sheet, "floor": box([0, 0, -0.1], [5, 4, 0]), "thing": box([1, 1, 0], [2, 2, 0.7])}
    shapes["ceiling"] = box([0, 0, 2.6], [5, 4, 2.7])
    slot = LightSlot(name="bulb", kind="point", origin_m=(2.5, 2.0, 2.3))
    region = Box(minimum_m=(0.3, 0.3, 0), maximum_m=(4.7, 3.7, 2.2))
    write_package_of(tmp_path, "room", shapes, light_slots=(slot,), camera_regions=(region,))
    wanted = {**NONE_WANTED, "point_probability": 1}
    open_sided = {"min_content": 2, "min_overlap": 0.1, "min_luminance": 0.0}
    configuration = lights_of(
        Library([tmp_path]), lights=wanted, objects={"count": (0, 0)}, cameras=open_sided, views=1
    )
    assert [light.name for light in configuration.lights] == ["point-bulb"]


def test_area_lights_stay_in_their_slot(tmp_path: Path) -> None:
    library = Library([write_small_library(tmp_path)])
    for index in range(8):
        for light in lights_of(library, index, lights=ONLY_AREA).lights:
            assert isinstance(light, AreaLight)
            corner, u, v = (np.array(x) for x in (light.origin_m, light.edge_u_m, light.edge_v_m))
            for point in (corner, corner + u, corner + v, corner + u + v):
                assert 2.0 - 1e-6 <= point[0] <= 3.0 + 1e-6 and 1.6 - 1e-6 <= point[1] <= 2.4 + 1e-6
            assert 0.5 <= u[0] <= 1.0 and -0.8 <= v[1] <= -0.4 + 1e-9


def test_a_slot_that_a_lamp_occupies_stays_empty(tmp_path: Path) -> None:
    """Importers add a slot for each light of a scene; using both would count one lamp twice."""
    own = AreaLight(
        name="own", origin_m=(2.0, 2.4, 2.69), edge_u_m=(1, 0, 0), edge_v_m=(0, -0.8, 0), radiance=(1, 1, 1)
    )
    write_room(tmp_path, "room", lights=(own,))
    write_objects(tmp_path)
    library = Library([tmp_path])
    both = lights_of(library, lights={**ONLY_AREA, "native_probability": 1})
    assert [light.name for light in both.lights] == ["room.own"]
    assert both.rejections["light.occupied"] == 1
    assert [light.name for light in lights_of(library, lights=ONLY_AREA).lights] == ["area-ceiling"]


def test_sun_enters_through_a_window(tmp_path: Path) -> None:
    library = Library([write_small_library(tmp_path)])
    daylight = {**NONE_WANTED, "daylight_probability": 1}
    towards_window = 0
    for index in range(12):
        (sky,) = lights_of(library, index, lights=daylight).lights
        assert isinstance(sky, SkyLight)
        direction = np.array(sky.sun_direction)
        assert math.radians(5.9) <= math.asin(direction[2]) <= math.radians(65.1)
        towards_window += direction[1] > 0.2  # the window is in the +Y wall
    assert towards_window >= 5


def test_native_lights_follow_their_object(tmp_path: Path) -> None:
    bulb = PointLight(name="bulb", position_m=(0.0, 0.1, 0.3), intensity=(2.0, 1.0, 0.5))
    slots = {"shade": SlotMaterial(classes=("fabric",)), "glow": SlotMaterial(emission=(4.0, 3.0, 2.0))}
    shapes = {
        "shade": box([-0.05, -0.05, 0], [0.05, 0.05, 0.2]),
        "glow": box([-0.02, -0.02, 0.2], [0.02, 0.02, 0.22]),
    }
    write_room(tmp_path, "room")
    write_object(tmp_path, "lamp", "lamp", shapes, slots, supports=("table",), lights=(bulb,))
    library = Library([tmp_path])
    configuration = lights_of(library, lights=NATIVE, objects={"count": (1, 1)})
    (lamp,), (light,) = configuration.objects, configuration.lights
    matrix = np.array(lamp.world_from_asset)
    assert isinstance(light, PointLight) and light.name == f"{lamp.name}.bulb"
    np.testing.assert_allclose(light.position_m, matrix[:3, :3] @ [0, 0.1, 0.3] + matrix[:3, 3], atol=1e-9)
    gain = light.intensity[0] / 2.0
    np.testing.assert_allclose(lamp.emission["glow"], np.array([4.0, 3.0, 2.0]) * gain, rtol=1e-4)
    off = lights_of(library, lights=ONLY_AREA, objects={"count": (1, 1)})
    assert off.objects[0].emission == {"glow": (0.0, 0.0, 0.0)}


def test_every_kind_of_light_moves_and_dims() -> None:
    one: Any = (1.0, 1.0, 1.0)
    lights: list[Light] = [
        PointLight(name="a", position_m=(1, 0, 0), intensity=one),
        SpotLight(
            name="b",
            position_m=(1, 0, 0),
            direction=(1, 0, 0),
            intensity=one,
            cutoff_rad=1,
            beam_width_rad=0.5,
        ),
        DirectionalLight(name="c", direction=(1, 0, 0), irradiance=one),
        AreaLight(name="d", origin_m=(1, 0, 0), edge_u_m=(1, 0, 0), edge_v_m=(0, 1, 0), radiance=one),
        SphereLight(name="e", position_m=(1, 0, 0), radius_m=0.5, radiance=one),
        EnvironmentLight(name="f", image="sky.exr"),
        SkyLight(name="g", sun_direction=(1, 0, 0)),
    ]
    matrix = pose(2.0, math.pi / 2, np.array([0.0, 0.0, 1.0]))
    a, b, c, d, e, f, g = (moved_light(light, matrix, "asset") for light in lights)
    np.testing.assert_allclose(a.position_m, (0, 2, 1), atol=1e-12)  # type: ignore[union-attr]
    np.testing.assert_allclose(b.direction, (0, 1, 0), atol=1e-12)  # type: ignore[union-attr]
    np.testing.assert_allclose(c.direction, (0, 1, 0), atol=1e-12)  # type: ignore[union-attr]
    np.testing.assert_allclose(d.edge_u_m, (0, 2, 0), atol=1e-12)  # type: ignore[union-attr]
    assert e.radius_m == pytest.approx(1.0)  # type: ignore[union-attr]
    assert f.asset == "asset"  # type: ignore[union-attr]
    turned = np.array(f.world_from_environment)[:3, :3]  # type: ignore[union-attr]
    np.testing.assert_allclose(turned @ [1, 0, 0], (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(g.sun_direction, (0, 1, 0), atol=1e-12)  # type: ignore[union-attr]
    for light in lights:
        before, after = canonical_json(light), canonical_json(scaled(light, 3.0))
        assert before != after
        assert canonical_json(scaled(scaled(light, 3.0), 1 / 3)) == before


def test_blocked_lights_are_detected(tmp_path: Path) -> None:
    scene = scene_of(box([0, 0, 0], [1, 1, 1]), tmp_path)

    def light(x: float, z: float) -> AreaLight:
        return AreaLight(
            name="l", origin_m=(x, 0.9, z), edge_u_m=(0.8, 0, 0), edge_v_m=(0, -0.8, 0), radiance=(1, 1, 1)
        )

    assert not is_blocked(light(0.1, 1.5), scene.rays)  # half a metre above the box
    assert is_blocked(light(0.1, 1.1), scene.rays)  # illuminates its lid from 10 cm
    assert is_blocked(light(0.6, 0.5), scene.rays)  # intersects its side


def test_luminous_pixels_are_masked(tmp_path: Path) -> None:
    """Pixels of a visible panel and of an emissive part are masked, those of a panel's back are not."""
    shapes = {"wall": box([-2, 2, -2], [2, 2.1, 2]), "glow": box([-2, 1.9, 1], [2, 2.0, 2])}
    write_package_of(tmp_path, "set", shapes)
    scene = WorldScene(load_geometry(Library([tmp_path]).package("set")), [])
    panel = AreaLight(
        name="p", origin_m=(-1, 1.5, -1), edge_u_m=(1, 0, 0), edge_v_m=(0, 0, 1), radiance=(1, 1, 1)
    )  # emits along -Y, towards the viewer at the origin
    glow = Emitters(np.flatnonzero(scene.part_of_face == 1), np.ones((12, 3)))
    probe = LightProbe(scene, np.ones((24, 3)), [LightGroup((panel,)), LightGroup((), glow)], ())
    directions = np.array([[-0.3, 1.5, -0.4], [0.4, 1.5, -0.4], [0.4, 1.5, 1.2], [0.0, -1.0, 0.0]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.zeros((4, 3))
    hits = scene.rays.cast(origins, directions)

    def shown(lights: tuple[Light, ...], gains: tuple[float, ...], at: Any = origins) -> list[bool]:
        return Lighting(lights, (), probe, gains, 1.0).shows_light(at, directions, hits).tolist()

    assert shown((panel,), (1.0, 1.0)) == [True, False, True, False]
    assert shown((panel,), (1.0, 0.0)) == [True, False, False, False]
    assert shown((panel.model_copy(update={"is_visible": False}),), (1.0, 0.0)) == [False] * 4
    turned = panel.model_copy(update={"edge_u_m": panel.edge_v_m, "edge_v_m": panel.edge_u_m})
    assert shown((turned,), (1.0, 0.0)) == [False] * 4


def test_colours_of_black_bodies() -> None:
    """The colour is nearly white at 6504 K (D65) and has the xy chromaticity of illuminant A at 2856 K."""
    for kelvin in (2000, 2856, 4000, 6504, 10000):
        assert np.array(color_of_temperature(kelvin)) @ LUMINANCE == pytest.approx(1.0)
    white = color_of_temperature(6504)
    assert max(white) / min(white) < 1.12
    xyz_from_rgb = np.array(
        [
            [0.4124564, 0.3575761, 0.1804375],
            [0.2126729, 0.7151522, 0.0721750],
            [0.0193339, 0.1191920, 0.9503041],
        ]
    )
    x, y, z = xyz_from_rgb @ color_of_temperature(2856)
    assert x / (x + y + z) == pytest.approx(0.4476, abs=2e-3)
    assert y / (x + y + z) == pytest.approx(0.4074, abs=2e-3)


def test_table_lookup_is_the_inverse_of_its_directions() -> None:
    directions = directions_of_table(8, 16)
    table = np.arange(8 * 16 * 3, dtype=float).reshape(8, 16, 3)
    np.testing.assert_array_equal(lookup(table)(directions.reshape(-1, 3)).reshape(8, 16, 3), table)
    np.testing.assert_allclose(directions_of_table(1, 1)[0, 0], (0, 1, 0), atol=1e-12)  # centre: +Y


def test_sky_and_sun_match_the_renderer(mitsuba_variant: str) -> None:
    """The irradiance of a horizontal plane under an open sky agrees with Mitsuba's emitter sampling."""
    import drjit as dr
    import mitsuba as mi

    sky = SkyLight(
        name="sky",
        sun_direction=(0.2, 0.5, 0.6),
        turbidity=4.0,
        ground_albedo=0.2,
        sky_scale=2.0,
        sun_scale=0.5,
    )
    directions = directions_of_table(200, 400)
    cosine = np.maximum(directions[..., 2], 0)
    solid = np.sin((np.arange(200) + 0.5) / 200 * math.pi)[:, None] * (math.pi / 200) * (2 * math.pi / 400)
    radiance = sky_radiance(sky)(directions.reshape(-1, 3)).reshape(200, 400, 3)
    from_sky = (radiance * (cosine * solid)[..., None]).sum(axis=(0, 1))
    sun = sun_of(sky)
    ours = from_sky + np.array(sun.irradiance) * -sun.direction[2]
    emitter = mi.load_dict(
        {
            "type": "sunsky",
            "sun_direction": [0.2, 0.5, 0.6],
            "turbidity": 4.0,
            "albedo": 0.2,
            "sky_scale": 2.0,
            "sun_scale": 0.5,
        }
    )
    count = 1 << 18
    surface = dr.zeros(mi.Interaction3f, count)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    sample, weight = emitter.sample_direction(surface, sampler.next_2d())
    theirs = np.array(weight * dr.maximum(sample.d.z, 0.0)).T.mean(axis=0)
    np.testing.assert_allclose(ours, theirs, rtol=0.03)


def test_environment_images_light_rooms_through_windows(tmp_path: Path, mitsuba_variant: str) -> None:
    """An environment image used as daylight is oriented as in the renderer; its asset's hash is recorded."""
    import drjit as dr
    import mitsuba as mi
    import OpenEXR

    from datagen.rendering.scene_builder import build_scene

    pixels = (1.0 + 0.8 * directions_of_table(64, 128)).astype(np.float32)  # red from +X, green +Y, blue +Z
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": pixels}).write(str(tmp_path / "sky.exr"))
    root = write_small_library(tmp_path / "library")
    write_package_of(
        root,
        "evening",
        {"ground": box([-1, -1, -0.1], [1, 1, 0])},
        {"sky.exr": tmp_path / "sky.exr"},
        lights=(EnvironmentLight(name="sky", image="sky.exr"),),
    )
    library = Library([root])
    wanted = {**NONE_WANTED, "daylight_probability": 1, "environment_images": ("evening",)}
    images = []
    for index in range(6):
        configuration = lights_of(library, index, lights=wanted, environments={"include": ["room-0"]})
        (light,) = configuration.lights
        if isinstance(light, EnvironmentLight):
            assert light.asset == "evening" and light.image == "sky.exr"
            assert configuration.assets["evening"] == library.package("evening").sha256
            images.append((configuration, light))
    assert 1 <= len(images) <= 5  # an image or a computed sky, with equal probability
    configuration, light = images[0]
    scene = build_scene(configuration, library).scene
    turn = np.array(light.world_from_environment)[:3, :3]
    directions = directions_of_table(16, 32).reshape(-1, 3) @ turn.T
    surface = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    surface.wi = mi.Vector3f(*(-directions.T).astype(np.float32))
    theirs = np.array(scene.environment().eval(surface)).T
    ours = environment_radiance(light, library)(directions)
    np.testing.assert_allclose(ours / light.scale, theirs / light.scale, atol=0.08)  # a cell is 5.6 degrees
    np.testing.assert_allclose(ours / light.scale, 1.0 + 0.8 * directions @ turn, atol=0.08)
    with pytest.raises(InputError, match=r"lights = no environment light with an image.*environment_images"):
        environment_image(library, "room-0")


def test_free_space_needs_a_camera_region_or_cameras(tmp_path: Path) -> None:
    write_room(tmp_path, "room", camera_regions=())
    environment = Library([tmp_path]).package("room")
    scene = WorldScene(load_geometry(environment), [])
    space = FreeSpace(environment.asset, scene.rays, (0.8, 1.9))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"camera_regions = none, and no cameras; expected a camera region"):
        space.check()
