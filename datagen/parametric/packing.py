# SPDX-License-Identifier: MIT
"""Packs rooms as environment packages in memory: meshes, slots, supports, lamps, camera regions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from datagen.formats.asset import (
    Box,
    EnvironmentAsset,
    LightSlot,
    Opening,
    Part,
    Provenance,
    SlotMaterial,
    SupportKind,
    SupportSurface,
    Texture,
)
from datagen.formats.base import quantized, sha256_hex
from datagen.formats.package import Package, package_in_memory
from datagen.foundation.color import color_of_temperature
from datagen.foundation.meshes.mesh import Mesh, with_sound_normals
from datagen.foundation.meshes.ply import encode_ply
from datagen.foundation.random import Draws
from datagen.foundation.rectangles import rectangles
from datagen.parametric.checks import CELL_M, walkable
from datagen.parametric.items import Lamp, Placed
from datagen.parametric.kinds import KINDS, Kind
from datagen.parametric.prints import print_image
from datagen.parametric.room import MadeRoom, make_room
from datagen.parametric.shapes import Floats, Shape, joined
from datagen.parametric.shell import openings
from datagen.parametric.slots import SLOTS, in_metal

_LUMEN_PER_WATT = 179.0  # luminous efficacy of white light, the convention of the renderer Radiance
_BALANCE_K, _WHITE_K = 4000.0, 6500.0  # lamp colours are those of a photograph balanced for 4000 K
_ON = 0.8  # share of lamps that are switched on
_REGION_TOP_M = 2.2
_MAX_REGIONS, _MAX_FLOORS = 6, 3
_AUTHOR = "the scene-materials authors"


Rectangle = tuple[Floats, Floats]


def room_id(kind: str, seed: str, has_scenery: bool = True) -> str:
    """Return the id of a room's package, unique for each kind and seed, with and without scenery."""
    key = f"{kind}/{seed}" if has_scenery else f"{kind}/{seed}/no scenery"
    return f"room-{kind}-{sha256_hex(key.encode())[:12]}"


def room_package(kind: str, seed: str, has_scenery: bool = True) -> tuple[bytes, Package]:
    """Generate the room of a kind and seed; return its package as zip bytes, and opened in memory."""
    return package_of(make_room(kind, seed, has_scenery))


def package_of(room: MadeRoom) -> tuple[bytes, Package]:
    """Return a room's environment package as the bytes of a zip file, and opened in memory."""
    draws = Draws("parametric room", room.kind, room.seed, "package")
    files: dict[str, bytes] = {}
    parts: list[Part] = []
    names_of: dict[int, list[tuple[str, str, float | None]]] = {}
    placed = [*room.furnished.built, *room.furnished.items, *room.scenery]
    used: dict[str, None] = {}
    for p in placed:
        if id(p.item) not in names_of:
            names_of[id(p.item)] = _write_meshes(p, len(names_of), files)
        for slot, mesh, density in names_of[id(p.item)]:
            used.setdefault(slot)
            rows: Any = tuple(map(tuple, np.round(p.room_from_item, 9).tolist()))
            part = f"{p.name}.{slot}"
            parts.append(Part(name=part, mesh=mesh, material=slot, asset_from_part=rows, uv_per_m=density))
    lamps = {lamp.slot: lamp for p in placed for lamp in p.item.lamps}
    materials = {slot: _material(slot, KINDS[room.kind], lamps, draws, files) for slot in sorted(used)}
    if lamps and not any(m.emission for m in materials.values()):
        slot = min(lamps)
        materials[slot] = _luminous(lamps[slot])
    shell, rectangles = room.furnished.shell, _free_rectangles(room)
    asset = EnvironmentAsset(
        id=room_id(room.kind, room.seed, room.has_scenery),
        title=f"{room.kind.replace('_', ' ').capitalize()}, generated",
        provenance=Provenance(
            license="CC0-1.0", author=_AUTHOR, source=f"datagen.parametric {room.kind} {room.seed}"
        ),
        materials=materials,
        parts=tuple(parts),
        support_surfaces=tuple(_supports(room, rectangles)),
        light_slots=tuple(_light_slots(room)),
        openings=tuple(
            Opening(name=name, origin_m=_vector(o), edge_u_m=_vector(u), edge_v_m=_vector(v))
            for name, o, u, v in openings(shell)
        ),
        camera_regions=tuple(_regions(room, rectangles)),
    )
    return package_in_memory(asset, files)


def _write_meshes(
    placed: Placed, number: int, files: dict[str, bytes]
) -> list[tuple[str, str, float | None]]:
    """Add one mesh per slot of an item to ``files``; return slots, file names and UV units per metre."""
    by_slot: dict[str, list[Shape]] = {}
    for slot, shape in placed.item.shapes:
        by_slot.setdefault(slot, []).append(shape)
    found = []
    for slot in sorted(by_slot):
        mesh = _mesh(joined(by_slot[slot]))
        name = f"meshes/{number:02d}_{placed.item.name}_{slot}.ply"
        files[name] = encode_ply(mesh)
        is_print = by_slot[slot][0].is_print
        found.append((slot, name, None if is_print else quantized(mesh.uv_per_m() or 1.0, 6)))
    return found


def _mesh(shape: Shape) -> Mesh:
    points, normals, uv = (a.astype(np.float32) for a in (shape.points, shape.normals, shape.uv))
    return with_sound_normals(Mesh(points, shape.faces.astype(np.int32), normals, uv))[0]


def _material(
    slot: str, kind: Kind, lamps: dict[str, Lamp], draws: Draws, files: dict[str, bytes]
) -> SlotMaterial:
    if slot.startswith("glow"):
        return _luminous(lamps[slot]) if draws.chance(_ON) else SLOTS["opal"].material()
    if slot.startswith("art"):
        name = f"textures/{slot}.png"
        files[name] = print_image(Draws("print", draws.integer(0, 2**31)))
        return SlotMaterial(
            classes=("paper",),
            diffuse_albedo=Texture(texture=name, encoding="srgb"),
            roughness=0.7,
            surface="cover",
        )
    steel = kind.steel_fronts if slot == "front" else SLOTS[slot].metal_share
    if steel > draws.unit():
        return in_metal(slot)
    return SLOTS[slot].material(kind.floor if slot == "floor" else None)


def _luminous(lamp: Lamp) -> SlotMaterial:
    """Return the material of a Lambertian emitter with the lamp's flux and colour."""
    radiance = lamp.lumen / (_LUMEN_PER_WATT * math.pi * lamp.area_m2)
    shown = 1e6 / (1e6 / lamp.kelvin - 1e6 / _BALANCE_K + 1e6 / _WHITE_K)
    red, green, blue = (quantized(radiance * c, 5) for c in color_of_temperature(shown))
    return SLOTS["opal"].material().model_copy(update={"emission": (red, green, blue)})


def _vector(value: ArrayLike) -> tuple[float, float, float]:
    x, y, z = np.round(np.asarray(value, dtype=np.float64), 6).tolist()
    return (x, y, z)


def _supports(room: MadeRoom, rectangles: list[Rectangle]) -> list[SupportSurface]:
    height = room.furnished.shell.height
    found: list[tuple[str, SupportKind, ArrayLike, ArrayLike, ArrayLike, float]] = []
    shell_supports = [p for p in room.furnished.built if p.item.supports]
    for p in (*room.furnished.items, *shell_supports):
        matrix = p.room_from_item
        for k, s in enumerate(p.item.supports):
            (x, y), (w, d) = s.middle, s.size
            if min(w, d) < 0.05:
                continue
            origin = matrix @ np.array([x - w / 2, y - d / 2, s.z, 1.0])
            clear = min(s.clearance_m, height - float(origin[2]) - 0.05)
            edges = matrix[:3, 0] * w, matrix[:3, 1] * d
            found.append((f"{p.name} {k}", s.kind, origin[:3], *edges, quantized(clear, 4)))
    for k, (low, high) in enumerate(rectangles[:_MAX_FLOORS]):
        w, d = (quantized(side, 4) for side in high - low)
        found.append((f"floor {k}", "floor", [*low, 0.0], (w, 0, 0), (0, d, 0), 2.0))
    return [
        SupportSurface(
            name=name,
            kind=kind,
            origin_m=_vector(o),
            edge_u_m=_vector(u),
            edge_v_m=_vector(v),
            clearance_m=clear,
        )
        for name, kind, o, u, v, clear in found
    ]


def _light_slots(room: MadeRoom) -> list[LightSlot]:
    found = []
    for p in room.furnished.items:
        for k, place in enumerate(p.item.places):
            at = (p.room_from_item @ np.array([*place.at, 1.0]))[:3]
            name = f"{p.name} {k}"
            if place.size is None:
                found.append(LightSlot(name=name, kind="point", origin_m=_vector(at)))
                continue
            w, d = place.size
            corner = _vector(at + np.array([-w / 2, d / 2, 0.0]))
            edge_u, edge_v = _vector((quantized(w, 6), 0, 0)), _vector((0, -quantized(d, 6), 0))
            found.append(LightSlot(name=name, kind="area", origin_m=corner, edge_u_m=edge_u, edge_v_m=edge_v))
    return found


def _regions(room: MadeRoom, rectangles: list[Rectangle]) -> list[Box]:
    """Return camera regions above free rectangles (corners (2,), (2,)) of the floor."""
    top = min(_REGION_TOP_M, room.furnished.shell.height - 0.15)
    return [Box(minimum_m=_vector([*low, 0.0]), maximum_m=_vector([*high, top])) for low, high in rectangles]


def _free_rectangles(room: MadeRoom) -> list[Rectangle]:
    """Return disjoint rectangles (corners (2,), (2,)) of the walkable floor, largest first."""
    shell = room.furnished.shell
    free = walkable(shell, np.concatenate([p.boxes() for p in room.furnished.items]))[0]
    origin = np.array([-shell.width / 2, -shell.depth / 2])
    found = []
    for r0, r1, c0, c1 in rectangles(free, _MAX_REGIONS, 1):
        if min(r1 - r0, c1 - c0) < 2:
            break
        found.append((origin + CELL_M * np.array([c0, r0]), origin + CELL_M * np.array([c1, r1])))
    return found
