# SPDX-License-Identifier: MIT
"""Windows and skies: openings of the room, near and far backgrounds, and orientation of sky images."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.formats.asset import EnvironmentAsset
from datagen.formats.capture import CaptureGeometry, GeometryPart
from datagen.formats.lights import EnvironmentLight
from datagen.formats.package import open_package
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import decode_ply
from datagen.foundation.rectangles import largest_rectangle
from datagen.geometry.traced import TracedGeometry, ViewGeometry, smooth_regions
from datagen.geometry.views import TracedView
from datagen.light.background import (
    FAR,
    NEAR,
    Background,
    OutsidePixels,
    box_squares,
    is_far,
    photographed_background,
)
from datagen.light.emitters import Emitters
from datagen.light.lighting import Lit, light_surfels
from model.reconstruction.atlas.atlas import empty_atlas
from model.reconstruction.export.asset import write_asset
from model.reconstruction.export.atlas_images import write_atlas_images
from model.reconstruction.export.gltf import write_glb
from model.reconstruction.export.mitsuba_scene import write_mitsuba_scene
from model.reconstruction.export.slots import Reconstruction
from model.reconstruction.found_lights import (
    FoundLamp,
    FoundLights,
    FoundPatch,
    FoundSun,
    Rectangle,
    lights_text,
)
from model.reconstruction.light.found import HEIGHT, direction_vectors, directions_of, found_lights, sky_image
from model.reconstruction.light.lamps import found_lamps, found_panels
from model.reconstruction.light.openings import FINE, LeavingRays, found_openings
from model.reconstruction.light.options import LightOptions
from model.reconstruction.light.rectangles import cover, cut
from oracles.textured_room import room_capture
from tests.conftest import REPOSITORY
from tests.model.light_room import LAMP, photographed_room, quads, room_geometry
from tests.model.test_found_lights import glb_document
from tests.model.test_reconstruction_assets import VALIDATOR, needs_bpy
from tests.model.test_reconstruction_robustness import small_files

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
LOW, HIGH = np.zeros(3), np.array([4.0, 3.0, 2.5])


def background() -> Background:
    """A background used only for the corners of its box."""
    return Background(LOW, HIGH, np.zeros((0, 3), np.float32), np.zeros(0, bool), np.zeros(0, bool))


def bundle(
    num: int, corner: tuple[float, float, float], size: tuple[float, float], seed: int = 0
) -> LeavingRays:
    """Rays from random points of the room through a window in a plane of constant x to the box."""
    random = np.random.default_rng(seed)
    origin = random.uniform(0, 1, (num, 3)) * [corner[0] - 0.3, *HIGH[1:]]
    through = np.array(corner) + random.uniform(0, 1, (num, 3)) * [0, *size]
    direction = through - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    face, _ = box_squares(origin, direction, LOW, HIGH, FINE)
    radiance = np.tile(np.array([1, 2, 3], np.float32), (num, 1)) * (1 + through[:, 1:2] - corner[1])
    return LeavingRays(origin, direction, face, radiance.astype(np.float32), np.ones(num, bool))


def test_window_is_where_rays_are_closest() -> None:
    """A window 0.4 m inside of the box is found, although its rays cover 1.5 times its area on the box."""
    rays = bundle(60_000, (3.6, 0.8, 0.9), (1.2, 1.0))
    (window,) = found_openings(rays, background(), 1.0)
    assert window.area_m2 == pytest.approx(1.2, rel=0.06)
    np.testing.assert_allclose(window.place_m, [3.6, 1.4, 1.4], atol=0.08)
    np.testing.assert_allclose(window.radiance, [1.6, 3.2, 4.8], rtol=0.05)
    sent = sum(r.area_m2 * np.array(r.radiance) for r in window.rectangles)
    np.testing.assert_allclose(sent, window.area_m2 * np.array(window.radiance), rtol=1e-6)
    left, right = (f(window.rectangles, key=lambda r: r.origin_m[1]).radiance[0] for f in (min, max))
    assert left < 1.4 < 1.8 < right  # the gradient is kept
    for rectangle in window.rectangles:
        assert np.cross(rectangle.edge_u_m, rectangle.edge_v_m)[0] < 0  # into the room


def test_adjacent_openings_are_separate_and_dark_ones_dropped() -> None:
    first, second = (
        bundle(40_000, (3.9, 0.3, 0.9), (0.8, 1.0)),
        bundle(20_000, (3.9, 2.0, 0.9), (0.5, 0.6), 1),
    )
    both = LeavingRays(
        *(np.concatenate([getattr(first, k), getattr(second, k)]) for k in first.__dataclass_fields__)
    )
    windows = found_openings(both, background(), 1.0)
    assert len(windows) == 2
    np.testing.assert_allclose([w.area_m2 for w in windows], [0.8, 0.3], rtol=0.15)
    assert found_openings(both, background(), 1e5) == ()


def test_hole_of_the_mesh_is_no_window() -> None:
    """The mesh lacks a dark tile and the northern 25 cm of the red wall: two holes beside one window."""
    whole = room_geometry()
    corners = whole.mesh.positions.reshape(-1, 4, 3).copy()
    names = [quad.name for quad in quads()]
    west, tile = names.index("west"), names.index("tile-3-2")
    corners[west, :, 1] = np.minimum(corners[west, :, 1], 2.75)
    corners[tile] = corners[tile, :1] + 0.002 * (corners[tile] - corners[tile, :1])
    geometry = replace(whole, mesh=replace(whole.mesh, positions=corners.reshape(-1, 3)))
    traced = TracedGeometry(geometry)
    views = [replace(v, geometry=traced.trace_view(v.camera)) for v in photographed_room()]
    regions = smooth_regions(traced.mesh)
    lit = light_surfels(views, traced, geometry.emitter_mask(), regions, LightOptions())
    found = found_lights(lit, traced, geometry)
    (window,) = found.windows
    np.testing.assert_allclose(window.place_m, [4.0, 1.5, 1.4], atol=0.06)
    assert [window.slot, *(hole.slot for hole in found.holes)] == ["window-0", "hole-0", "hole-1"]
    on_wall, in_floor = found.holes  # by power
    np.testing.assert_allclose(on_wall.place_m, [0, 2.875, 1.25], atol=0.1)
    np.testing.assert_allclose(in_floor.place_m, [1.75, 1.25, 0], atol=0.1)
    np.testing.assert_allclose([on_wall.area_m2, in_floor.area_m2], [0.625, 0.25], rtol=0.2)
    assert [row["slot"] for row in found.described()] == ["lamp-0", "window-0"]
    assert [row["slot"] for row in found.described_holes()] == ["hole-0", "hole-1"]


def test_rectangles_of_a_mask() -> None:
    """The largest rectangles have the areas found by exhaustive search in small random masks."""
    random = np.random.default_rng(2)
    for _ in range(30):
        mask = random.random((7, 9)) < 0.7
        top, bottom, left, right = largest_rectangle(mask)
        assert mask[top:bottom, left:right].all()
        best = max(
            (r1 - r0) * (c1 - c0)
            for r0 in range(7)
            for r1 in range(r0 + 1, 8)
            for c0 in range(9)
            for c1 in range(c0 + 1, 10)
            if mask[r0:r1, c0:c1].all()
        )
        assert (bottom - top) * (right - left) == best
    corner = np.ones((10, 10), bool)
    corner[5:, 5:] = False
    pieces = [piece for block in cover(corner) for piece in cut(block, 4)]
    painted = np.zeros((10, 10), int)
    for row, column, rows, columns in pieces:
        assert max(rows, columns) <= 4
        painted[row : row + rows, column : column + columns] += 1
    np.testing.assert_array_equal(painted, corner)


def pixels_of(color_of: object, num_views: int = 12) -> OutsidePixels:
    random = np.random.default_rng(4)
    eye = random.uniform(0.2, 0.8, (num_views, 3)) * HIGH
    origin = eye.repeat(500, axis=0)
    through = np.array([4.0, 0.6, 0.6]) + random.uniform(0, 1, origin.shape) * [0, 1.8, 1.3]
    direction = (through - origin) / np.linalg.norm(through - origin, axis=1, keepdims=True)
    color = np.asarray(color_of(through, direction), np.float32)[:, None] * np.ones(3, np.float32)  # type: ignore[operator]
    return OutsidePixels(origin, direction, color, np.arange(num_views).repeat(500))


def test_far_and_near_light_are_distinguished() -> None:
    def far(through: NDArray, direction: NDArray) -> NDArray:
        return np.asarray(1 + 0.9 * np.sin(6 * direction[:, 1]) * np.cos(5 * direction[:, 2]))

    def near(through: NDArray, direction: NDArray) -> NDArray:
        return np.asarray(1 + 0.9 * np.sin(4 * through[:, 1]) * np.cos(4 * through[:, 2]))

    assert is_far(pixels_of(far), LOW, HIGH)
    assert not is_far(pixels_of(near), LOW, HIGH)
    assert not is_far(pixels_of(lambda through, direction: np.ones(len(through))), LOW, HIGH)


def glow(direction: NDArray) -> NDArray[np.float64]:
    """Radiance of a sky that is 50 times as bright at the sun as elsewhere."""
    to_sun = direction @ np.array([0.8, 0.0, 0.6])
    return np.asarray(1 + 50 * np.exp(20 * (to_sun - 1)))


def test_sky_with_a_glow_is_stored_by_direction() -> None:
    """Stored by direction, a glow is accurate in photographed directions and estimated elsewhere; bins of
    positions, with few pixels each, hardly contain it."""
    random = np.random.default_rng(5)
    views = []
    for number in range(12):
        eye = random.uniform(0.2, 0.8, 3) * HIGH
        way = np.array([np.cos(0.1 * number), np.sin(0.1 * number), 0.3 + 0.05 * number])
        pose = look_at(eye, eye + way)
        camera = Camera(64, 48, 42.0, 42.0, 32.0, 24.0, pose)
        color = glow(camera.ray_directions())[..., None] * np.ones(3)
        none = np.zeros((48, 64, 1), np.float32)
        nothing = ViewGeometry(
            none, none.repeat(3, 2), none, np.full((48, 64), -1, np.int32), none[..., 0] > 0
        )
        views.append(TracedView(camera, color.astype(np.float32), nothing, np.ones((48, 64), bool)))
    found = photographed_background(views, LOW, HIGH)
    assert found.layout is FAR
    origin = random.uniform(0.1, 0.9, (4000, 3)) * HIGH
    seen = random.normal([0.8, 0.3, 0.4], 0.15, (4000, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)

    def error(background: Background) -> float:
        bins = background.layout.bins_of(origin, seen, LOW, HIGH)
        known = background.is_photographed[bins]
        assert known.mean() > 0.9
        return float(np.abs(np.log(background.radiance[bins, 1] / glow(seen)))[known].mean())

    assert error(found) < 0.1
    assert error(photographed_background(views, LOW, HIGH, NEAR)) > 0.2
    away = np.array([[-1.0, 0, 0], [0.8, 0.3, 0.4]])
    bins = FAR.bins_of(origin[:2], away / np.linalg.norm(away, axis=1, keepdims=True), LOW, HIGH)
    np.testing.assert_array_equal(found.is_photographed[bins], [False, True])


def test_image_of_the_sky_has_the_directions_of_rays() -> None:
    radiance = np.zeros((FAR.num_bins, 3), np.float32)
    ways = np.array([[0, 1.0, 0.01], [0, -1.0, 0.2]])
    bins = FAR.bins_of(np.zeros((2, 3)), ways, LOW, HIGH)
    radiance[bins] = [[1, 2, 3], [5, 1, 1]]
    known = np.isin(np.arange(FAR.num_bins), bins)
    image = sky_image(Background(LOW, HIGH, radiance, known, known, FAR))
    np.testing.assert_array_equal(image[HEIGHT // 2, HEIGHT], [1, 2, 3])  # the centre looks along +Y
    np.testing.assert_array_equal(image[HEIGHT // 2, 0], [5, 1, 1])  # -Y: no bin there, the nearest
    ways = direction_vectors(HEIGHT)
    np.testing.assert_array_equal(directions_of(ways, HEIGHT), np.arange(len(ways)))
    dark = np.zeros((FAR.num_bins, 3), np.float32)
    dark[bins[0]] = 1  # not lost between the centres of the pixels
    assert sky_image(Background(LOW, HIGH, dark, dark[:, 0] >= 0, known, FAR)).max() > 0.3


def test_unnamed_lamp_is_found() -> None:
    """In front of a lamp that the geometry does not name, a panel of equal power is found."""
    named = room_geometry()
    parts = tuple(replace(part, emission=None) for part in named.parts)
    options = LightOptions(irradiance_rays=24, estimate_rays=16)

    def lit_by(geometry: CaptureGeometry) -> Lit:
        traced = TracedGeometry(geometry)
        views = [replace(v, geometry=traced.trace_view(v.camera)) for v in photographed_room()]
        emits = geometry.emitter_mask()
        return light_surfels(views, traced, emits, smooth_regions(traced.mesh), options)

    lit = lit_by(CaptureGeometry(named.mesh, parts))
    (panel,) = found_panels(lit)
    np.testing.assert_allclose(panel.place_m, [2.0, 1.5, 2.48], atol=0.03)
    assert panel.area_m2 == pytest.approx(1.0, rel=0.1)
    power = np.array(LAMP)
    np.testing.assert_allclose(panel.area_m2 * np.array(panel.radiance), power, rtol=0.05)
    sent = sum(r.area_m2 * np.array(r.radiance) for r in panel.rectangles)
    np.testing.assert_allclose(sent, power, rtol=0.05)
    for rectangle in panel.rectangles:
        assert np.cross(rectangle.edge_u_m, rectangle.edge_v_m)[2] < 0
        assert 2.4 < rectangle.origin_m[2] < 2.48  # between surface and room
    hardly_seen = replace(lit.irradiance, photographed=0.4 * lit.irradiance.photographed)
    assert found_panels(replace(lit, irradiance=hardly_seen)) == ()
    dark = lit_by(named)
    assert found_panels(dark) == ()  # counterpart: the lamp is named, and nothing else emits
    # a bright panel on the floor is found, equally bright light of a hidden lamp is not
    distance = np.linalg.norm(dark.surfels.position_m - [1.2, 1.5, 0.0], axis=1)
    assert len(found_panels(_brightened(dark, np.where(distance < 0.4, 9.0, 1.0)))) == 1
    assert found_panels(_brightened(dark, 1 + 8 * np.exp(-np.square(distance / 0.5)))) == ()


def _brightened(lit: Lit, factor: NDArray) -> Lit:
    """``lit`` with the radiance of surfels and their observations times ``factor`` (N,)."""
    surfels, observations = lit.surfels, lit.surfels.observations
    seen = observations.radiance * factor[surfels.surfel_of_observation(), None]
    seen = replace(observations, radiance=seen.astype(np.float32))
    radiance = (surfels.radiance * factor[:, None]).astype(np.float32)
    return replace(lit, surfels=replace(surfels, radiance=radiance, observations=seen))


def exported(folder: Path, lights: FoundLights) -> Reconstruction:
    capture = room_capture(2, (32, 24))
    atlas = empty_atlas(16)
    atlas.face[:] = 0
    write_atlas_images(folder / "atlas", atlas, has_exr=False)
    return Reconstruction(capture, capture.geometry.mesh, atlas, folder / "atlas", lights)


PANEL = Rectangle((9.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (2.0, 2.0, 2.0))
WINDOW = FoundPatch("window-0", (PANEL,), (9.0, 0.5, 0.5), 1.0, (2.0, 2.0, 2.0))


def test_names_of_views_may_be_those_of_surfaces_and_lights(tmp_path: Path) -> None:
    """Ids of the Mitsuba scene are unique, and other views keep their names."""
    import mitsuba as mi

    from mitsuba_plugins import register

    register()
    made = exported(tmp_path, FoundLights(windows=(WINDOW,)))
    views = tuple(
        replace(view, name=name)
        for view, name in zip(made.capture.views, ("surface", "window-0-0"), strict=True)
    )
    for capture, ids in ((made.capture, ["view_00", "view_01"]),
                         (replace(made.capture, views=views), ["surface_2", "window-0-0_2"])):  # fmt: skip
        scene = mi.load_file(str(write_mitsuba_scene(tmp_path / ids[0], replace(made, capture=capture))))
        assert [sensor.id() for sensor in scene.sensors()] == ids


def test_a_full_disk_leaves_no_part_of_a_texture(tmp_path: Path) -> None:
    made = exported(tmp_path, FoundLights())
    size = min(path.stat().st_size for path in made.images.glob("*o*.png"))
    with small_files(size - 1), pytest.raises(OSError, match="File too large"):
        write_mitsuba_scene(tmp_path / "mitsuba", made)
    assert not list((tmp_path / "mitsuba" / "textures").iterdir())


def test_images_of_earlier_maps_that_are_not_replaced_are_removed(tmp_path: Path) -> None:
    """Otherwise the page of an asset would show an earlier confidence, or refuse its size."""
    for has_confidence in (True, False):
        write_atlas_images(tmp_path, empty_atlas(16, has_confidence=has_confidence))
        names = {path.stem for path in tmp_path.iterdir()}
        assert ("confidence" in names) == has_confidence and {"roughness", "mask"} <= names
    write_atlas_images(tmp_path, empty_atlas(16), has_exr=False)
    assert {path.suffix for path in tmp_path.iterdir()} == {".png"}


def test_sky_is_exported_with_the_same_orientation_everywhere(tmp_path: Path) -> None:
    """The sky is equally oriented in the Mitsuba scene and in the package as rendered by the project."""
    import mitsuba as mi

    from datagen.formats.configuration import configuration_of
    from datagen.library import Library
    from datagen.rendering.lights import make_lights
    from mitsuba_plugins import register

    register()
    image = np.zeros((HEIGHT, 2 * HEIGHT, 3), np.float32)
    way = np.array([0.6, 0.48, 0.64])
    row, column = divmod(int(directions_of(way[None], HEIGHT)[0]), 2 * HEIGHT)
    image[row - 1 : row + 2, column - 1 : column + 2] = [7, 8, 9]
    lights = FoundLights(windows=(WINDOW,), environment=image)
    reconstruction = exported(tmp_path, lights)
    write_asset(tmp_path / "asset", reconstruction, "room").close()
    write_mitsuba_scene(tmp_path / "mitsuba", reconstruction)
    scene = mi.load_file(str(tmp_path / "mitsuba" / "scene.xml"))
    with open_package(tmp_path / "asset") as package:
        assert isinstance(package.asset, EnvironmentAsset)
        (light,) = package.asset.lights  # no panels in addition to the sky
        assert isinstance(light, EnvironmentLight)
        configuration = configuration_of(package)
    with Library([tmp_path / "asset"]) as library:
        setup = make_lights(configuration, library, None, [])
        ours = mi.load_dict(next(iter(setup.entries.values())))

    def seen(emitter: object, direction: NDArray) -> NDArray:
        si = mi.SurfaceInteraction3f()
        si.wi = -mi.Vector3f(*direction.tolist())
        return np.asarray(emitter.eval(si).numpy()).ravel()[:3]  # type: ignore[attr-defined]

    for emitter in (scene.environment(), ours):
        np.testing.assert_allclose(seen(emitter, way), [7, 8, 9], rtol=1e-3)
        assert seen(emitter, way * [-1, 1, 1]).max() < 0.01 > seen(emitter, way * [1, -1, 1]).max()
    window, sky = lights.described()
    assert sky == {"kind": "sky", "slot": "sky", "radiance": [2.0, 2.0, 2.0]}
    np.testing.assert_allclose(window["power"], np.pi * 2, rtol=1e-5)


def test_emissive_surface_is_exported_with_its_material(tmp_path: Path) -> None:
    """An unnamed triangle emits on its photographed side; lamps that are named parts are black."""
    capture = room_capture(2, (32, 24))
    mesh = Mesh(capture.geometry.mesh.positions, capture.geometry.mesh.faces)
    of_face = np.full(len(mesh.faces), -1, np.int32)
    of_face[[2, 3, 4, 5, 6]] = [0, 2, 3, 1, 2]
    sides = np.ones(len(mesh.faces), np.float32)
    sides[5] = -1
    radiance = np.array([[2, 4, 6], [1, 1, 1], [0, 0, 0], [8, 8, 8]], np.float32)
    nothing = np.zeros(0, np.float32)
    emitters = Emitters(of_face, radiance, sides, nothing, nothing, nothing)  # type: ignore[arg-type]
    parts = (
        GeometryPart("wall", 0, 2),
        GeometryPart("lamp", 2, 3, (9.0, 9.0, 9.0)),
        GeometryPart("rest", 5, len(mesh.faces) - 5),
    )
    lamp, found = found_lamps(emitters, mesh, parts)
    assert (lamp.slot, lamp.is_named) == ("lamp-0", True)
    area = mesh.areas()
    assert area[2] != pytest.approx(area[4])
    mean = (area[2] * radiance[0] + area[4] * radiance[3]) / (area[2] + area[4])  # face 3 is not photographed
    np.testing.assert_allclose(lamp.radiance, mean, rtol=1e-6)
    assert (found.slot, found.side, found.is_named, list(found.faces)) == ("found-0", -1, False, [5])
    assert lamp.area_m2 == pytest.approx(float(mesh.areas()[2:5].sum()))
    reconstruction = exported(tmp_path, FoundLights((lamp, found)))
    with write_asset(tmp_path / "asset", reconstruction, "room") as package:
        material = package.asset.materials["found-0"]  # type: ignore[union-attr]
        assert material.emission == (1.0, 1.0, 1.0) and material.textures()
        dark = package.asset.materials["lamp-0"]  # type: ignore[union-attr]
        assert dark.emission == lamp.radiance
        assert dark.diffuse_albedo == dark.specular_albedo == (0.0, 0.0, 0.0)
        for slot, face, side in (("lamp-0", 2, 1), ("found-0", 5, -1)):
            shape = decode_ply(package.read_bytes(f"{slot}.ply"), slot)
            a, b, c = shape.triangles()[0]
            d, e, f = mesh.triangles()[face]
            np.testing.assert_allclose(np.cross(b - a, c - a), side * np.cross(e - d, f - d), atol=1e-6)
    scene = ElementTree.parse(write_mitsuba_scene(tmp_path / "mitsuba", reconstruction))
    shapes = {shape.get("id"): shape for shape in scene.iter("shape")}
    assert shapes["lamp-0"].find("bsdf/rgb").get("value") == "0"  # type: ignore[union-attr]
    assert shapes["found-0"].find("ref") is not None
    write_glb(tmp_path / "room.glb", reconstruction, has_punctual=True)
    document = glb_document(tmp_path / "room.glb")
    (shining,) = (m for m in document["materials"] if m["name"] == "found-0")
    assert shining["emissiveFactor"] == [1, 1, 1] and "baseColorTexture" in shining["pbrMetallicRoughness"]


def test_a_sun_of_gain_zero_is_no_punctual_light(tmp_path: Path) -> None:
    sun = FoundSun((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 0.009)
    write_glb(tmp_path / "dark.glb", exported(tmp_path, FoundLights(sun=sun)), has_punctual=True)
    assert "extensions" not in glb_document(tmp_path / "dark.glb")


def test_small_lamps_are_exported_as_points_on_demand(tmp_path: Path) -> None:
    """The intensity (cd) of a bulb of 20 cm is that of its projected area, a quarter of its surface."""
    capture = room_capture(2, (32, 24))
    faces = np.array([0], np.int32)
    area = float(capture.geometry.mesh.areas()[0])
    bulb = FoundLamp("lamp-0", faces, 1, (1.0, 2.0, 4.0), (0.0, 0.0, 0.0), area, True)
    reconstruction = exported(tmp_path, FoundLights((bulb,), windows=(WINDOW,)))
    shrunk = Mesh(*(getattr(reconstruction.mesh, k) for k in ("positions", "faces", "normals", "uv")))
    size = float(np.ptp(shrunk.positions[shrunk.faces[0]], axis=0).max())
    small = Mesh(shrunk.positions * np.float32(0.2 / size), shrunk.faces, shrunk.normals, shrunk.uv)
    for mesh, num in ((shrunk, int(size <= 0.5)), (small, 1)):
        changed = Reconstruction(
            capture, mesh, reconstruction.atlas, reconstruction.images, reconstruction.lights
        )
        write_glb(tmp_path / "with.glb", changed, has_punctual=True)
        document = glb_document(tmp_path / "with.glb")
        lights = document.get("extensions", {}).get("KHR_lights_punctual", {}).get("lights", [])
        assert len(lights) == num and len(document["scenes"][0]["nodes"]) == 1 + num
    assert lights[0]["color"] == [0.25, 0.5, 1.0]
    assert lights[0]["intensity"] == pytest.approx(683 * 4 * float(small.areas()[0]) / 4)
    (node,) = (node for node in document["nodes"] if "extensions" in node)
    x, y, z = small.triangles()[0].mean(axis=0)
    np.testing.assert_allclose(node["translation"], [x, z, -y], atol=1e-6)  # Y up
    write_glb(tmp_path / "without.glb", reconstruction)
    assert "extensions" not in glb_document(tmp_path / "without.glb")


def small_lights(folder: Path) -> Path:
    """A GLB of a tiny room with a small lamp, an emissive surface and a window."""
    capture = room_capture(2, (32, 24))
    mesh = capture.geometry.mesh
    lamps = tuple(
        FoundLamp(slot, np.array([face], np.int32), side, (1.0, 2.0, 4.0), (0.0, 0.0, 0.0), 0.01, is_named)
        for slot, face, side, is_named in (("lamp-0", 0, 1, True), ("found-0", 5, -1, False))
    )
    made = exported(folder, FoundLights(lamps, windows=(WINDOW,)))
    small = Mesh(mesh.positions * np.float32(0.1), mesh.faces, mesh.normals, mesh.uv)
    write_glb(
        folder / "lights.glb",
        Reconstruction(capture, small, made.atlas, made.images, made.lights),
        has_punctual=True,
    )
    return folder / "lights.glb"


def test_khronos_validator_finds_nothing_in_lights(tmp_path: Path) -> None:
    if shutil.which("node") is None or not (VALIDATOR / "node_modules").is_dir():
        pytest.skip("needs node and npm packages: cd .ci/gltf && npm ci")
    glb = small_lights(tmp_path)
    command = ["node", "validate.mjs", str(glb)]
    for word, has_errors in ((b'"light":1', False), (b'"light":7', True)):  # injected fault: no such light
        glb.write_bytes(glb.read_bytes().replace(b'"light":1', word))
        done = subprocess.run(command, cwd=VALIDATOR, capture_output=True, text=True)
        issues = json.loads(done.stdout)["issues"]
        assert bool(issues["numErrors"]) == has_errors and issues["numWarnings"] == 0, issues


@pytest.mark.bpy
@needs_bpy
def test_blender_reads_the_lights(tmp_path: Path) -> None:
    """Blender reads emission as radiance, and points with a power (W) of pi times area times radiance."""
    glb = small_lights(tmp_path)
    command = [sys.executable, "-m", "tests.model.glb_in_blender", str(glb)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("{")))
    for slot in ("lamp-0", "found-0"):
        np.testing.assert_allclose(found["emission"][slot], [1, 2, 4], rtol=1e-5)
    np.testing.assert_allclose(found["emission"]["window-0-0"], [2, 2, 2], rtol=1e-5)
    mesh = room_capture(2, (32, 24)).geometry.mesh
    area, middle = 0.01 * float(mesh.areas()[0]), 0.1 * mesh.triangles()[0].mean(axis=0)
    np.testing.assert_allclose(found["watts"]["lamp-0"], np.pi * area * np.array([1, 2, 4]), rtol=1e-3)
    np.testing.assert_allclose(found["places"]["lamp-0"], middle, atol=1e-5)


def test_without_light_that_of_the_capture_is_exported(tmp_path: Path) -> None:
    assert lights_text([]) == "no light was found"
    dark = FoundLamp("lamp-0", np.zeros(1, np.int32), 1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, True)
    assert FoundLights((dark,)).is_dark and FoundLights((dark,)).described() == []
    reconstruction = exported(tmp_path, FoundLights((dark,)))
    assert reconstruction.shining_lights is None
    text = write_mitsuba_scene(tmp_path / "mitsuba", reconstruction).read_text()
    assert 'type="constant"' in text and "window" not in text
    shining = exported(tmp_path, FoundLights(windows=(WINDOW,)))
    text = write_mitsuba_scene(tmp_path / "lit", shining).read_text()
    assert 'type="constant"' not in text and "window-0-0.ply" in text
