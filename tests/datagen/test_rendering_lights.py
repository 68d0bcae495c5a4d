# SPDX-License-Identifier: MIT
"""Every kind of light gives its analytic irradiance on a plane within 1 %.

The plane has D = 0.5, S = 0, R = 1 and is viewed from straight above: radiance = D / pi * irradiance, up to
the Schlick term of S = 0, which is below 0.1 % there.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from datagen.formats.asset import SlotMaterial
from datagen.formats.lights import (
    AreaLight,
    DirectionalLight,
    EnvironmentLight,
    PointLight,
    SkyLight,
    SphereLight,
    SpotLight,
)
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.errors import InputError
from datagen.library import Library
from datagen.rendering.renderer import SceneRenderer
from oracles.rendering_scenes import GREY, SmallScene, configure, down_camera, quad, renderer

pytestmark = pytest.mark.usefixtures("mitsuba_variant")

ALBEDO = 0.5
TOLERANCE = 0.01
RECIPE = RenderRecipe(path_samples=2048, auxiliary_samples=1, max_depth=2, denoise=False)


def irradiance(tmp_path: Path, *lights: Any, scene: SmallScene | None = None, at: Any = (0.0, 0.0)) -> Any:
    """Measure the irradiance (3,) around the point ``at`` of the plane z = 0 in a rendered image."""
    view = renderer(tmp_path, scene, [down_camera(at=at)], RECIPE, lights=lights).render_view(0)
    return view.buffers["beauty"].astype(np.float64).mean(axis=(0, 1)) * math.pi / ALBEDO


def rectangle_irradiance(side: float, height: float, radiance: float) -> float:
    """Return the irradiance under a centred, parallel square light: L times the sum of cos^2 / d^2 dA."""
    x = (np.arange(2000) + 0.5) / 2000 * side - side / 2
    square = x[:, None] ** 2 + x[None, :] ** 2 + height**2
    return radiance * float((height**2 / square**2).sum()) * (side / 2000) ** 2


def disk_irradiance(radius: float, height: float, radiance: float) -> float:
    return math.pi * radiance * radius**2 / (radius**2 + height**2)


AREA = {"origin_m": (-0.5, -0.5, 1.5), "edge_u_m": (0, 1, 0), "edge_v_m": (1, 0, 0)}  # emits along -z
RADIANCE = (1.0, 2.0, 4.0)
TILT = math.radians(40)
SUN = (math.sin(TILT), 0.0, -math.cos(TILT))
CASES: dict[str, tuple[Any, float]] = {
    "point above": (PointLight(name="l", position_m=(0, 0, 1.5), intensity=RADIANCE), 1 / 1.5**2),
    "point aside": (PointLight(name="l", position_m=(1, 0, 1.5), intensity=RADIANCE), 1.5 / 3.25**1.5),
    "spot": (
        SpotLight(
            name="l",
            position_m=(1, 0, 1.5),
            direction=(-1, 0, -1.5),
            intensity=RADIANCE,
            cutoff_rad=0.3,
            beam_width_rad=0.2,
        ),
        1.5 / 3.25**1.5,
    ),
    "sun": (DirectionalLight(name="l", direction=SUN, irradiance=RADIANCE), math.cos(TILT)),
    "soft sun": (
        DirectionalLight(name="l", direction=SUN, irradiance=RADIANCE, angular_diameter_rad=0.3),
        math.cos(TILT),
    ),
    "rectangle": (AreaLight(name="l", radiance=RADIANCE, **AREA), rectangle_irradiance(1, 1.5, 1)),
    "hidden rectangle": (
        AreaLight(name="l", radiance=RADIANCE, is_visible=False, **AREA),
        rectangle_irradiance(1, 1.5, 1),
    ),
    "disk": (AreaLight(name="l", radiance=RADIANCE, shape="disk", **AREA), disk_irradiance(0.5, 1.5, 1)),
    "sphere": (
        SphereLight(name="l", position_m=(0, 0, 1.5), radius_m=0.3, radiance=RADIANCE),
        math.pi * (0.3 / 1.5) ** 2,
    ),
    "environment": (EnvironmentLight(name="l", radiance=RADIANCE), math.pi),
}


@pytest.mark.parametrize("case", CASES)
def test_light_gives_its_analytic_irradiance(tmp_path: Path, case: str) -> None:
    light, expected = CASES[case]
    found = irradiance(tmp_path, light)
    assert found == pytest.approx(np.array(RADIANCE) * expected, rel=TOLERANCE)


def test_five_percent_too_bright_is_detected(tmp_path: Path) -> None:
    brighter = tuple(1.05 * c for c in RADIANCE)
    found = irradiance(tmp_path, AreaLight(name="l", radiance=brighter, **AREA))
    assert found != pytest.approx(np.array(RADIANCE) * rectangle_irradiance(1, 1.5, 1), rel=TOLERANCE)


def test_lights_add_up(tmp_path: Path) -> None:
    lights = [CASES[name] for name in ("point above", "rectangle", "sun")]
    found = irradiance(tmp_path, *(light for light, _ in lights))
    assert found == pytest.approx(np.array(RADIANCE) * sum(e for _, e in lights), rel=TOLERANCE)


def test_spot_is_dark_outside_its_cutoff(tmp_path: Path) -> None:
    light, _ = CASES["spot"]
    assert irradiance(tmp_path, light, at=(2.0, 0.0)).max() == 0.0


def test_soft_sun_has_half_its_irradiance_where_an_edge_hides_its_centre(tmp_path: Path) -> None:
    # A roof over x < 0 at height 0.5 m, under a sun at the zenith of 0.2 rad in diameter.
    roof = quad([-20, -20, 0.5], [0, 40, 0], [20, 0, 0])
    scene = SmallScene()
    scene.parts["roof"] = (roof, "grey")
    sun = DirectionalLight(name="l", direction=(0, 0, -1), irradiance=RADIANCE, angular_diameter_rad=0.2)
    half_width = 0.5 * 0.1
    camera = down_camera(64, 4, 0.2, z=0.4)  # below the roof
    view = renderer(tmp_path, scene, [camera], RECIPE, lights=(sun,)).render_view(0)
    profile = view.buffers["beauty"][..., 0].astype(np.float64).mean(axis=0) * math.pi / ALBEDO
    x = camera.unproject(camera.pixel_centers(), np.full((4, 64), 0.4))[0, :, 0]
    edge = np.clip(x / half_width, -1, 1)
    seen = 0.5 + (edge * np.sqrt(1 - edge**2) + np.arcsin(edge)) / math.pi  # visible share of the disc
    assert np.abs(profile - seen).max() < 0.03


@pytest.mark.parametrize("height_m", [0.5, 3.0, 30.0])
def test_soft_sun_is_blocked_at_any_distance(tmp_path: Path, height_m: float) -> None:
    scene = SmallScene()
    scene.parts["roof"] = (quad([-20, -20, height_m], [0, 40, 0], [40, 0, 0]), "grey")
    sun = DirectionalLight(name="l", direction=(0, 0, -1), irradiance=RADIANCE, angular_diameter_rad=0.01)
    camera = down_camera(8, 8, 0.2, z=0.4)
    view = renderer(tmp_path, scene, [camera], RECIPE, lights=(sun,)).render_view(0)
    assert view.buffers["beauty"].max() == 0.0


def test_hidden_light_is_invisible_to_the_camera_only(tmp_path: Path) -> None:
    # The camera looks down through the light (z = 0.5) at the floor.
    light = AreaLight(
        name="l",
        radiance=RADIANCE,
        origin_m=(-1, -1, 0.5),
        edge_u_m=(2, 0, 0),
        edge_v_m=(0, 2, 0),  # emits upwards, away from the floor
        is_visible=False,
    )
    lamp = PointLight(name="p", position_m=(0.8, 0, 0.4), intensity=(5.0, 5.0, 5.0))
    hidden = renderer(tmp_path / "a", None, [down_camera()], RECIPE, lights=(light, lamp)).render_view(0)
    seen_light = light.model_copy(update={"is_visible": True})
    seen = renderer(tmp_path / "b", None, [down_camera()], RECIPE, lights=(seen_light, lamp)).render_view(0)
    expected = 5.0 * 0.4 / 0.8**1.5 * ALBEDO / math.pi
    assert hidden.buffers["beauty"].mean() == pytest.approx(expected, rel=TOLERANCE)
    assert hidden.buffers["depth_z_m"] == pytest.approx(1.0, abs=1e-5)
    assert (hidden.buffers["instance_id"] == 1).all()
    assert hidden.buffers["surface_mask"] == pytest.approx(1.0)
    assert seen.buffers["beauty"].mean(axis=(0, 1)) == pytest.approx(np.array(RADIANCE), rel=1e-5)
    assert seen.buffers["depth_z_m"] == pytest.approx(0.5, abs=1e-5)
    assert seen.buffers["surface_mask"].max() == 0.0


def test_transparent_sheet_dims_a_point_light(tmp_path: Path) -> None:
    scene = SmallScene()
    scene.slots["veil"] = GREY.model_copy(update={"opacity": 0.3, "diffuse_albedo": (0.0, 0.0, 0.0)})
    scene.parts["veil"] = (quad([0.2, -1, 0.5], [1, 0, 0], [0, 2, 0]), "veil")
    light = PointLight(name="l", position_m=(1, 0, 1), intensity=RADIANCE)
    found = irradiance(tmp_path, light, scene=scene)
    assert found == pytest.approx(np.array(RADIANCE) * 0.7 / 2**1.5, rel=TOLERANCE)


def test_partly_transparent_white_sheet_vanishes_in_uniform_light(tmp_path: Path) -> None:
    """MIS weights of emitter and BSDF samples sum to 1 for any opacity."""
    scene = SmallScene()
    scene.slots["veil"] = GREY.model_copy(update={"opacity": 0.5, "diffuse_albedo": (1.0, 1.0, 1.0)})
    scene.parts["floor"] = (quad([-1, -1, 0], [2, 0, 0], [0, 2, 0]), "veil")
    sky = EnvironmentLight(name="sky", radiance=RADIANCE)
    room = renderer(tmp_path, scene, [down_camera()], RECIPE, lights=[sky])
    found = room.tracer.render(room.sensor(down_camera()), 1024, 1).mean(axis=(0, 1))
    assert found == pytest.approx(np.array(RADIANCE), rel=TOLERANCE)


def test_light_reflects_the_light_of_others(tmp_path: Path) -> None:
    """A faintly emissive surface reflects light like any other surface."""
    scene = SmallScene()
    scene.slots["glow"] = GREY.model_copy(update={"emission": (1e-6, 1e-6, 1e-6)})
    scene.parts = {"floor": (scene.parts["floor"][0], "glow")}
    light = PointLight(name="l", position_m=(0, 0, 1), intensity=RADIANCE)
    room = renderer(tmp_path, scene, [down_camera()], RECIPE, lights=[light])
    found = room.tracer.render(room.sensor(down_camera()), 64, 1).mean(axis=(0, 1))
    assert found == pytest.approx(np.array(RADIANCE) * 0.5 / math.pi, rel=TOLERANCE)


def test_emissive_part_emits_light_and_is_masked(tmp_path: Path) -> None:
    scene = SmallScene()
    scene.slots["glow"] = SlotMaterial(emission=RADIANCE)
    scene.parts["panel"] = (quad([-0.5, -0.5, 1.5], [0, 1, 0], [1, 0, 0]), "glow")
    found = irradiance(tmp_path, scene=scene)
    assert found == pytest.approx(np.array(RADIANCE) * rectangle_irradiance(1, 1.5, 1), rel=TOLERANCE)
    up = Camera(4, 4, 40, 40, 2, 2, look_at([0, 0, 0.5], [0, 0, 1.5], up=(0, 1, 0)))
    view = renderer(tmp_path / "up", scene, [up], RECIPE).render_view(0)
    assert view.buffers["beauty"].mean(axis=(0, 1)) == pytest.approx(np.array(RADIANCE), rel=1e-5)
    assert view.buffers["surface_mask"].max() == 0.0
    assert view.buffers["instance_id"].max() == 0


def environment_package(root: Path, pixels: np.ndarray) -> str:
    """Write a material package that contains an environment image; return its id."""
    from datagen.formats.asset import Material, MaterialAsset
    from datagen.formats.package import write_package
    from oracles.rendering_scenes import CC0

    root.mkdir(parents=True, exist_ok=True)
    path = root / "image.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.ascontiguousarray(pixels, np.float32)}) as file:
        file.write(str(path))
    asset = MaterialAsset(id="sky-image", title="sky", provenance=CC0, material=Material())
    write_package(root / "sky-image", asset, {"sky.exr": path.read_bytes()})
    return "sky-image"


def test_environment_image_follows_its_convention(tmp_path: Path) -> None:
    height, width = 64, 128
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    pixels = np.stack([u, v, np.full_like(u, 0.5)], axis=-1)
    asset = environment_package(tmp_path, pixels)
    light = EnvironmentLight(name="l", asset=asset, image="sky.exr", scale=2.0)
    # A camera along +Y looks at the image's centre, with the same right and up directions.
    camera = Camera(9, 9, 30, 30, 4.5, 4.5, look_at([0, 0, 1], [0, 1, 1]))
    recipe = RECIPE.model_copy(update={"auxiliary_samples": 64})  # these sample visible emission
    view = renderer(tmp_path, None, [camera], recipe, lights=(light,)).render_view(0)
    directions = camera.ray_directions()
    azimuth = np.arctan2(directions[..., 0], directions[..., 1])  # from +Y towards +X
    expected_u = 0.5 + azimuth / (2 * math.pi)
    expected_v = np.arccos(directions[..., 2]) / math.pi
    beauty = view.buffers["beauty"]
    assert beauty[..., 0] == pytest.approx(2 * expected_u, abs=2e-3)
    assert beauty[..., 1] == pytest.approx(2 * expected_v, abs=2e-3)
    # A quarter rotation about Z moves the centre to -X.
    turned = light.model_copy(
        update={"world_from_environment": ((0, -1, 0, 0), (1, 0, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1.0))}
    )
    SmallScene().write(tmp_path / "turned")
    environment_package(tmp_path / "turned", pixels)
    camera = Camera(9, 9, 30, 30, 4.5, 4.5, look_at([0, 0, 1], [-1, 1e-9, 1]))
    configured = configure(Library([tmp_path / "turned"]), [camera], lights=(turned,))
    view = SceneRenderer(configured, Library([tmp_path / "turned"]), recipe).render_view(0)
    assert view.buffers["beauty"][..., 0] == pytest.approx(2 * expected_u, abs=2e-3)


def test_sky_irradiance_matches_the_integral_of_its_radiance(tmp_path: Path) -> None:
    import mitsuba as mi

    fields = {"sun_direction": [0.4, 0.3, 0.85], "turbidity": 4.0, "albedo": 0.2, "sun_scale": 0.0}
    sky = SkyLight(name="l", sun_direction=(0.4, 0.3, 0.85), turbidity=4.0, ground_albedo=0.2, sun_scale=0.0)
    found = irradiance(tmp_path, sky)
    emitter: Any = mi.load_dict({"type": "sunsky", "sky_scale": 1.0, **fields})
    num = 400
    cosine, phi = np.meshgrid((np.arange(num) + 0.5) / num, 2 * np.pi * (np.arange(num) + 0.5) / num)
    sine = np.sqrt(1 - cosine**2)
    directions = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine]).reshape(3, -1)
    si: Any = mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f(directions.astype(np.float32))
    radiance = np.array(emitter.eval(si)).astype(np.float64)
    expected = 2 * np.pi * (radiance * directions[2]).mean(axis=1)
    assert (expected > 0).all()
    assert found == pytest.approx(expected, rel=TOLERANCE)


def test_sun_of_the_sky_is_in_the_given_direction(tmp_path: Path) -> None:
    # The floor behind a wall gets no direct sun.
    direction = np.array([1.0, 0.0, 1.0]) / math.sqrt(2)
    scene = SmallScene()
    scene.parts["wall"] = (quad([0.5, -5, 0], [0, 10, 0], [0, 0, 2]), "grey")
    sky = SkyLight(name="l", sun_direction=tuple(direction), sky_scale=0.0)
    assert irradiance(tmp_path / "shadow", sky, scene=scene, at=(-0.2, 0.0)).max() == 0.0
    lit = irradiance(tmp_path / "lit", sky, scene=scene, at=(2.0, 0.0))
    assert lit.min() > 0.0


@pytest.mark.parametrize(
    ("lights", "named"),
    [
        (
            [
                AreaLight(
                    name="flat", origin_m=(0, 0, 1), edge_u_m=(1, 0, 0), edge_v_m=(2, 0, 0), radiance=RADIANCE
                )
            ],
            "no area",
        ),
        (
            [EnvironmentLight(name="a"), SkyLight(name="b", sun_direction=(0, 0, 1))],
            "at most one light of type environment or sky",
        ),
        ([EnvironmentLight(name="a", image="sky.exr")], "the id of the package"),
        ([DirectionalLight(name="d", direction=(0, 0, 0), irradiance=RADIANCE)], "a direction"),
    ],
)
def test_bad_lights_are_refused(tmp_path: Path, lights: list[Any], named: str) -> None:
    with pytest.raises(InputError) as caught:
        renderer(tmp_path, lights=tuple(lights))
    assert named in str(caught.value)
