# SPDX-License-Identifier: MIT
"""Scenes of the scene builder, checked in their rendered ground-truth buffers."""

from __future__ import annotations

import colorsys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.formats.asset import Material, SlotMaterial, Texture
from datagen.formats.configuration import ColorAdjustment, MaterialAssignment, PlacedAsset
from datagen.formats.lights import PointLight
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import linear_from_srgb
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.mesh import Mesh
from datagen.library import Library
from datagen.rendering.renderer import SceneRenderer
from datagen.rendering.scene_builder import build_scene
from datagen.rendering.view_job import RenderedView, RenderError
from oracles.rendering_scenes import GREY, SmallScene, box, configure, down_camera, placed, quad, renderer

pytestmark = pytest.mark.usefixtures("mitsuba_variant")

LAMP = (PointLight(name="lamp", position_m=(0.0, 0.0, 3.0), intensity=(10.0, 10.0, 10.0)),)
RECIPE = RenderRecipe(path_samples=4, auxiliary_samples=16, max_depth=2, denoise=False)
UNIT_FLOOR = {"floor": (quad([-0.5, -0.5, 0], [1, 0, 0], [0, 1, 0]), "grey")}


def look_down(scene: SmallScene, tmp_path: Path, size: int = 32, **fields: Any) -> RenderedView:
    """Render the unit square around the origin from above, with columns along +x and row 0 at +y."""
    camera = down_camera(size, size, 1.0)
    return renderer(tmp_path, scene, [camera], RECIPE, **{"lights": LAMP, **fields}).render_view(0)


def quadrants(image: np.ndarray) -> list[np.ndarray]:
    """Return the means of the centres of quadrants: top left, top right, bottom left, bottom right."""
    n = len(image) // 2
    inner = slice(n // 4, 3 * n // 4)
    halves = [image[:n], image[n:]]
    return [h[:, c][inner, inner].mean(axis=(0, 1)) for h in halves for c in (slice(0, n), slice(n, 2 * n))]


def blocks(size: int = 32) -> np.ndarray:
    """Return a texture (size, size, 3) of four colour blocks."""
    colors = np.array([[200, 40, 40], [30, 180, 60], [20, 60, 220], [128, 128, 128]], np.uint8)
    pixels = np.zeros((size, size, 3), np.uint8)
    h = size // 2
    for k, (row, column) in enumerate(((0, 0), (0, h), (h, 0), (h, h))):
        pixels[row : row + h, column : column + h] = colors[k]
    return pixels


BLOCK_COLORS = np.array([[200, 40, 40], [30, 180, 60], [20, 60, 220], [128, 128, 128]]) / 255.0


def textured(texture: Texture, **fields: Any) -> SmallScene:
    return SmallScene(
        parts=dict(UNIT_FLOOR),
        slots={"grey": GREY.model_copy(update={"diffuse_albedo": texture, **fields})},
        files={texture.texture: encode_png(blocks())},
    )


def test_srgb_texture_is_decoded_and_upright(tmp_path: Path) -> None:
    view = look_down(textured(Texture(texture="t.png", encoding="srgb")), tmp_path)
    found = quadrants(view.buffers["diffuse_albedo"])
    assert np.array(found) == pytest.approx(linear_from_srgb(BLOCK_COLORS), abs=1e-3)


def test_linear_texture_with_scale_and_offset(tmp_path: Path) -> None:
    texture = Texture(texture="t.png", encoding="linear", scale=0.5, offset=0.25)
    view = look_down(textured(texture), tmp_path)
    expected = 0.5 * BLOCK_COLORS + 0.25
    assert np.array(quadrants(view.buffers["diffuse_albedo"])) == pytest.approx(expected, abs=1e-3)


def test_scalar_channels_pick_their_component(tmp_path: Path) -> None:
    texture = Texture(texture="t.png", encoding="linear", channel="g")
    scene = textured(texture, diffuse_albedo=(0.2, 0.3, 0.4), roughness=texture)
    view = look_down(scene, tmp_path)
    found = np.array(quadrants(view.buffers["roughness"]))[:, 0]
    assert found == pytest.approx(BLOCK_COLORS[:, 1], abs=1e-3)
    assert view.buffers["diffuse_albedo"][8, 8] == pytest.approx([0.2, 0.3, 0.4], abs=1e-3)


def test_assigned_material_covers_its_tile_size(tmp_path: Path) -> None:
    tiles = Material(
        classes=("stone",),
        diffuse_albedo=Texture(texture="t.png", encoding="linear"),
        tile_size_m=0.25,
    )
    scene = SmallScene(
        parts=dict(UNIT_FLOOR), materials={"tiles": (tiles, {"t.png": encode_png(blocks())})}, uv_per_m=1.0
    )

    def columns(root: Path, assignment: MaterialAssignment, scale: float = 1.0) -> np.ndarray:
        room = PlacedAsset(
            name="room",
            asset="room",
            materials={"grey": assignment},
            world_from_asset=placed(0, 0, scale=scale),
        )
        view = look_down(scene, root, 64, environment=room)
        return view.buffers["diffuse_albedo"][36, :, 0].astype(float)  # crosses blue and grey blocks

    def period(row: np.ndarray) -> float:
        spectrum = np.abs(np.fft.rfft(row - row.mean()))
        return len(row) / int(spectrum.argmax()) / len(row)

    assert period(columns(tmp_path / "a", MaterialAssignment(asset="tiles"))) == pytest.approx(0.25)
    # tiles keep their size on a floor twice as large
    assert period(columns(tmp_path / "b", MaterialAssignment(asset="tiles"), 2.0)) == pytest.approx(0.25)
    fixed = MaterialAssignment(asset="tiles", uv_scale=8.0)
    assert period(columns(tmp_path / "c", fixed)) == pytest.approx(0.125)


def test_adjustment_of_a_texture_is_in_the_ground_truth(tmp_path: Path) -> None:
    adjustment = ColorAdjustment(hue_shift=0.2, saturation_scale=0.7, value_scale=0.8, roughness_offset=0.15)
    texture = Texture(texture="t.png", encoding="linear")
    scene = textured(texture, roughness=0.4, specular_albedo=(0.8, 0.5, 0.2))
    room = PlacedAsset(
        name="room", asset="room", materials={"grey": MaterialAssignment(adjustment=adjustment)}
    )
    view = look_down(scene, tmp_path, environment=room)

    def varied(color: Any, value_scale: float) -> list[float]:
        hue, saturation, value = colorsys.rgb_to_hsv(*color)
        return list(colorsys.hsv_to_rgb((hue + 0.2) % 1, saturation * 0.7, min(value * value_scale, 1)))

    expected = [varied(color, 0.8) for color in BLOCK_COLORS]
    assert np.array(quadrants(view.buffers["diffuse_albedo"])) == pytest.approx(np.array(expected), abs=1e-3)
    specular = varied((0.8, 0.5, 0.2), 1.0)  # the value of S is never scaled
    assert view.buffers["specular_albedo"][4, 4] == pytest.approx(specular, abs=1e-3)
    assert view.buffers["roughness"].max() == pytest.approx(0.55, abs=1e-3)


def test_grey_specular_albedo_is_never_recoloured(tmp_path: Path) -> None:
    adjustment = ColorAdjustment(hue_shift=0.3, saturation_scale=4.0, value_scale=2.0)
    room = PlacedAsset(
        name="room", asset="room", materials={"grey": MaterialAssignment(adjustment=adjustment)}
    )
    slots = {"grey": GREY.model_copy(update={"specular_albedo": (0.04, 0.04, 0.04)})}
    view = look_down(SmallScene(parts=dict(UNIT_FLOOR), slots=slots), tmp_path, environment=room)
    assert view.buffers["specular_albedo"] == pytest.approx(0.04, abs=1e-4)


def test_normal_map_tilts_the_normal_also_on_mirrored_uvs(tmp_path: Path) -> None:
    tilted = np.array([0.3, 0.4, np.sqrt(1 - 0.25)])
    texel = np.round((tilted + 1) / 2 * 65535).astype(np.uint16)
    image = encode_png(np.broadcast_to(texel, (4, 4, 3)).copy())
    slots = {"grey": GREY.model_copy(update={"normal": Texture(texture="n.png", encoding="linear")})}
    left = quad([-0.5, -0.5, 0], [0.5, 0, 0], [0, 1, 0])
    right = quad([0, -0.5, 0], [0.5, 0, 0], [0, 1, 0], flip_u=True)
    scene = SmallScene({"left": (left, "grey"), "right": (right, "grey")}, slots, {"n.png": image})
    view = look_down(scene, tmp_path)
    normal = view.buffers["normal_world"]
    assert normal[16, 4] == pytest.approx(tilted, abs=2e-3)
    # u increases towards -x there, so the tangent is flipped but the bitangent (v) is not
    assert normal[16, 28] == pytest.approx(tilted * [-1, 1, 1], abs=2e-3)


def two_boxes(tmp_path: Path, camera: Camera) -> SceneRenderer:
    skin = SlotMaterial(diffuse_albedo=(0.2, 0.4, 0.6))
    scene = SmallScene(objects={"box": (box(0.5), skin)})
    varied = {"skin": MaterialAssignment(adjustment=ColorAdjustment(hue_shift=0.5))}
    objects = (
        PlacedAsset(name="box-1", asset="box", world_from_asset=placed(-0.6, 0.1, 0.4)),
        PlacedAsset(name="box-2", asset="box", world_from_asset=placed(0.7, 0.3, 1.0, 1.6), materials=varied),
        PlacedAsset(name="box-3", asset="box", world_from_asset=placed(0.0, 1.2, 2.0, 0.5)),
    )
    return renderer(tmp_path, scene, [camera], RECIPE, lights=LAMP, objects=objects)


OFF_CENTRE = Camera(
    96, 64, 80.0, 64.0, 41.0, 38.5, look_at([0.3, -2.5, 1.4], [0.1, 0.3, 0.3], up=(0.1, 0.0, 1.0))
)


def test_ids_depth_and_names_agree_with_the_placed_geometry(tmp_path: Path) -> None:
    """Unprojected pixels are on their boxes for non-square pixels, an off-centre principal point and roll."""
    rendered = two_boxes(tmp_path, OFF_CENTRE)
    view = rendered.render_view(0)
    assert view.instances == {"1": "room/floor", "2": "box-1", "3": "box-2", "4": "box-3"}
    assert view.materials == {"1": "room/grey", "2": "box/skin", "3": "box/skin#2"}
    points = OFF_CENTRE.unproject(OFF_CENTRE.pixel_centers(), view.buffers["depth_z_m"][..., 0])
    instance = view.buffers["instance_id"][..., 0]
    material = view.buffers["material_id"][..., 0]
    for number, placed_asset in enumerate(rendered.configuration.objects, start=2):
        mask = instance == number
        assert mask.sum() > 20
        to_asset = np.linalg.inv(np.array(placed_asset.world_from_asset))
        local = points[mask] @ to_asset[:3, :3].T + to_asset[:3, 3] - [0, 0, 0.25]
        assert np.abs(local).max(axis=1) == pytest.approx(0.25, abs=2e-4)  # on the cube's surface
        assert (material[mask] == (3 if number == 3 else 2)).all()
    floor = instance == 1
    assert np.abs(points[floor][:, 2]).max() < 1e-4
    assert (instance[view.buffers["depth_z_m"][..., 0] == 0] == 0).all()


def test_camera_shows_only_between_its_clip_depths(tmp_path: Path) -> None:
    """Surfaces nearer than the near plane reveal those behind; beyond the far plane is background."""
    near, far = 2.6, 3.4
    clipped = replace(OFF_CENTRE, clip_m=(near, far))
    full = two_boxes(tmp_path / "full", OFF_CENTRE).render_view(0).buffers["depth_z_m"][..., 0]
    depth = two_boxes(tmp_path / "clipped", clipped).render_view(0).buffers["depth_z_m"][..., 0]
    is_between = (full > near) & (full < far)
    assert min(is_between.sum(), ((full > 0) & (full < near)).sum(), (full > far).sum()) > 100
    assert depth[is_between] == pytest.approx(full[is_between], rel=1e-5)
    assert (depth[(full == 0) | (full > far)] == 0).all()
    behind = depth[(full > 0) & (full < near)]
    assert (behind > 0).sum() > 20, "what stood behind the clipped surfaces shows"
    assert ((behind == 0) | ((behind > near) & (behind < far))).all()


def test_corner_of_a_box_hits_the_expected_pixel(tmp_path: Path) -> None:
    rendered = two_boxes(tmp_path, OFF_CENTRE)
    instance = rendered.render_view(0).buffers["instance_id"][..., 0]
    pose = np.array(rendered.configuration.objects[1].world_from_asset)
    corners = np.array([[x, y, z, 1.0] for x in (-0.25, 0.25) for y in (-0.25, 0.25) for z in (0, 0.5)])
    pixels, _ = OFF_CENTRE.project((corners @ pose.T)[:, :3])
    rows, columns = np.nonzero(instance == 3)
    assert columns.min() == pytest.approx(np.ceil(pixels[:, 0].min() - 0.5), abs=0.6)
    assert columns.max() == pytest.approx(np.floor(pixels[:, 0].max() - 0.5), abs=0.6)
    assert rows.min() == pytest.approx(np.ceil(pixels[:, 1].min() - 0.5), abs=0.6)
    assert rows.max() == pytest.approx(np.floor(pixels[:, 1].max() - 0.5), abs=0.6)


def test_beauty_and_buffers_have_the_same_camera(tmp_path: Path) -> None:
    """The luminous panel's centroid in the beauty image is at the projection of its centre."""
    scene = SmallScene()
    scene.slots["glow"] = SlotMaterial(emission=(50.0, 50.0, 50.0))
    scene.parts["panel"] = (quad([0.3, 0.2, 0.5], [0.2, 0, 0], [0, 0, 0.2]), "glow")  # faces -y
    recipe = RECIPE.model_copy(update={"path_samples": 256})
    view = renderer(tmp_path, scene, [OFF_CENTRE], recipe).render_view(0)
    bright = np.where(view.buffers["beauty"][..., 0] > 1.0, view.buffers["beauty"][..., 0], 0.0)
    centroid = (OFF_CENTRE.pixel_centers() * bright[..., None]).sum(axis=(0, 1)) / bright.sum()
    expected, _ = OFF_CENTRE.project([0.4, 0.2, 0.6])
    assert centroid == pytest.approx(expected, abs=0.15)
    share = view.buffers["surface_mask"][..., 0]
    assert (share[bright > 49] == 0).all()


def test_mirrored_placement_keeps_its_orientation(tmp_path: Path) -> None:
    scene = SmallScene(objects={"box": (box(0.5), GREY)})
    mirrored = ((-1.0, 0, 0, 0.2), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0))
    objects = (PlacedAsset(name="box", asset="box", world_from_asset=mirrored),)
    view = renderer(tmp_path, scene, [OFF_CENTRE], RECIPE, lights=LAMP, objects=objects).render_view(0)
    normal, instance = view.buffers["normal_world"], view.buffers["instance_id"][..., 0]
    to_camera = OFF_CENTRE.position_m - OFF_CENTRE.unproject(
        OFF_CENTRE.pixel_centers(), view.buffers["depth_z_m"][..., 0]
    )
    assert ((normal * to_camera).sum(axis=-1)[instance == 2] > 0).all()


def test_emission_can_be_replaced_and_turned_off(tmp_path: Path) -> None:
    scene = SmallScene()
    scene.slots["glow"] = SlotMaterial(diffuse_albedo=(0.1, 0.2, 0.3), emission=(5.0, 5.0, 5.0))
    scene.parts["panel"] = (quad([-0.5, -0.5, 0.2], [1, 0, 0], [0, 1, 0]), "glow")
    off = PlacedAsset(name="room", asset="room", emission={"glow": (0.0, 0.0, 0.0)})
    view = look_down(scene, tmp_path / "off", environment=off)
    assert view.buffers["diffuse_albedo"][16, 16] == pytest.approx([0.1, 0.2, 0.3], abs=1e-3)
    assert view.buffers["surface_mask"].min() == 1.0
    other = PlacedAsset(name="room", asset="room", emission={"glow": (1.0, 2.0, 3.0)})
    view = look_down(scene, tmp_path / "other", environment=other, lights=())
    assert view.buffers["beauty"][16, 16] == pytest.approx([1.0, 2.0, 3.0], rel=1e-5)


def test_every_problem_of_a_configuration_is_named_at_once(tmp_path: Path) -> None:
    scene = textured(Texture(texture="t.png", encoding="srgb"))
    scene.parts["floor"] = (quad([0, 0, 0], [1, 0, 0], [0, 1, 0], has_uv=False), "grey")
    library = scene.write(tmp_path)
    room = PlacedAsset(name="room", asset="room", materials={"wall": MaterialAssignment()})
    configuration = configure(library, [down_camera()], environment=room)
    with pytest.raises(InputError) as caught:
        build_scene(configuration, library)
    text = str(caught.value)
    assert "no such slot" in text and "texture coordinates" in text and "floor" in text


def test_package_that_differs_from_the_plan_is_refused(tmp_path: Path) -> None:
    library = SmallScene().write(tmp_path)
    configuration = configure(library, [down_camera()])
    configuration = configuration.model_copy(update={"assets": {"room": "0" * 64}})
    with pytest.raises(InputError, match=r"assets\.room"):
        build_scene(configuration, library)


def test_broken_mesh_and_texture_are_refused_with_their_file(tmp_path: Path) -> None:
    mesh = quad([0, 0, 0], [1, 0, 0], [0, 1, 0])
    bad = Mesh(np.where(mesh.positions > 0.5, np.nan, mesh.positions), mesh.faces, mesh.normals, mesh.uv)
    library = SmallScene(parts={"floor": (bad, "grey")}).write(tmp_path)
    with pytest.raises(InputError, match=r"floor\.ply"):
        build_scene(configure(library, [down_camera()]), library)
    scene = textured(Texture(texture="t.png", encoding="srgb"))
    scene.files["t.png"] = b"not a picture"
    library = scene.write(tmp_path / "second")
    with pytest.raises(InputError, match=r"t\.png"):
        build_scene(configure(library, [down_camera()]), library)


def test_a_view_with_inf_is_an_error_that_names_it(tmp_path: Path) -> None:
    light = PointLight(name="l", position_m=(0.0, 0.0, 1e-15), intensity=(3e38, 3e38, 3e38))
    with pytest.raises(RenderError, match="view_0"):
        renderer(tmp_path, lights=(light,)).render_view(0)


def test_meshes_and_textures_are_cached_across_configurations(tmp_path: Path) -> None:
    from datagen.rendering.scene_builder import AssetCaches

    library = textured(Texture(texture="t.png", encoding="srgb")).write(tmp_path)
    caches = AssetCaches()
    configuration = configure(library, [down_camera()], lights=LAMP)
    SceneRenderer(configuration, library, RECIPE, caches)
    meshes, textures = caches.meshes.num_bytes, caches.textures.num_bytes
    assert meshes > 0 and textures == 32 * 32 * 3 * 2
    SceneRenderer(configuration, library, RECIPE, caches)
    assert (caches.meshes.num_bytes, caches.textures.num_bytes) == (meshes, textures)
    assert isinstance(library, Library)


def test_cut_out_shows_surfaces_behind_it(tmp_path: Path) -> None:
    """The left half of the opacity texture is a hole, the right half is opaque."""
    alpha = np.zeros((32, 32, 1), np.uint8)
    alpha[:, 16:] = 255
    scene = SmallScene(files={"a.png": encode_png(alpha)})
    opacity = Texture(texture="a.png", encoding="linear", channel="r")
    scene.slots["leaf"] = GREY.model_copy(update={"opacity": opacity, "diffuse_albedo": (0.1, 0.6, 0.1)})
    scene.parts["leaf"] = (quad([-0.5, -0.5, 0.01], [1, 0, 0], [0, 1, 0]), "leaf")
    view = look_down(scene, tmp_path)
    left, right = np.s_[16, 4], np.s_[16, 28]
    assert view.buffers["diffuse_albedo"][left] == pytest.approx(0.5, abs=1e-3)
    assert view.buffers["diffuse_albedo"][right] == pytest.approx([0.1, 0.6, 0.1], abs=1e-3)
    assert view.instances[str(view.buffers["instance_id"][left][0])] == "room/floor"
    assert view.instances[str(view.buffers["instance_id"][right][0])] == "room/leaf"
    assert view.buffers["beauty"][left].max() > 0.05  # the lamp shines through the hole


def test_room_without_lights_is_black_and_valid(tmp_path: Path) -> None:
    view = renderer(tmp_path, None, [down_camera()], RECIPE).render_view(0)
    assert view.buffers["beauty"].max() == 0.0
    assert view.buffers["surface_mask"].min() == 1.0
