# SPDX-License-Identifier: MIT
"""A small library for tests: furnished rooms with a window, eight objects and six materials.

All shapes consist of boxes, cylinders and spheres; ``write_small_library`` takes less than a second.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from datagen.formats.asset import (
    Box,
    EnvironmentAsset,
    LightSlot,
    Material,
    MaterialAsset,
    ObjectAsset,
    Opening,
    Part,
    Provenance,
    SlotMaterial,
    SupportSurface,
    Texture,
)
from datagen.formats.package import write_package
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.mesh import Mesh, flat_shaded, vertex_normals
from datagen.foundation.meshes.ply import encode_ply

CC0 = Provenance(license="CC0-1.0", author="tests")
WALL_M = 0.1


def box(minimum: Any, maximum: Any) -> trimesh.Trimesh:
    """Return an axis-aligned box with outward-facing triangles."""
    low, high = np.asarray(minimum, float), np.asarray(maximum, float)
    mesh = trimesh.creation.box(extents=high - low)
    mesh.apply_translation(0.5 * (low + high))
    return mesh


def cylinder(radius: float, height: float, sections: int = 24) -> trimesh.Trimesh:
    """Return an upright cylinder with its base at z = 0."""
    mesh = trimesh.creation.cylinder(radius=radius, height=height, sections=sections)
    mesh.apply_translation([0, 0, 0.5 * height])
    return mesh


def ball(radius: float) -> trimesh.Trimesh:
    """Return a sphere with a small flat base at z = 0; a true sphere would be unstable."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    vertices = np.array(mesh.vertices)
    vertices[:, 2] = np.maximum(vertices[:, 2], -0.95 * radius)
    vertices[:, 2] -= vertices[:, 2].min()
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def with_uv(shape: trimesh.Trimesh, *, smooth: bool = False) -> Mesh:
    """Return the shape with smooth or flat normals and box-projected UVs of one unit per metre."""
    raw = Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32))
    mesh = Mesh(raw.positions, raw.faces, vertex_normals(raw)) if smooth else flat_shaded(raw)
    assert mesh.normals is not None
    axis = np.abs(mesh.normals).argmax(axis=1)
    choose = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    uv = np.take_along_axis(mesh.positions, choose, axis=1).astype(np.float32)
    return Mesh(mesh.positions, mesh.faces, mesh.normals, uv)


def write_material(
    root: Path, name: str, classes: tuple[str, ...], texture: bool = False, **channels: Any
) -> None:
    """Write a material package; if ``texture``, its diffuse albedo is a 16 x 16 noise image."""
    files: dict[str, bytes | Path] = {}
    if texture:
        noise = np.random.default_rng(len(name)).uniform(90, 160, (16, 16, 3)).astype(np.uint8)
        files["albedo.png"] = encode_png(noise)
        channels["diffuse_albedo"] = Texture(texture="albedo.png", encoding="srgb")
        channels.setdefault("tile_size_m", 0.5)
    material = Material(classes=classes, **channels)  # type: ignore[arg-type]
    asset = MaterialAsset(id=name, title=name, provenance=CC0, material=material)
    write_package(root / "materials" / name, asset, files)


def write_object(
    root: Path,
    name: str,
    category: str,
    shapes: dict[str, trimesh.Trimesh],
    materials: dict[str, SlotMaterial] | None = None,
    **fields: Any,
) -> None:
    """Write an object package with one part and one material slot per shape."""
    materials = materials or {
        slot: SlotMaterial(classes=("plastic",), replaceable_by=("plastic", "wood", "metal"))
        for slot in shapes
    }
    meshes = {slot: with_uv(shape) for slot, shape in shapes.items()}
    points = np.concatenate([mesh.positions for mesh in meshes.values()]).astype(float)
    parts = tuple(
        Part(name=slot, mesh=f"{slot}.ply", material=slot, uv_per_m=meshes[slot].uv_per_m())
        for slot in shapes
    )
    asset = ObjectAsset(
        id=name,
        title=name,
        provenance=fields.pop("provenance", CC0),
        category=category,
        materials=materials,
        parts=parts,
        minimum_m=tuple(points.min(axis=0).tolist()),
        maximum_m=tuple(points.max(axis=0).tolist()),
        **fields,
    )
    write_package(
        root / "objects" / name, asset, {f"{slot}.ply": encode_ply(m) for slot, m in meshes.items()}
    )


def room_shapes(width: float, depth: float, height: float) -> dict[str, trimesh.Trimesh]:
    """Return the parts of a furnished room over [0, w] x [0, d] x [0, h] with a window in the wall at +Y."""
    t, w, d, h = WALL_M, width, depth, height
    left, right, sill, head = 0.3 * w, 0.7 * w, 0.9, min(2.1, h - 0.2)
    walls = [
        box([-t, -t, 0], [0, d + t, h]),
        box([w, -t, 0], [w + t, d + t, h]),
        box([0, -t, 0], [w, 0, h]),
        box([0, d, 0], [left, d + t, h]),
        box([right, d, 0], [w, d + t, h]),
        box([left, d, 0], [right, d + t, sill]),
        box([left, d, head], [right, d + t, h]),
    ]
    legs = [box([x, y, 0], [x + 0.06, y + 0.06, 0.71]) for x in (1.2, 2.54) for y in (1.0, 1.74)]
    return {
        "floor": box([-t, -t, -t], [w + t, d + t, 0]),
        "ceiling": box([-t, -t, h], [w + t, d + t, h + t]),
        "walls": trimesh.util.concatenate(walls),
        "table": trimesh.util.concatenate([box([1.15, 0.95, 0.71], [2.65, 1.85, 0.75]), *legs]),
        "shelf": trimesh.util.concatenate(
            [box([w - 0.35, 1.0, z], [w, 2.4, z + 0.03]) for z in (0.5, 0.95, 1.4)]
        ),
    }


def write_room(
    root: Path, name: str, size: tuple[float, float, float] = (5.0, 4.0, 2.7), **changes: Any
) -> EnvironmentAsset:
    """Write the room of :func:`room_shapes` as an environment package; ``changes`` replace its fields."""
    w, d, h = size
    shapes = room_shapes(w, d, h)
    meshes = {part: with_uv(shape) for part, shape in shapes.items()}
    materials = {
        "floor": SlotMaterial(
            classes=("wood",), diffuse_albedo=(0.35, 0.22, 0.12), replaceable_by=("wood", "stone")
        ),
        "ceiling": SlotMaterial(classes=("painted",), diffuse_albedo=(0.8, 0.8, 0.8)),
        "walls": SlotMaterial(
            classes=("painted",), diffuse_albedo=(0.7, 0.66, 0.6), replaceable_by=("painted",)
        ),
        "table": SlotMaterial(
            classes=("wood",), diffuse_albedo=(0.3, 0.2, 0.1), replaceable_by=("wood", "plastic")
        ),
        "shelf": SlotMaterial(
            classes=("wood",), diffuse_albedo=(0.6, 0.5, 0.4), replaceable_by=("wood", "metal")
        ),
    }
    supports = [
        SupportSurface(
            name="floor",
            kind="floor",
            origin_m=(0.02, 0.02, 0),
            edge_u_m=(w - 0.04, 0, 0),
            edge_v_m=(0, d - 0.04, 0),
            clearance_m=h,
        ),
        SupportSurface(
            name="table",
            kind="table",
            origin_m=(1.15, 0.95, 0.75),
            edge_u_m=(1.5, 0, 0),
            edge_v_m=(0, 0.9, 0),
            clearance_m=h - 0.75,
        ),
    ]
    supports += [
        SupportSurface(
            name=f"shelf{k}",
            kind="shelf",
            origin_m=(w - 0.35, 1.0, z + 0.03),
            edge_u_m=(0.35, 0, 0),
            edge_v_m=(0, 1.4, 0),
            clearance_m=0.42,
        )
        for k, z in enumerate((0.5, 0.95, 1.4))
    ]
    fields: dict[str, Any] = {
        "support_surfaces": tuple(supports),
        "light_slots": (
            LightSlot(
                name="ceiling",
                kind="area",
                origin_m=(0.4 * w, 0.6 * d, h - 0.01),
                edge_u_m=(0.2 * w, 0, 0),
                edge_v_m=(0, -0.2 * d, 0),
            ),
            LightSlot(name="bulb", kind="point", origin_m=(0.5 * w, 0.5 * d, h - 0.4)),
        ),
        "openings": (
            Opening(
                name="window",
                origin_m=(0.3 * w, d, 0.9),
                edge_u_m=(0.4 * w, 0, 0),
                edge_v_m=(0, 0, min(2.1, h - 0.2) - 0.9),
            ),
        ),
        "camera_regions": (Box(minimum_m=(0.3, 0.3, 0.0), maximum_m=(w - 0.3, d - 0.3, h - 0.2)),),
    }
    fields.update(changes)
    asset = EnvironmentAsset(
        id=name,
        title=name,
        provenance=fields.pop("provenance", CC0),
        materials=fields.pop("materials", materials),
        parts=tuple(Part(name=p, mesh=f"{p}.ply", material=p, uv_per_m=meshes[p].uv_per_m()) for p in shapes),
        **fields,
    )
    write_package(root / "environments" / name, asset, {f"{p}.ply": encode_ply(m) for p, m in meshes.items()})
    return asset


def write_package_of(
    root: Path,
    name: str,
    shapes: dict[str, trimesh.Trimesh],
    files: dict[str, Path] | None = None,
    **fields: Any,
) -> EnvironmentAsset:
    """Write an environment package with one grey part per shape and the additional ``files``."""
    meshes = {part: with_uv(shape) for part, shape in shapes.items()}
    asset = EnvironmentAsset(
        id=name,
        title=name,
        provenance=CC0,
        materials={part: SlotMaterial(classes=("plaster",)) for part in shapes},
        parts=tuple(Part(name=p, mesh=f"{p}.ply", material=p) for p in shapes),
        **fields,
    )
    encoded = {f"{part}.ply": encode_ply(mesh) for part, mesh in meshes.items()}
    write_package(root / name, asset, {**encoded, **(files or {})})
    return asset


def chair() -> trimesh.Trimesh:
    """Return the mesh of a chair with a seat, a back (at +Y) and four legs."""
    legs = [box([x, y, 0], [x + 0.04, y + 0.04, 0.45]) for x in (-0.2, 0.16) for y in (-0.2, 0.16)]
    return trimesh.util.concatenate(
        [*legs, box([-0.2, -0.2, 0.45], [0.2, 0.2, 0.49]), box([-0.2, 0.16, 0.49], [0.2, 0.2, 0.9])]
    )


def write_objects(root: Path) -> None:
    """Write eight objects of six categories."""
    small: tuple[str, ...] = ("table", "shelf", "counter")
    write_object(
        root,
        "box-small",
        "box",
        {"body": box([-0.08, -0.06, 0], [0.08, 0.06, 0.1])},
        supports=small,
        scale_range=(0.8, 1.5),
    )
    write_object(root, "can", "tin", {"body": cylinder(0.04, 0.12)}, supports=small)
    write_object(root, "ball", "toy", {"body": ball(0.07)}, supports=(*small, "floor"))
    bottle = {"body": cylinder(0.035, 0.2), "cap": cylinder(0.015, 0.06).apply_translation([0, 0, 0.2001])}
    write_object(root, "bottle", "bottle", bottle, supports=small)
    cup = trimesh.creation.annulus(r_min=0.035, r_max=0.04, height=0.09, sections=24)
    cup.apply_translation([0, 0, 0.045])
    write_object(root, "ring-cup", "cup", {"body": cup}, supports=small)
    write_object(
        root,
        "book",
        "book",
        {"body": box([-0.1, -0.07, 0], [0.1, 0.07, 0.03])},
        supports=small,
        yaw_range_rad=(-0.3, 0.3),
    )
    write_object(root, "chair", "chair", {"frame": chair()}, supports=("floor",))
    write_object(
        root, "cabinet", "cabinet", {"body": box([-0.4, -0.2, 0], [0.4, 0.2, 1.2])}, supports=("floor",)
    )


def write_small_library(root: Path, num_rooms: int = 1) -> Path:
    """Write the library with ``num_rooms`` rooms of different sizes to ``root`` and return ``root``."""
    for k in range(num_rooms):
        write_room(root, f"room-{k}", (5.0 + 0.5 * k, 4.0 + 0.3 * k, 2.7))
    write_objects(root)
    write_material(root, "oak", ("wood",), texture=True, roughness=0.6)
    write_material(root, "walnut", ("wood",), diffuse_albedo=(0.15, 0.08, 0.04), roughness=0.4)
    write_material(
        root, "steel", ("metal",), diffuse_albedo=(0, 0, 0), specular_albedo=(0.56, 0.57, 0.58), roughness=0.3
    )
    write_material(root, "red-plastic", ("plastic",), diffuse_albedo=(0.6, 0.05, 0.03), roughness=0.35)
    write_material(root, "blue-paint", ("painted",), diffuse_albedo=(0.2, 0.3, 0.5), roughness=0.7)
    write_material(root, "slate", ("stone",), texture=True, roughness=0.55)
    return root
