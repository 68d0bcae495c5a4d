# SPDX-License-Identifier: MIT
"""The irradiance cache: cells, means, a closed room of known irradiance, and images with and without it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.formats.asset import SlotMaterial
from datagen.formats.base import parse_model
from datagen.formats.lights import AreaLight, PointLight
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.errors import InputError
from datagen.rendering.renderer import SceneRenderer
from oracles.rendering_scenes import GREY, SmallScene, down_camera, quad, renderer
from tests.datagen.test_rendering_depth import closed_room
from tests.datagen.test_rendering_renderer import digest
from tests.datagen.test_rendering_sky_guide import CAMERAS, DAYLIGHT, LAMP, walled_room

pytestmark = pytest.mark.usefixtures("mitsuba_variant")

PLAIN = RenderRecipe(path_samples=4, auxiliary_samples=4, denoise=False, max_depth=16)
CACHED = PLAIN.model_copy(update={"irradiance_cache": True})
INDOORS = Camera(24, 16, 20, 20, 12, 8, look_at([0.5, -1.0, 1.2], [0.0, 1.0, 0.8]))
BOX_M = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 1.0]])


def cells_at(cells: Any, points: Any, normal: tuple[float, float, float]) -> tuple[NDArray, NDArray]:
    import mitsuba as mi

    index, is_inside = cells.index(mi.Point3f(np.array(points, np.float32).T), mi.Vector3f(*normal))
    return np.array(index), np.broadcast_to(np.array(is_inside), len(points))


def box_points(scale: float = 1.0) -> NDArray[np.float64]:
    """Return random points (N, 3) on the faces of ``BOX_M``, scaled by ``scale``."""
    numbers = np.random.default_rng(3).random((20000, 3))
    axis = np.arange(len(numbers)) % 3
    numbers[np.arange(len(numbers)), axis] = np.arange(len(numbers)) % 2
    return (BOX_M[0] + numbers * (BOX_M[1] - BOX_M[0])) * scale


def test_cells_distinguish_positions_and_orientations() -> None:
    from datagen.rendering.transport.irradiance_cache import SurfaceCells

    cells = SurfaceCells(box_points())
    assert cells.side_m == pytest.approx(0.025) and min(cells.shape) >= 41
    points = [[0.03, 0.53, 0.01], [0.034, 0.52, 0.0], [0.06, 0.53, 0.01], [-0.3, 0.5, 0.5], [1.0, 0.5, 0.5]]
    index, is_inside = cells_at(cells, points, (0, 0, 1))
    assert index[0] == index[1] != index[2]
    assert is_inside.tolist() == [True, True, True, False, False]  # outside the grid, far from surfaces
    normals = [(0.9, 0.1, -0.4), (-0.9, 0.1, 0.4), (0, 1, 0.9), (0.1, -1, 0), (0, 0.5, 1), (0.2, 0, -1)]
    one_place = [int(cells_at(cells, points[:1], normal)[0][0]) for normal in normals]
    assert len(set(one_place)) == 6 and max(one_place) < cells.num_cells
    assert one_place[4] == index[0]
    orientation, cube = cells.cubes(np.array(one_place))
    assert orientation.tolist() == [1, 0, 3, 2, 5, 4]
    low = np.array(cells.low).ravel() + cells.side_m * cube
    assert ((low <= points[0]) & (points[0] < low + cells.side_m)).all()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4, 1e9])
def test_cells_follow_the_scale_of_small_scenes(scale: float) -> None:
    from datagen.rendering.transport.irradiance_cache import MAX_BRICKS, MAX_SIDE_M, SurfaceCells

    cells = SurfaceCells(box_points(scale))
    inside = cells_at(cells, box_points(scale).tolist(), (0, 0, 1))[1]
    assert inside.all() and cells.num_cells <= 6 * 8**3 * (MAX_BRICKS + 1)
    if scale <= 1.0:
        assert cells.side_m == pytest.approx(scale / 40)
    else:  # memory bounds the cell size instead
        assert cells.side_m > MAX_SIDE_M
        halved = box_points(scale) / (4 * cells.side_m)
        assert len(np.unique(halved.astype(int), axis=0)) > MAX_BRICKS


def test_cells_of_a_large_room_are_bounded_in_metres() -> None:
    from datagen.rendering.transport.irradiance_cache import MAX_SIDE_M, SurfaceCells

    assert SurfaceCells(box_points(5.0)).side_m == MAX_SIDE_M


def test_means_are_shrunk_towards_their_surroundings() -> None:
    import mitsuba as mi

    from datagen.rendering.transport.irradiance_cache import PRIOR_SAMPLES, IrradianceCache, SurfaceCells

    cells = SurfaceCells(box_points())
    cache = IrradianceCache(cells)
    places = [[0.0, 0.1, 0.1], [0.0, 0.125, 0.1], [1.95, 0.95, 1.0]]
    (near, beside, far), _ = cells_at(cells, places, (0, 0, 1))

    def means(*points: list[float]) -> tuple[NDArray, NDArray]:
        where = mi.Point3f(np.array(points, np.float32).T)
        record = cache.record(where, mi.Vector3f(0, 0, 1), mi.Bool(True))
        value, is_known = cache.irradiance(record, mi.Bool(False), mi.Bool(True))
        return np.array(value).T, np.array(is_known)

    assert not means(places[0])[1].any()
    cache.add(np.array([near, near]), np.array([[1.0, 2.0, 3.0], [3.0, 4.0, 5.0]]))
    assert means(places[0])[0][0] == pytest.approx([2, 3, 4])
    cache.add(np.array([near]), np.array([[8.0, 9.0, 10.0]]))
    assert means(places[0])[0][0] == pytest.approx([4, 5, 6])
    cache.add(
        np.repeat([near, beside, far], [996, 1, 1]),
        np.repeat([[10.0] * 3, [0.0] * 3, [7.0] * 3], [996, 1, 1], 0),
    )
    assert cache.num_records == 3
    cache.finish()
    value, is_known = means(*places, [1.0, 0.5, 0.0])
    assert is_known.tolist() == [True, True, True, False]
    assert value[0] == pytest.approx([10] * 3, rel=0.02)
    assert value[1] == pytest.approx([10 * PRIOR_SAMPLES / (1 + PRIOR_SAMPLES)] * 3, rel=0.02)
    assert value[2] == pytest.approx([7] * 3)


def test_irradiance_of_opposite_surfaces_in_one_cube_is_unknown() -> None:
    import mitsuba as mi

    from datagen.rendering.transport.irradiance_cache import IrradianceCache, SurfaceCells

    cells = SurfaceCells(box_points())
    cache = IrradianceCache(cells)
    places, normals = [[0.0, 0.1, 0.1], [0.0, 0.2, 0.1]], [(0, 0, 1), (0, 0, -1), (0, 1, 0)]
    top, bottom, side = (cells_at(cells, places, normal)[0] for normal in normals)

    def are_known(is_last: bool = False) -> list[list[bool]]:
        where, last, active = mi.Point3f(np.array(places, np.float32).T), mi.Bool(is_last), mi.Bool(True)
        records = [cache.record(where, mi.Vector3f(*normal), active) for normal in normals]
        return [np.array(cache.irradiance(record, last, active)[1]).tolist() for record in records]

    cache.add(np.concatenate([top, side]), np.ones((4, 3)))
    assert are_known() == [[True, True], [False, False], [True, True]]
    cache.add(bottom[:1], np.ones((1, 3)))
    cache.finish()
    assert are_known() == [[False, True], [False, False], [True, True]]
    assert are_known(is_last=True) == [[True, True], [True, False], [True, True]]


def irradiance(room: SceneRenderer) -> NDArray[np.float32]:
    """Return the irradiance (N, 3) of all known cells."""
    cache = room.tracer.irradiance
    assert cache is not None
    table = np.array(cache.means).reshape(-1, 4)
    assert np.isfinite(table).all() and (table >= 0).all()
    return table[1:, :3]


@pytest.mark.parametrize(
    ("reflectance", "intensity"), [(0.0, 1.0), (0.5, 1.0), (0.8, 1.0), (0.5, 1e-6), (0.5, 1e6)]
)
def test_irradiance_of_a_closed_room_is_exact(tmp_path: Path, reflectance: float, intensity: float) -> None:
    """A bulb's flux is absorbed, so mean irradiance x area x (1 - reflectance) equals 4 pi x intensity."""
    room = closed_room(None)
    room.slots = {"wall": GREY.model_copy(update={"diffuse_albedo": (reflectance,) * 3})}
    bulb = PointLight(name="bulb", position_m=(0.0, 0.0, 1.0), intensity=(intensity, 2 * intensity, 0.0))
    made = renderer(tmp_path, room, [INDOORS], CACHED, lights=(bulb,))
    found = np.average(irradiance(made), axis=0, weights=wall_areas(made))
    expected = 4.0 * np.pi * intensity / (64.0 * (1.0 - reflectance))
    assert found == pytest.approx([expected, 2 * expected, 0.0], rel=0.03, abs=0.0)


def wall_areas(room: SceneRenderer) -> NDArray[np.float64]:
    """Return the area (N,) of a closed room's walls within each known cell."""
    cache = room.tracer.irradiance
    assert cache is not None
    cells = cache.cells
    orientation, cube = cells.cubes(cache.cell_of_record[1:])
    low = np.array(cells.low).T.ravel() + cells.side_m * cube
    inside = np.minimum(low + cells.side_m, [2, 2, 2]) - np.maximum(low, [-2, -2, 0])
    inside[np.arange(len(low)), orientation // 2] = 1.0
    return inside.prod(axis=1)


def test_irradiance_does_not_pass_a_wall(tmp_path: Path) -> None:
    """A lamp on one side of a thin wall leaves the other side dark."""
    parts = {
        "floor": (quad([-2, -2, 0], [4, 0, 0], [0, 4, 0]), "grey"),
        "wall": (quad([0, -2, 0], [0, 4, 0], [0, 0, 2]), "grey"),
        "ceiling": (quad([-2, 2, 2], [4, 0, 0], [0, -4, 0]), "grey"),
        "left": (quad([-2, -2, 0], [0, 4, 0], [0, 0, 2]), "grey"),
        "right": (quad([2, 2, 0], [0, -4, 0], [0, 0, 2]), "grey"),
        "front": (quad([2, -2, 0], [-4, 0, 0], [0, 0, 2]), "grey"),
        "back": (quad([-2, 2, 0], [4, 0, 0], [0, 0, 2]), "grey"),
    }
    cameras = [
        Camera(24, 16, 12, 12, 12, 8, look_at([side, -1.5, 1.2], [side, 1.0, 0.6])) for side in (-1.0, 1.0)
    ]
    bulb = PointLight(name="bulb", position_m=(-1.0, 0.0, 1.5), intensity=(5.0, 5.0, 5.0))
    room = renderer(tmp_path, SmallScene(parts), cameras, CACHED, lights=(bulb,))
    lit, dark = (room.render_view(k).buffers["beauty"] for k in (0, 1))
    assert lit.mean() > 0.1
    # some light leaks, because cells of the floor extend to both sides of the infinitely thin wall
    assert dark.mean() < 0.01 * lit.mean()


@pytest.mark.parametrize("lights", [(LAMP,), (DAYLIGHT,)], ids=["lamp", "daylight"])
def test_images_agree_with_those_of_whole_paths_and_have_less_noise(tmp_path: Path, lights: Any) -> None:
    made = {}
    for name, recipe in (("plain", PLAIN), ("cached", CACHED)):
        room = renderer(tmp_path / name, walled_room(), CAMERAS, recipe, lights=lights)
        sensor = room.sensor(CAMERAS[0])
        made[name] = np.stack([room.tracer.accumulate(sensor, 128, seed).mean() for seed in range(8)])
    means = {name: images.mean(axis=0) for name, images in made.items()}
    variances = {name: images.var(axis=0, ddof=1).mean() for name, images in made.items()}
    assert means["cached"].mean() == pytest.approx(means["plain"].mean(), rel=0.03)
    scale = means["plain"].mean()
    noise = np.sqrt((variances["plain"] + variances["cached"]) / 8)
    difference = np.sqrt(((means["cached"] - means["plain"]) ** 2).mean())
    assert difference < 0.05 * scale + 1.5 * noise
    assert variances["cached"] < variances["plain"]


def test_bytes_do_not_depend_on_order_and_the_record_has_the_cell_size(tmp_path: Path) -> None:
    room = renderer(tmp_path / "a", walled_room(), CAMERAS, CACHED, lights=(LAMP,))
    both = [room.render_view(k) for k in (0, 1)]
    again = renderer(tmp_path / "b", walled_room(), CAMERAS, CACHED, lights=(LAMP,)).render_view(1)
    assert digest(again) == digest(both[1])
    cache = room.tracer.irradiance
    assert cache is not None and again.render.irradiance_cell_m == pytest.approx(cache.cells.side_m, rel=1e-3)
    plain = renderer(tmp_path / "c", walled_room(), CAMERAS, PLAIN, lights=(LAMP,)).render_view(1)
    assert plain.render.irradiance_cell_m is None


def test_light_passes_half_transparent_surfaces(tmp_path: Path) -> None:
    """With a curtain of opacity 0.4 in front of the window, cached and full paths give equal means."""
    means = []
    for name, recipe in (("plain", PLAIN), ("cached", CACHED)):
        scene = walled_room(curtain=True)
        room = renderer(tmp_path / name, scene, CAMERAS, recipe, lights=(DAYLIGHT,))
        means.append(room.tracer.accumulate(room.sensor(CAMERAS[0]), 512, 3).mean().mean())
    assert means[1] == pytest.approx(means[0], rel=0.05)


def means_of_views(
    tmp_path: Path, scene: SmallScene, cameras: list[Camera], light: Any
) -> dict[str, NDArray]:
    """Return means (V,) of views by full paths ("plain") and with a cache built from one view ("cached")."""
    found = {}
    for name, recipe in (("plain", PLAIN), ("cached", CACHED)):
        room = renderer(tmp_path / name, scene, CAMERAS[:1], recipe, lights=(light,))
        sums = [room.tracer.accumulate(room.sensor(camera), 2048, 1) for camera in cameras]
        found[name] = np.array([part.mean().mean() for part in sums])
    return found


def test_light_does_not_leak_under_objects_smaller_than_a_cell(tmp_path: Path) -> None:
    """A board 2 cm above the floor divides a wall cell, whose mean thus mixes dark and bright irradiance. The
    floor would be 27 % brighter if paths used the cache at surfaces as near as this."""
    scene = walled_room(window=False)
    scene.parts |= {
        "board_below": (quad([-1.2, 1.85, 0.02], [0, 0.15, 0], [2.4, 0, 0]), "grey"),
        "board_above": (quad([-1.2, 1.85, 0.03], [2.4, 0, 0], [0, 0.15, 0]), "grey"),
        "board_edge": (quad([-1.2, 1.85, 0.02], [2.4, 0, 0], [0, 0, 0.01]), "grey"),
    }
    bulb = PointLight(name="bulb", position_m=(0.0, 0.5, 1.6), intensity=(5.0, 5.0, 5.0))
    below = Camera(16, 4, 60, 60, 8, 4, look_at([0.0, 1.5, 0.015], [0.0, 1.95, 0.0]))
    means = means_of_views(tmp_path, scene, [below], bulb)
    assert means["cached"] == pytest.approx(means["plain"], rel=0.12)


def two_rooms() -> SmallScene:
    """Return a closed room divided at y = 0 by a wall with a gap of 1 m; bright walls cause many bounces."""
    scene = closed_room(None)
    scene.slots = {"wall": GREY.model_copy(update={"diffuse_albedo": (0.8,) * 3})}
    scene.parts["divider"] = (quad([-2, 0, 0], [3, 0, 0], [0, 0, 2]), "wall")
    return scene


def test_unseen_rooms_are_not_dark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Light around a corner is the same with full paths, with cached paths, and with cached paths of four
    segments that use cached irradiance only at the last vertex."""
    from datagen.rendering.transport import irradiance_cache

    bulb = PointLight(name="bulb", position_m=(-1.5, 1.8, 1.8), intensity=(5.0, 5.0, 5.0))
    camera = Camera(24, 16, 16, 16, 12, 8, look_at([-1.5, -1.5, 1.0], [-0.5, -0.2, 1.0]))

    def light(name: str, recipe: RenderRecipe, depth: int) -> float:
        recipe = recipe.model_copy(update={"max_depth": depth})
        room = renderer(tmp_path / name, two_rooms(), [camera], recipe, lights=(bulb,))
        return float(room.tracer.accumulate(room.sensor(camera), 1024, 1).mean().mean())

    plain = light("plain", PLAIN, 64)
    assert light("cached", CACHED, 16) == pytest.approx(plain, rel=0.05)
    monkeypatch.setattr(irradiance_cache, "MIN_SPREAD", 1e6)
    assert light("last", CACHED, 4) == pytest.approx(plain, rel=0.05)
    assert light("cut_off", PLAIN, 4) < 0.6 * plain


def test_cache_does_not_depend_on_the_size_of_images(tmp_path: Path) -> None:
    caches = []
    for number, scale in enumerate((1, 4)):
        camera = INDOORS.scaled(24 * scale, 16 * scale)
        room = renderer(tmp_path / str(number), walled_room(), [camera], CACHED, lights=(LAMP,))
        caches.append(room.tracer.irradiance)
    small, large = caches
    assert small is not None and large is not None and small.cells.side_m < 0.1
    assert small.cells.side_m == pytest.approx(large.cells.side_m, rel=0.01)
    assert small.num_records == pytest.approx(large.num_records, rel=0.05)


@pytest.mark.parametrize(("roughness", "contrast", "tolerance"), [(0.25, 3.0, 0.12), (0.5, 2.0, 0.06)])
def test_a_beam_is_reflected_in_its_direction(
    tmp_path: Path, roughness: float, contrast: float, tolerance: float
) -> None:
    """A glossy wall reflects a lamp onto a part of the floor. The rest of the floor stays dark, since the
    wall does not reflect its irradiance diffusely."""
    glossy = SlotMaterial(diffuse_albedo=(0, 0, 0), specular_albedo=(0.9, 0.9, 0.9), roughness=roughness)
    scene = closed_room(None)
    scene.parts["left"] = (quad([-2, -2, 0], [0, 2, 0], [0, 0, 2]), "glossy")
    scene.parts["left_end"] = (quad([-2, 0, 0], [0, 2, 0], [0, 0, 2]), "wall")
    scene.slots = {"wall": GREY.model_copy(update={"diffuse_albedo": (0.1, 0.1, 0.1)}), "glossy": glossy}
    lamp = AreaLight(
        name="lamp", origin_m=(0, -0.6, 1.4), edge_u_m=(0, 0.4, 0), edge_v_m=(0, 0, -0.4), radiance=(50,) * 3
    )
    down = [
        Camera(8, 8, 16, 16, 4, 4, look_at([1.5, y, 1.0], [1.5, y, 0.0], up=(0.0, 1.0, 0.0)))
        for y in (-0.4, 1.6)
    ]
    means = means_of_views(tmp_path, scene, down, lamp)
    assert means["plain"][0] > contrast * means["plain"][1]
    assert means["cached"] == pytest.approx(means["plain"], rel=tolerance)


@pytest.mark.parametrize("roughness", [0.15, 0.6])
def test_glossy_room_is_as_bright_as_with_whole_paths(tmp_path: Path, roughness: float) -> None:
    """If irradiance were gathered with specular lobes as diffuse, the room would be 1.3 % brighter."""
    glossy = SlotMaterial(
        diffuse_albedo=(0.5, 0.5, 0.5), specular_albedo=(0.2, 0.2, 0.2), roughness=roughness
    )
    scene = walled_room()
    scene.slots = dict.fromkeys(scene.slots, glossy)
    means = means_of_views(tmp_path, scene, CAMERAS[:2], LAMP)
    assert means["cached"] == pytest.approx(means["plain"], rel=0.005)


def test_without_surface_or_light_there_is_no_cache(tmp_path: Path) -> None:
    away = Camera(24, 16, 20, 20, 12, 8, look_at([0, 0, 3], [0, 0, 6], up=(0.0, 1.0, 0.0)))
    assert renderer(tmp_path / "away", None, [away], CACHED, lights=(LAMP,)).tracer.irradiance is None
    dark = renderer(tmp_path / "dark", None, [down_camera()], CACHED)
    assert dark.tracer.irradiance is None and dark.render_view(0).render.irradiance_cell_m is None


def test_radiance_between_white_walls_is_bounded(tmp_path: Path) -> None:
    """In a scene without absorption, each bounce adds a bounded amount of irradiance."""
    white = SlotMaterial(diffuse_albedo=(1, 1, 1), specular_albedo=(1, 1, 1), roughness=0.3)
    room = closed_room(None)
    room.slots = {"wall": white}
    bulb = PointLight(name="bulb", position_m=(0.0, 0.0, 1.0), intensity=(1.0, 1.0, 1.0))
    found = irradiance(renderer(tmp_path, room, [INDOORS], CACHED, lights=(bulb,)))
    assert found.mean() < (64 + 12) * 4 * np.pi / 32  # bounces x bulb power / area, times 2


RECORDS_IN_GARBAGE = """
import gc, sys
from pathlib import Path
import numpy as np
from mitsuba_plugins.variant import select_variant
select_variant("llvm_ad_rgb")
import mitsuba as mi
from tests.datagen.test_rendering_irradiance_cache import CACHED, CAMERAS, LAMP, renderer, walled_room

class Loop: pass
room = renderer(Path(sys.argv[1]), walled_room(), CAMERAS, CACHED, lights=(LAMP,))
gc.collect()
gc.disable()
loop = Loop()
loop.itself, loop.array = loop, mi.UInt32(np.arange(1 << 16, dtype=np.uint32))
del loop
room.tracer.forget_recordings()
gc.set_threshold(0)
trace = room.tracer.sample
def tracing(*arguments):
    gc.collect() if gc.isenabled() else None
    return trace(*arguments)
room.tracer.sample = tracing
gc.enable()
room.tracer.accumulate(room.sensor(CAMERAS[0]), 1, 0)
"""


def test_garbage_collection_waits_until_kernels_are_recorded(tmp_path: Path) -> None:
    """Collecting a reference cycle that contains an array of NumPy memory aborts a process that records."""
    command = [sys.executable, "-c", RECORDS_IN_GARBAGE, str(tmp_path / "room")]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_reference_quality_has_no_cache() -> None:
    assert parse_model(RenderRecipe, {"quality": "standard"}, "recipe.yaml").irradiance_cache
    assert not parse_model(RenderRecipe, {"quality": "reference"}, "recipe.yaml").irradiance_cache
    assert not parse_model(
        RenderRecipe, {"quality": "draft", "irradiance_cache": False}, "r"
    ).irradiance_cache
    with pytest.raises(InputError, match="no irradiance_cache with quality reference"):
        parse_model(RenderRecipe, {"quality": "reference", "irradiance_cache": True}, "recipe.yaml")


def test_kernels_do_not_depend_on_cameras_and_rounds(tmp_path: Path) -> None:
    """All cameras and rounds share kernels, because compiling a kernel delays the first pixels of a room."""
    import drjit as dr

    from datagen.rendering.transport.irradiance_gathering import gather_irradiance

    made = renderer(tmp_path, walled_room(), CAMERAS, CACHED, lights=(LAMP,))
    sensors = [made.sensor(INDOORS)] * 8
    kernels: list[dict[str, int]] = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for count in (2, 8):
            dr.kernel_history_clear()
            assert gather_irradiance(made.tracer.emitters, made.materials, sensors[:count], 1) is not None
            compiled = [entry for entry in dr.kernel_history() if "hash" in entry]
            kernels.append({entry["hash"]: entry["operation_count"] for entry in compiled})
    few, many = kernels
    assert len(many) <= len(few) + 1
    assert sum(operations > 1000 for operations in many.values()) == 1
