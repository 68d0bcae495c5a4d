# SPDX-License-Identifier: MIT
"""Ground-truth buffers are exact on flat surfaces; at edges, channels are blended, but not ids and depth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from datagen.foundation.buffers import BUFFERS, GROUND_TRUTH_BUFFERS
from datagen.foundation.errors import InputError
from oracles.bsdf_probe import array, dr, mi

from mitsuba_plugins.material_buffers import CHANNELS, render_material_buffers  # isort: skip
from mitsuba_plugins.surface_material import SceneMaterials, number_shapes  # isort: skip

T = mi.ScalarTransform4f
WIDTH, HEIGHT = 48, 32
CAMERA_HEIGHT = 4.0
RED = {"diffuse_albedo": [0.7, 0.1, 0.2], "specular_albedo": [0.05, 0.05, 0.05], "roughness": 0.35}
BLUE = {"diffuse_albedo": [0.05, 0.2, 0.6], "specular_albedo": [0.5, 0.4, 0.3], "roughness": 0.8}


def _cook_torrance(channels: dict[str, Any], **options: Any) -> dict[str, Any]:
    rgb = {n: {"type": "rgb", "value": channels[n]} for n in ("diffuse_albedo", "specular_albedo")}
    return {"type": "cook_torrance", **rgb, "roughness": channels["roughness"], **options}


def _sensor(rfilter: str = "box", to_world: Any = None, **options: Any) -> dict[str, Any]:
    """Return a sensor looking down from z = 4 m; the image shows about 4 x 2.7 m of the plane z = 0."""
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": rfilter}}
    film.update(options.pop("film", {}))
    to_world = to_world or T().look_at([0, 0, CAMERA_HEIGHT], [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "fov": 53.13, "to_world": to_world, "film": film, **options}


def _plane(bsdf: dict[str, Any] | None, to_world: Any = None, **options: Any) -> dict[str, Any]:
    shape = {"type": "rectangle", "to_world": to_world or T().scale(10), **options}
    return shape | ({"bsdf": bsdf} if bsdf else {})


def _scene(**shapes: Any) -> Any:
    shapes.setdefault("sensor", _sensor())
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


def _edge_scene(rfilter: str = "box") -> Any:
    """Return a red plane that ends at x = 0.013 m, 1 m above a blue plane."""
    edge = T().translate([-9.987, 0, 1]).scale(10)
    return _scene(
        red=_plane(_cook_torrance(RED), edge), blue=_plane(_cook_torrance(BLUE)), sensor=_sensor(rfilter)
    )


IDS = {"red": (7, 3), "blue": (9, 4)}


def test_buffers_have_the_registered_names_shapes_and_types() -> None:
    buffers = render_material_buffers(_edge_scene(), spp=4, ids=IDS)
    assert set(buffers) - {"position_world"} == set(GROUND_TRUTH_BUFFERS)
    for name, image in buffers.items():
        assert image.shape == (HEIGHT, WIDTH, len(CHANNELS[name]))
        assert image.dtype == (np.uint32 if name.endswith("_id") else np.float32)
        if name in BUFFERS:
            assert BUFFERS[name].channels == CHANNELS[name]
            assert image.min() >= BUFFERS[name].minimum and image.max() <= BUFFERS[name].maximum


def test_flat_surface_equals_its_parameters() -> None:
    buffers = render_material_buffers(
        _scene(floor=_plane(_cook_torrance(RED))), spp=16, ids={"floor": (5, 6)}
    )
    for name in ("diffuse_albedo", "specular_albedo", "roughness"):
        np.testing.assert_allclose(buffers[name], np.broadcast_to(RED[name], buffers[name].shape), atol=1e-5)
    np.testing.assert_allclose(
        buffers["normal_world"], np.broadcast_to([0, 0, 1.0], (HEIGHT, WIDTH, 3)), atol=1e-6
    )
    np.testing.assert_allclose(buffers["depth_z_m"], CAMERA_HEIGHT, rtol=1e-6)
    assert np.all(buffers["surface_mask"] == 1.0)
    assert np.all(buffers["instance_id"] == 5) and np.all(buffers["material_id"] == 6)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_depth_is_along_the_axis_at_the_pixels_centre(scale: float) -> None:
    """A tilted camera above a plane agrees with the closed-form intersection, from millimetres to 10 km."""
    eye, target = scale * np.array([1.0, -3.0, 2.5]), scale * np.array([0.2, 0.3, 0.1])
    to_world = T().look_at(eye.tolist(), target.tolist(), [0, 0, 1])
    sensor = _sensor(to_world=to_world, near_clip=1e-3 * scale, far_clip=1e3 * scale)
    scene = _scene(floor=_plane(_cook_torrance(RED), T().scale(50 * scale)), sensor=sensor)
    buffers = render_material_buffers(scene, spp=2)
    world_from_camera = np.array(to_world.matrix)
    focal_px = 0.5 * WIDTH / np.tan(np.radians(53.13) / 2)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    # Mitsuba's camera: x left, y up, z forward.
    ray = np.stack([(WIDTH / 2 - x) / focal_px, (HEIGHT / 2 - y) / focal_px, np.ones_like(x)], -1)
    ray_world = ray @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3]
    depth = -origin[2] / ray_world[..., 2]  # rays have z = 1 in camera space: their parameter is depth
    hits = (depth > 0) & (np.abs(origin + depth[..., None] * ray_world) < 50 * scale).all(-1)
    np.testing.assert_allclose(buffers["depth_z_m"][hits][:, 0], depth[hits], rtol=2e-5)
    expected = origin + depth[..., None] * ray_world
    np.testing.assert_allclose(buffers["position_world"][hits], expected[hits], atol=1e-4 * scale)
    assert np.all(buffers["depth_z_m"][~hits] == 0) and np.all(
        buffers["surface_mask"][~hits & (depth < 0)] < 1
    )


def test_edges_blend_channels_but_not_ids_nor_depth() -> None:
    buffers = render_material_buffers(_edge_scene(), spp=256, ids=IDS)
    red_share = (buffers["diffuse_albedo"][..., 0] - 0.05) / 0.65
    mixed = (red_share > 0.02) & (red_share < 0.98)
    assert np.all(mixed.sum(1) == 1)  # the edge crosses one pixel of each row
    for name in ("specular_albedo", "roughness"):
        expected = red_share[..., None] * RED[name] + (1 - red_share[..., None]) * BLUE[name]
        np.testing.assert_allclose(buffers[name], expected, atol=1e-4)
    # Pixel of the edge: x = 0.013 at z = 1 is 0.013 * 48 / (2 tan * 3 m) px from the middle.
    edge_px = WIDTH / 2 + 0.013 * WIDTH / (2 * np.tan(np.radians(53.13) / 2) * 3.0)
    np.testing.assert_allclose(red_share[mixed], edge_px - np.floor(edge_px), atol=5e-3)
    assert set(np.unique(buffers["instance_id"])) == {7, 9}
    assert set(np.unique(buffers["material_id"])) == {3, 4}
    is_red = buffers["instance_id"] == 7
    np.testing.assert_allclose(buffers["depth_z_m"], np.where(is_red, 3.0, 4.0), rtol=1e-6)
    assert np.array_equal(is_red, buffers["material_id"] == 3)
    np.testing.assert_allclose(np.linalg.norm(buffers["normal_world"], axis=2), 1.0, atol=1e-6)


def test_more_samples_change_blends_only() -> None:
    few, many = (render_material_buffers(_edge_scene(), spp=n, ids=IDS) for n in (4, 64))
    for name in ("instance_id", "material_id", "depth_z_m", "position_world"):
        np.testing.assert_array_equal(few[name], many[name])
    again = render_material_buffers(_edge_scene(), spp=4, ids=IDS)
    for name, image in few.items():
        np.testing.assert_array_equal(image, again[name])
    other = render_material_buffers(_edge_scene(), spp=4, seed=1, ids=IDS)
    assert not np.array_equal(few["diffuse_albedo"], other["diffuse_albedo"])


@pytest.mark.parametrize("rfilter", ["box", "tent", "gaussian", "mitchell"])
def test_pixel_filter_is_that_of_the_beauty_image(rfilter: str) -> None:
    """The mask of a surface in front of a black background equals the filtered coverage of Mitsuba's film."""
    # The filter extends beyond the image's border, where the film has no samples.
    tilted = T().translate([0.3, 0.4, 0]).rotate([0, 0, 1], 31).scale(0.9)
    white = {"diffuse_albedo": [0.5, 0.5, 0.5], "specular_albedo": [0.0, 0.0, 0.0], "roughness": 1.0}
    floor = _plane(_cook_torrance(white), tilted)
    scene = _scene(floor=floor, sensor=_sensor(rfilter))
    ours = render_material_buffers(scene, spp=400)["surface_mask"][..., 0]
    aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo"})
    film = np.array(mi.render(scene, integrator=aov, spp=4000))[..., -3] / 0.5
    # A filter's negative lobes make the film overshoot; masks are clipped to [0, 1].
    assert np.abs(ours - np.clip(film, 0, 1)).max() < 0.03
    box = render_material_buffers(_scene(floor=floor), spp=400)["surface_mask"][..., 0]
    is_the_same = np.abs(box - np.clip(film, 0, 1)).max() < 0.03
    assert is_the_same == (rfilter == "box")  # injected fault: another filter's edges differ


def test_sub_pixel_samples_are_even() -> None:
    """At 64 samples an edge's coverage is at least twice as accurate as with independent samples."""
    tilted = T().translate([0.3, 0.1, 0]).rotate([0, 0, 1], 31).scale(0.9)
    scene = _scene(floor=_plane(_cook_torrance(RED), tilted))
    ours, exact = (render_material_buffers(scene, spp=n)["surface_mask"][..., 0] for n in (64, 16384))
    independent = mi.load_dict({"type": "aov", "aovs": "albedo:albedo"})
    albedo = np.array(mi.render(scene, integrator=independent, spp=64))[..., -3]
    share = albedo / ((1 - RED["specular_albedo"][0]) * RED["diffuse_albedo"][0])
    is_edge = (exact > 0.02) & (exact < 0.98)
    error, reference = ((image - exact)[is_edge].std() for image in (ours, share))
    assert is_edge.sum() > 50 and error < 0.5 * reference


def test_depth_of_field_is_that_of_the_beauty_image() -> None:
    """A thin lens blurs the mask as in Mitsuba's film; depth is that of the ray through the lens centre."""
    tilted = T().translate([0.3, 0.1, 0]).rotate([0, 0, 1], 31).scale(0.9)
    white = {"diffuse_albedo": [0.5, 0.5, 0.5], "specular_albedo": [0.0, 0.0, 0.0], "roughness": 1.0}
    lens = _sensor("gaussian") | {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 2.5}
    scene = _scene(floor=_plane(_cook_torrance(white), tilted), sensor=lens)
    ours = render_material_buffers(scene, spp=4096)
    aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo"})
    film = np.array(mi.render(scene, integrator=aov, spp=4096))[..., -3] / 0.5
    mask = ours["surface_mask"][..., 0]
    assert np.abs(mask - np.clip(film, 0, 1)).max() < 0.03
    assert ((mask > 0.02) & (mask < 0.98)).mean() > 0.2  # the mask is blurred
    assert set(np.unique(np.round(ours["depth_z_m"], 4))) == {0.0, CAMERA_HEIGHT}


def test_emitters_and_background_are_masked() -> None:
    lamp = _plane(None, T().translate([-1.0, 0, 1.5]).scale(0.4), emitter={"type": "area"})
    floor = _plane(_cook_torrance(RED), T().scale([10, 0.8, 1]))
    scene = _scene(floor=floor, lamp=lamp, sky={"type": "constant"})
    buffers = render_material_buffers(scene, spp=16, ids={"floor": (1, 1)})
    depth, mask = buffers["depth_z_m"][..., 0], buffers["surface_mask"][..., 0]
    is_lamp, is_sky = np.isclose(depth, CAMERA_HEIGHT - 1.5), depth == 0
    assert is_lamp.sum() > 20 and is_sky.sum() > 20
    assert np.all(buffers["instance_id"][..., 0][is_lamp | is_sky] == 0)
    assert np.all(buffers["material_id"][..., 0] == np.where(is_lamp | is_sky, 0, 1))
    inner = mask[is_lamp | is_sky] == 0
    assert inner.mean() > 0.5  # the other pixels also show the floor
    for name in ("diffuse_albedo", "specular_albedo", "roughness", "normal_world"):
        assert np.all(buffers[name][mask == 0] == 0)
        expected = {"normal_world": [0, 0, 1]}.get(name, RED.get(name))
        np.testing.assert_allclose(
            buffers[name][mask > 0], np.broadcast_to(expected, buffers[name].shape)[mask > 0], atol=1e-5
        )


def test_hidden_emitters_are_seen_through() -> None:
    lamp = _plane(None, T().translate([-1.0, 0, 1.5]).scale(0.4), emitter={"type": "area"})
    scene = _scene(floor=_plane(_cook_torrance(RED)), lamp=lamp)
    buffers = render_material_buffers(scene, spp=4, hide_emitters=True)
    assert np.all(buffers["surface_mask"] == 1)
    np.testing.assert_allclose(buffers["depth_z_m"], CAMERA_HEIGHT, rtol=1e-6)


@pytest.mark.parametrize("opacity", [0.0, 0.3, 0.6, 1.0])
def test_masked_surfaces_blend_by_opacity(opacity: float) -> None:
    veil = {"type": "mask", "opacity": opacity, "nested": _cook_torrance(RED)}
    scene = _scene(red=_plane(veil, T().translate([0, 0, 1]).scale(9)), blue=_plane(_cook_torrance(BLUE)))
    buffers = render_material_buffers(scene, spp=4, ids=IDS)
    for name in ("diffuse_albedo", "specular_albedo", "roughness"):
        expected = opacity * np.array(RED[name]) + (1 - opacity) * np.array(BLUE[name])
        np.testing.assert_allclose(buffers[name], np.broadcast_to(expected, buffers[name].shape), atol=1e-3)
    assert np.all(buffers["instance_id"] == (7 if opacity >= 0.5 else 9))
    np.testing.assert_allclose(buffers["depth_z_m"], 3.0 if opacity >= 0.5 else 4.0, rtol=1e-5)
    np.testing.assert_allclose(buffers["surface_mask"], 1.0, atol=1e-3)


def test_cut_outs_show_surfaces_behind_them() -> None:
    """An opacity texture of 0 and 1 cuts out half of the plane."""
    texels = np.zeros((2, 2, 1), np.float32)
    texels[:, 1] = 1.0
    opacity = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "nearest"}
    leaf = {"type": "mask", "opacity": opacity, "nested": _cook_torrance(RED)}
    scene = _scene(leaf=_plane(leaf, T().translate([0, 0, 1]).scale(10)))
    buffers = render_material_buffers(scene, spp=8, ids={"leaf": (2, 2)})
    left, right = np.s_[:, : WIDTH // 2 - 1], np.s_[:, WIDTH // 2 + 1 :]
    assert np.all(buffers["instance_id"][left] == 0) and np.all(buffers["surface_mask"][left] == 0)
    assert np.all(buffers["instance_id"][right] == 2) and np.all(buffers["surface_mask"][right] == 1)


def _lobe_normal(bsdf: Any, si: Any, num: int = 4096) -> np.ndarray:
    """Estimate the shading normal of a BSDF, in the frame of ``si``: the mean half vector of its samples."""
    rng = np.random.default_rng(3)
    wide = dr.gather(mi.SurfaceInteraction3f, si, dr.zeros(mi.UInt32, num))
    u = rng.uniform(size=(3, num)).astype(np.float32)
    bs, _ = bsdf.sample(mi.BSDFContext(), wide, mi.Float(u[0]), mi.Point2f(mi.Float(u[1]), mi.Float(u[2])))
    half = array(dr.normalize(wide.wi + bs.wo))[array(bs.pdf) > 0].mean(0)
    return half / np.linalg.norm(half)


@pytest.mark.parametrize("wrapping", ["normalmap", "normalmap in twosided", "normalmap in mask"])
@pytest.mark.parametrize("is_back", [False, True])
@pytest.mark.parametrize("encoded", [[0.5, 0.5, 1.0], [0.7, 0.6, 0.9], [0.2, 0.5, 0.85]])
def test_normal_maps_tilt_the_rendered_normal(wrapping: str, is_back: bool, encoded: list[float]) -> None:
    """The buffer's normal is the BSDF's shading normal, from the front and from behind."""
    mirror = {"type": "cook_torrance", "diffuse_albedo": 0.0, "specular_albedo": 1.0, "roughness": 0.1}
    bsdf: dict[str, Any] = {
        "type": "normalmap",
        "normalmap": {"type": "rgb", "value": encoded},
        "nested": mirror,
    }
    if wrapping == "normalmap in twosided":
        mirror["two_sided"] = False
        bsdf = {"type": "twosided", "nested": bsdf}
    elif wrapping == "normalmap in mask":
        bsdf = {"type": "mask", "opacity": 1.0, "nested": bsdf}
    turn = T().rotate([1, 0, 0], 180 if is_back else 0).rotate([0, 0, 1], 20).scale(10)
    scene = _scene(floor=_plane(bsdf, turn))
    buffers = render_material_buffers(scene, spp=4)
    row, column = HEIGHT // 2, WIDTH // 2
    position = mi.Point2f((column + 0.5) / WIDTH, (row + 0.5) / HEIGHT)
    ray, _ = scene.sensors()[0].sample_ray(mi.Float(0), mi.Float(0.5), position, mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    assert (si.wi.z[0] < 0) == is_back
    rendered = array(
        si.to_world(mi.Vector3f(*(float(c) for c in _lobe_normal(scene.shapes()[0].bsdf(), si))))
    )[0]
    got = buffers["normal_world"][row, column]
    np.testing.assert_allclose(got, rendered, atol=5e-3)
    assert np.dot(got, array(si.to_world(si.wi))[0]) > 0
    np.testing.assert_allclose(np.linalg.norm(got), 1.0, atol=1e-6)


def test_back_faces_of_surfaces() -> None:
    """From behind, two-sided surfaces keep their channels and face the viewer; one-sided ones are black."""
    upside_down = T().rotate([1, 0, 0], 180).scale(10)
    buffers = render_material_buffers(_scene(floor=_plane(_cook_torrance(RED), upside_down)), spp=2)
    np.testing.assert_allclose(buffers["diffuse_albedo"][0, 0], RED["diffuse_albedo"], atol=1e-5)
    np.testing.assert_allclose(buffers["normal_world"][0, 0], [0, 0, 1], atol=1e-6)
    one_sided = _cook_torrance(RED, two_sided=False)
    buffers = render_material_buffers(_scene(floor=_plane(one_sided, upside_down)), spp=2)
    assert np.all(buffers["diffuse_albedo"] == 0) and np.all(buffers["surface_mask"] == 1)


def test_front_and_back_have_separate_materials() -> None:
    both = {"type": "twosided", "front": _cook_torrance(RED), "back": _cook_torrance(BLUE)}
    for angle, channels in ((0, RED), (180, BLUE)):
        scene = _scene(floor=_plane(both, T().rotate([1, 0, 0], angle).scale(10)))
        buffers = render_material_buffers(scene, spp=2)
        np.testing.assert_allclose(buffers["roughness"], channels["roughness"], atol=1e-5)


def test_textures_are_exact_texel_by_texel() -> None:
    """With one texel per pixel, nearest-neighbour lookup and a box filter, the buffer equals the texture."""
    rng = np.random.default_rng(4)
    texels = rng.uniform(size=(HEIGHT, WIDTH, 1)).astype(np.float32)
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(texels),
        "raw": True,
        "filter_type": "nearest",
        "format": "variant",
    }
    half_width = CAMERA_HEIGHT * np.tan(np.radians(53.13) / 2)
    fit = T().scale([half_width, half_width * HEIGHT / WIDTH, 1])
    scene = _scene(floor=_plane({"type": "cook_torrance", "roughness": texture}, fit))
    roughness = render_material_buffers(scene, spp=4)["roughness"]
    # Row 0 of a bitmap is at v = 0, the rectangle's lower side.
    matches = np.abs(roughness - texels[::-1])[1:-1, 1:-1] < 1e-3
    assert matches.mean() > 0.99  # rounding may move a sample across a texel's border


def test_crop_window_equals_that_part_of_the_image() -> None:
    whole = render_material_buffers(_edge_scene(), spp=4, ids=IDS)
    crop = {"crop_offset_x": 16, "crop_offset_y": 8, "crop_width": 16, "crop_height": 12}
    edge = T().translate([-9.987, 0, 1]).scale(10)
    scene = _scene(
        red=_plane(_cook_torrance(RED), edge), blue=_plane(_cook_torrance(BLUE)), sensor=_sensor(film=crop)
    )
    part = render_material_buffers(scene, spp=4, ids=IDS)
    for name in ("instance_id", "depth_z_m"):
        np.testing.assert_allclose(part[name], whole[name][8:20, 16:32], rtol=1e-6)


def test_integrator_returns_the_same_values() -> None:
    scene = _edge_scene()
    integrator = mi.load_dict({"type": "material_buffers"})
    image = np.array(mi.render(scene, integrator=integrator, spp=8, seed=3))
    buffers = render_material_buffers(scene, spp=8, seed=3)
    assert len(integrator.aov_names()) == image.shape[2]
    first = 0
    for name, channels in CHANNELS.items():
        np.testing.assert_array_equal(
            image[..., first : first + len(channels)], buffers[name].astype(np.float32)
        )
        first += len(channels)


def test_materials_are_created_once_for_all_views() -> None:
    scene = _edge_scene()
    materials = SceneMaterials(scene, IDS)
    a, b = (render_material_buffers(scene, spp=4, ids=ids) for ids in (materials, IDS))
    for name, image in a.items():
        np.testing.assert_array_equal(image, b[name])


def test_scenes_from_xml_have_distinct_ids() -> None:
    """The project numbers shapes without ids, since Mitsuba assigns none to the shapes of an XML file."""
    xml = """<scene version="3.0.0">
      <shape type="sphere"><bsdf type="cook_torrance"/></shape>
      <shape type="cube"><bsdf type="cook_torrance"/></shape>
    </scene>"""
    table = number_shapes(mi.load_string(xml, optimize=False))
    assert sorted(table.values()) == [(1, 1), (2, 2)]


def test_bsdfs_without_channels_are_refused_by_name() -> None:
    glass = {"type": "dielectric"}
    nested = {"type": "mask", "nested": {"type": "plastic"}}
    scene = _scene(pane=_plane(glass), leaf=_plane(nested), floor=_plane(_cook_torrance(RED)))
    with pytest.raises(InputError) as error:
        render_material_buffers(scene, spp=1)
    message = str(error.value)
    assert "BSDF of shape pane = SmoothDielectric; expected cook_torrance" in message
    assert "BSDF of shape leaf = SmoothPlastic" in message
    assert "floor" not in message


def test_ids_are_checked() -> None:
    scene = _edge_scene()
    with pytest.raises(InputError, match="shape blue = no ids"):
        render_material_buffers(scene, spp=1, ids={"red": (1, 1)})
    with pytest.raises(InputError, match="red: instance id = 0; expected 1"):
        render_material_buffers(scene, spp=1, ids={"red": (0, 1), "blue": (1, 1)})
    with pytest.raises(InputError, match="spp = 0; expected at least 1"):
        render_material_buffers(scene, spp=0)


def test_textures_need_uvs() -> None:
    mesh = mi.Mesh("bare", vertex_count=3, face_count=1)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [-9.0, -9.0, 0.0, 9.0, -9.0, 0.0, 0.0, 9.0, 0.0]
    parameters["faces"] = [0, 1, 2]
    parameters.update()
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)), "raw": True}
    mesh.set_bsdf(mi.load_dict({"type": "cook_torrance", "diffuse_albedo": texture}))
    scene = _scene(bare=mesh)
    with pytest.raises(InputError, match="a mesh without UVs; expected UVs"):
        render_material_buffers(scene, spp=1)
