# SPDX-License-Identifier: MIT
"""Generated rooms of every kind are valid, reproducible and made quickly, and differ between seeds."""

from __future__ import annotations

import io
import math
import os
import subprocess
import sys
import time
from dataclasses import replace
from functools import cache
from typing import NamedTuple, get_args

import numpy as np
import pytest
from PIL import Image

from datagen.assembly.geometry import CollisionModel, intersects
from datagen.asset_check import check_package
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.base import sha256_hex
from datagen.formats.package import Package, open_package
from datagen.formats.recipe import RoomKind
from datagen.foundation.meshes.mesh import Mesh, inspect_mesh, lying_normals
from datagen.foundation.random import Draws
from datagen.parametric import lamps, shapes
from datagen.parametric.checks import Furnished, faults_of, meets, swing
from datagen.parametric.items import Item, Placed, hull_of
from datagen.parametric.kinds import KINDS
from datagen.parametric.packing import package_of, room_id
from datagen.parametric.prints import print_image
from datagen.parametric.room import MadeRoom, draw_shell, make_room
from datagen.parametric.slots import SLOTS, in_metal

SEEDS = ("1", "2", "3")


class _Made(NamedTuple):
    """A generated room, its package as the bytes of a zip and in memory, and the processor time of all."""

    room: MadeRoom
    data: bytes
    package: Package
    seconds: float


@cache
def _made(kind: str, seed: str) -> _Made:
    start = time.process_time()
    room = make_room(kind, seed)
    data, package = package_of(room)
    return _Made(room, data, package, time.process_time() - start)


def _room(kind: str, seed: str) -> MadeRoom:
    return _made(kind, seed).room


def test_recipes_accept_every_kind() -> None:
    assert sorted(get_args(RoomKind)) == sorted(KINDS)
    assert len(KINDS) >= 12


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_rooms_are_sound_and_packages_valid(kind: str) -> None:
    for seed in SEEDS:
        room, _, package, _ = _made(kind, seed)
        assert faults_of(room.furnished) == []
        report = check_package(package)
        assert report.errors == ()
        asset = package.asset
        assert isinstance(asset, EnvironmentAsset)
        assert asset.id == room_id(kind, seed)
        assert asset.camera_regions and asset.support_surfaces and asset.light_slots
        assert len(asset.openings) == len(room.furnished.shell.windows)
        assert any(material.emission for material in asset.materials.values())
        assert all(m.surface is not None for m in asset.materials.values())


def test_a_room_takes_less_than_two_seconds() -> None:
    """The measured processor time of a room and its package is 0.3 s in the median and at most 0.9 s."""
    seconds = {kind: _made(kind, SEEDS[0]).seconds for kind in sorted(KINDS)}
    assert max(seconds.values()) < 2.0, seconds


def test_few_rooms_are_rejected() -> None:
    rooms = [_room(kind, seed) for kind in sorted(KINDS) for seed in SEEDS]
    assert np.mean([room.tries for room in rooms]) < 2.0


def test_bytes_depend_on_kind_and_seed_alone() -> None:
    """A process with another hash seed that makes the rooms in reverse order gives the same zips."""
    wanted = [("hallway", "1"), ("cafe", "2"), ("bedroom", "3")]
    code = (
        "from datagen.formats.base import sha256_hex; from datagen.parametric.packing import room_package\n"
        f"print(' '.join(sha256_hex(room_package(*w)[0]) for w in {wanted[::-1]!r}))"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "77"}
    run = [sys.executable, "-c", code]
    output = subprocess.run(run, env=environment, capture_output=True, text=True, check=True).stdout
    here = [sha256_hex(_made(*w).data) for w in wanted]
    assert output.split() == here[::-1]


def test_slots_are_of_metal_in_their_share_of_rooms() -> None:
    """The share of slots that only metal may replace agrees with ``metal_share``, within three sigma."""
    found: dict[str, list[bool]] = {}
    for kind in sorted(KINDS):
        for seed in SEEDS:
            asset = _made(kind, seed).package.asset
            assert isinstance(asset, EnvironmentAsset)
            for slot, material in asset.materials.items():
                if slot in SLOTS and SLOTS[slot].metal_share:
                    found.setdefault(slot, []).append(material.replaceable_by == ("metal",))
    drawn = [is_metal for slot in found for is_metal in found[slot]]
    expected = [SLOTS[slot].metal_share for slot in found for _ in found[slot]]
    spread = np.sqrt(sum(p * (1 - p) for p in expected))
    assert len(found) >= 8 and abs(sum(drawn) - sum(expected)) < 3 * spread
    assert in_metal("legs").surface == "fitting" and in_metal("worktop").surface == "worktop"


def test_three_quarters_of_the_shades_are_luminous() -> None:
    makers = {
        "pendant": lambda draws: lamps.pendant(draws, "glow_0", 0.6),
        "floor lamp": lambda draws: lamps.floor_lamp(draws, "glow_0"),
        "table lamp": lambda draws: lamps.table_lamp(draws, "glow_0"),
    }
    for name, make in makers.items():
        luminous = 0
        for seed in range(120):
            item = make(Draws("lamp", name, str(seed)))
            (lamp,) = item.lamps
            shape = shapes.joined([shape for slot, shape in item.shapes if slot == "glow_0"])
            corners = shape.points[shape.faces]
            cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            area = 0.5 * float(np.linalg.norm(cross, axis=1).sum())
            assert lamp.area_m2 == pytest.approx(area, rel=0.12)  # circles are polygons with rims
            is_luminous = all(slot != "shade" for slot, _ in item.shapes)
            if is_luminous:  # it extends vertically, so it is visible from eye level
                assert np.ptp(shape.points[:, 2]) > 0.1 and lamp.area_m2 > 0.05
            luminous += is_luminous
        assert 0.6 < luminous / 120 < 0.88, name


def test_doors_have_switches_and_walls_sockets() -> None:
    """Doors have switches unless a corner or cupboard is in the way, and most rooms have sockets."""
    doors = switches = sockets = 0
    for kind in sorted(KINDS):
        for seed in SEEDS:
            room = _room(kind, seed).furnished
            plates = [p for p in room.items if p.item.name == "switch"]
            doors, switches = doors + len(room.shell.doors), switches + len(plates)
            for plate in plates:
                near = [
                    math.dist(plate.at[:2], room.shell.point(d.wall, d.s)) - d.width / 2
                    for d in room.shell.doors
                ]
                assert 0.1 < min(near) < 0.3 and plate.at[2] == 1.05, (kind, seed)
            sockets += any(p.item.name == "socket" for p in room.items)
    assert 0.85 * doors < switches <= doors and sockets > 0.85 * len(KINDS) * len(SEEDS)


def test_windows_have_curtains_blinds_or_neither() -> None:
    """No window has both curtains and a blind; some curtains hang in front of a radiator."""
    windows, found, both = 0, dict.fromkeys(("curtains", "blind", "radiator"), 0), 0
    for kind in sorted(KINDS):
        for seed in SEEDS:
            room = _room(kind, seed).furnished
            windows += len(room.shell.windows)
            places: dict[str, set[tuple[float, ...]]] = {
                name: {p.at[:2] for p in room.items if p.item.name == name} for name in found
            }
            found = {name: count + len(places[name]) for name, count in found.items()}
            both += len(places["curtains"] & places["radiator"])
            assert not places["curtains"] & places["blind"], (kind, seed)
            of_windows = {
                tuple(round(x, 6) for x in room.shell.point(w.wall, w.s)) for w in room.shell.windows
            }
            assert set().union(*places.values()) <= of_windows, (kind, seed)
    assert min(found["curtains"], found["blind"]) > 0.15 * windows, found
    assert found["curtains"] + found["blind"] < windows and both >= 3, (found, both)


def test_prints_differ() -> None:
    pictures = [print_image(Draws("print", k)) for k in range(60)]
    assert len(set(pictures)) == 60 and pictures[7] == print_image(Draws("print", 7))
    shown = np.stack([np.asarray(Image.open(io.BytesIO(p)), dtype=np.float64) / 255 for p in pictures])
    assert shown.shape == (60, 144, 144, 3) and shown.min() >= 0.01
    spread = np.ptp(shown.mean(axis=(1, 2)), axis=-1)
    assert (spread < 0.08).mean() > 0.1, "greys occur"


def test_every_seed_gives_another_room() -> None:
    shells = {draw_shell(KINDS["hallway"], Draws("shell", k)) for k in range(160)}
    assert len(shells) == 160
    assert len({room_id(kind, str(k)) for kind in KINDS for k in range(160)}) == 160 * len(KINDS)


def test_a_package_in_memory_is_the_one_on_disk(tmp_path) -> None:
    _, data, package, _ = _made("study", "1")
    path = tmp_path / "room.zip"
    path.write_bytes(data)
    with open_package(path) as opened:
        assert opened.sha256 == package.sha256
        assert opened.asset == package.asset


# ---------------------------------------------------------------- injected faults


def _changed(room: MadeRoom, name: str, **changes) -> Furnished:
    furnished = room.furnished
    assert any(item.name == name for item in furnished.items), [item.name for item in furnished.items]
    items = tuple(replace(p, **changes) if p.name == name else p for p in furnished.items)
    return replace(furnished, items=items)


def _kinds_of(room: Furnished) -> set[str]:
    return {fault.what for fault in faults_of(room)}


def _of(room: MadeRoom, name: str) -> Placed:
    return next(p for p in room.furnished.items if p.name == name)


def test_a_table_inside_a_wall_is_detected() -> None:
    room = _room("dining_room", "1")
    table = next(p for p in room.furnished.items if p.item.name in ("table", "round_table"))
    reach = room.furnished.shell.width / 2 - hull_of(table.boxes())[1, 0]
    moved = _changed(room, table.name, at=(table.at[0] + reach + 0.05, table.at[1], 0.0))
    assert any(f.what == "outside" and f.item == table.name for f in faults_of(moved))


@pytest.mark.parametrize("kind", ["bedroom", "office", "kitchen"])
def test_a_lifted_object_is_reported_as_floating(kind: str) -> None:
    room = _room(kind, "2")
    for item in room.furnished.items:
        x, y, z = item.at
        low = -0.012 if item.item.hold == "ceiling" else 0.012
        if item.item.hold == "wall":
            inward = shapes.rotation("z", item.yaw_rad)[:2, 1] * -0.012
            at = (x + inward[0], y + inward[1], z)
        else:
            at = (x, y, z + low)
        faults = faults_of(_changed(room, item.name, at=at))
        assert any(f.what == "floats" and f.item == item.name for f in faults), item.name


def test_two_objects_at_one_position_intersect() -> None:
    room = _room("bedroom", "1")
    bed = _of(room, "bed_0")
    box = Item("chest")
    box.add("wood", shapes.box((0.5, 0.4, 0.7), (0, -0.2, 0)))
    middle = hull_of(bed.boxes()).mean(axis=0)
    extra = Placed(box, "chest_9", (float(middle[0]), float(middle[1]), 0.0), 0.0)
    crowded = replace(room.furnished, items=(*room.furnished.items, extra))
    assert "intersects" in _kinds_of(crowded)


def test_a_blocked_door_is_detected() -> None:
    room = _room("study", "1")
    shell = room.furnished.shell
    sector = swing(shell, shell.doors[0])
    box = Item("basket")
    box.add("basket", shapes.box((0.3, 0.3, 0.5), (0, -0.15, 0)))
    middle = sector.mean(axis=0)
    extra = Placed(box, "basket_9", (float(middle[0]), float(middle[1]), 0.0), 0.0)
    assert "door" in _kinds_of(replace(room.furnished, items=(*room.furnished.items, extra)))


def test_a_door_that_just_clears_is_not_blocked() -> None:
    """A post in the bounding square of a door's swing, but outside its quarter disc, does not block it."""
    room = _room("study", "1")
    shell = room.furnished.shell
    door = shell.doors[0]
    sector = swing(shell, door)
    hinge, low, high = sector[0], sector.min(axis=0), sector.max(axis=0)
    corner = low + high - hinge
    place = corner + 0.08 * (hinge - corner) / np.linalg.norm(hinge - corner)
    post = Item("post")
    post.add("wood", shapes.box((0.05, 0.05, 1.0), (0, 0, 0)))
    extra = Placed(post, "post_9", (float(place[0]), float(place[1]), 0.0), 0.0)
    alone = replace(room.furnished, items=(extra,))
    assert "door" not in _kinds_of(alone)


def test_an_object_in_front_of_a_window_is_detected() -> None:
    room = next(r for k in range(1, 9) if (r := _room("bedroom", str(k))).furnished.shell.windows)
    shell = room.furnished.shell
    window = shell.windows[0]
    tall = Item("wardrobe")
    tall.add("wood", shapes.box((1.0, 0.3, 2.0), (0, -0.15, 0)))
    extra = shell.on_wall(tall, "wardrobe_9", window.wall, window.s, 0.0, 0.03)
    assert "window" in _kinds_of(replace(room.furnished, items=(*room.furnished.items, extra)))


def test_a_room_without_a_free_path_is_detected() -> None:
    room = _room("hallway", "1")
    shell = room.furnished.shell
    bar = Item("barrier")
    along = shell.width >= shell.depth
    size = (0.1, shell.depth - 0.2, 1.0) if along else (shell.width - 0.2, 0.1, 1.0)
    bar.add("wood", shapes.box(size, (0, 0, 0)))
    walls = [d.wall for d in shell.doors]
    assert len(walls) >= 2
    found = set()
    for share in (-0.35, -0.2, 0.0, 0.2, 0.35):
        at = (share * shell.width, 0.0, 0.0) if along else (0.0, share * shell.depth, 0.0)
        found |= _kinds_of(replace(room.furnished, items=(Placed(bar, "barrier_0", at, 0.0),)))
    assert "walk" in found


@pytest.mark.parametrize("kind", ["cafe", "living_room", "bathroom", "workshop"])
def test_no_triangles_cross(kind: str) -> None:
    """FCL finds no intersections between objects; objects that stand on others are first lifted by 1 mm."""
    room = _room(kind, "3")
    items = room.furnished.items
    bounds = [hull_of(p.boxes()) for p in items]
    models = []
    for p in items:
        shape = shapes.joined([s for _, s in p.item.shapes])
        model = CollisionModel(shape.points, shape.faces)
        matrix = p.room_from_item
        lift = np.array([0.0, 0.0, 1e-3 if p.stands_on else 0.0])
        models.append(model.at(matrix[:3, :3], matrix[:3, 3] + lift))
    pairs = [
        (i, j) for i in range(len(items)) for j in range(i + 1, len(items)) if meets(bounds[i], bounds[j])
    ]
    assert [(items[i].name, items[j].name) for i, j in pairs if intersects(models[i], models[j])] == []


# ---------------------------------------------------------------- shapes


def _volume(shape: shapes.Shape) -> float:
    p = shape.points[shape.faces]
    return float((np.cross(p[:, 0], p[:, 1]) * p[:, 2]).sum() / 6)


def _mesh(shape: shapes.Shape) -> Mesh:
    points, normals, uv = (a.astype(np.float32) for a in (shape.points, shape.normals, shape.uv))
    return Mesh(points, shape.faces.astype(np.int32), normals, uv)


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        (shapes.box((1.0, 2.0, 3.0), bevel=0.0), 6.0),
        (shapes.box((1.0, 2.0, 3.0), bevel=0.001), 6.0),
        (shapes.rounded_box((1.0, 1.0, 1.0), 0.49, segments=8), 0.5393),
        (shapes.cylinder(0.5, 2.0, segments=96), 0.5 * math.pi),
        (shapes.ball(0.5, segments=96), math.pi / 6),
        (shapes.tube([(0, 0, 0), (0, 0, 1), (0, 0, 2)], 0.1, 96), 0.02 * math.pi),
    ],
)
def test_shapes_are_closed_and_wound_outwards(shape: shapes.Shape, volume: float) -> None:
    assert _volume(shape) == pytest.approx(volume, rel=0.02)
    mesh = _mesh(shape)
    faults = inspect_mesh(mesh)
    assert faults.boundary_edges == faults.inconsistent_edges == faults.degenerate == 0
    assert not lying_normals(mesh).any()
    p = shape.points[shape.faces]
    outward = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert ((outward * shape.normals[shape.faces].mean(axis=1)).sum(axis=1) > 0).all()


@pytest.mark.parametrize("grain", [None, 0, 1, 2])
def test_texture_coordinates_are_metres(grain: int | None) -> None:
    shape = shapes.box((1.0, 0.4, 2.0), bevel=0.0, grain=grain)
    assert _mesh(shape).uv_per_m() == pytest.approx(1.0, rel=1e-5)


def test_slots_have_surfaces_with_looks() -> None:
    for name, slot in SLOTS.items():
        assert slot.material().replaceable_by == (() if slot.is_fixed else slot.classes), name
