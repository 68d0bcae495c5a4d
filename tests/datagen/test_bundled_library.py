# SPDX-License-Identifier: MIT
"""The bundled library: packages are valid, and rooms match their openings, supports and camera regions."""

from __future__ import annotations

from collections import Counter
from functools import lru_cache

import numpy as np
import pytest

from datagen.assembly.geometry import AssetGeometry, RayScene, load_geometry
from datagen.assembly.placement import CONTACT_TOLERANCE_M, MIN_CONTACT_MARGIN_M
from datagen.assembly.things import convex_hull_2d, margin_inside
from datagen.asset_check import check_package
from datagen.formats.asset import (
    DAYTIMES,
    EnvironmentAsset,
    MaterialAsset,
    ObjectAsset,
    PanoramaAsset,
    SupportSurface,
)
from datagen.formats.package import open_package
from datagen.foundation.bundled import bundled_library
from datagen.foundation.images import read_image
from datagen.library import Library

ROOT = bundled_library()
MAX_BYTES = 40_000_000
ENVIRONMENTS = ("bathroom", "dining_room", "kitchen", "living_room", "study")
MAX_TRIANGLES = {"environment": 150_000, "object": 15_000}
OUTSIDE = "outside"  # prefix of parts outside the windows


@lru_cache(maxsize=1)
def library() -> Library:
    return Library([ROOT])


@lru_cache(maxsize=8)
def geometry(name: str) -> AssetGeometry:
    return load_geometry(library().package(name))


def room_rays(name: str) -> RayScene:
    """Return the ray-tracing scene of a room without the parts outside its windows."""
    loaded = geometry(name)
    inside = np.array([not part.name.startswith(OUTSIDE) for part in loaded.asset.parts])
    return RayScene(loaded.vertices, loaded.faces[inside[loaded.part_of_face]])


def environment(name: str) -> EnvironmentAsset:
    asset = library().package(name).asset
    assert isinstance(asset, EnvironmentAsset)
    return asset


def triangles_cut_box(corners: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the mask (M,) of triangles (M, 3, 3) that intersect the open box, by separating axes."""
    near = ((corners.min(axis=1) < high) & (corners.max(axis=1) > low)).all(axis=1)
    found = np.zeros(len(corners), dtype=bool)
    center, half = (low + high) / 2, (high - low) / 2
    for index in np.flatnonzero(near):
        triangle = corners[index] - center
        edges = np.roll(triangle, -1, axis=0) - triangle
        axes = [np.cross(edges[0], edges[1]), *(np.cross(e, a) for e in edges for a in np.eye(3))]
        separated = False
        for axis in axes:
            reach = np.abs(axis) @ half
            along = triangle @ axis
            if along.min() >= reach or along.max() <= -reach:
                separated = True
                break
        found[index] = not separated
    return found


def test_the_library_has_enough_assets() -> None:
    kinds = Counter(package.asset.kind for package in library())
    assert kinds["environment"] >= 5 and kinds["object"] >= 60 and kinds["material"] >= 100
    objects = [p.asset for p in library() if isinstance(p.asset, ObjectAsset)]
    assert len({asset.category for asset in objects}) >= 15
    materials = [p.asset for p in library() if isinstance(p.asset, MaterialAsset)]
    classes = Counter(asset.material.classes[0] for asset in materials)
    assert len(classes) >= 12
    assert {p.id for p in library() if p.asset.kind == "environment"} == set(ENVIRONMENTS)


def test_size_and_licence() -> None:
    files = [path for path in ROOT.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= MAX_BYTES
    assert max(path.stat().st_size for path in files) < 1_000_000
    assert {package.asset.provenance.license for package in library()} == {"CC0-1.0"}


def test_panoramas_show_every_time_of_day() -> None:
    """Each time of day has at least two panoramas, which are finite and brighter above the horizon."""
    found: dict[str, list[np.ndarray]] = {}
    for package in library().select("panorama"):
        assert isinstance(package.asset, PanoramaAsset)
        pixels = read_image(package.local_file(package.asset.image))
        assert pixels.shape == (384, 768, 3) and np.isfinite(pixels).all() and pixels.min() >= 0
        found.setdefault(package.asset.daytime, []).append(pixels)
    assert set(found) == set(DAYTIMES) and min(map(len, found.values())) >= 2
    assert all(p[:192].mean() > 3 * p[192:].mean() for panoramas in found.values() for p in panoramas)


def test_every_class_of_a_slot_has_materials() -> None:
    supply = Counter(p.asset.material.classes[0] for p in library() if isinstance(p.asset, MaterialAsset))
    for package in library():
        if not isinstance(package.asset, ObjectAsset | EnvironmentAsset):
            continue
        for name, slot in package.asset.materials.items():
            missing = [c for c in slot.replaceable_by if supply[c] == 0]
            assert not missing, f"{package.id}.{name}: no material of class {missing}"


@pytest.mark.parametrize("kind", ["material", "object", "environment", "panorama"])
def test_packages_are_sound(kind: str) -> None:
    faults = []
    for package in library():
        if package.asset.kind == kind:
            faults += [str(problem) for problem in check_package(package).errors]
    assert not faults, "\n".join(faults)


def test_materials_are_plausible() -> None:
    for package in library():
        if not isinstance(package.asset, MaterialAsset):
            continue
        material = package.asset.material
        if isinstance(material.specular_albedo, tuple) and material.classes[0] != "metal":
            assert 0.015 <= max(material.specular_albedo) <= 0.12, package.id
        if isinstance(material.diffuse_albedo, tuple):
            assert max(material.diffuse_albedo) <= 0.9, package.id
            if material.classes[0] == "metal" and isinstance(material.specular_albedo, tuple):
                assert min(material.specular_albedo) > 0.02, package.id
        assert material.tile_size_m is not None, package.id


def test_objects_rest_on_the_ground_within_budget() -> None:
    for package in library():
        if not isinstance(package.asset, ObjectAsset):
            continue
        loaded = load_geometry(package)
        assert len(loaded.faces) <= MAX_TRIANGLES["object"], package.id
        assert abs(loaded.minimum_m[2]) < 1e-4, package.id
        size = loaded.maximum_m - loaded.minimum_m
        assert 0.02 < size.max() < 0.75, package.id
        assert np.abs(loaded.maximum_m + loaded.minimum_m)[:2].max() < 1e-3, package.id


def test_objects_stand_stably() -> None:
    """The centre of mass is above the convex hull of the contacts, as placement requires."""
    toppling = []
    for package in library():
        if isinstance(package.asset, ObjectAsset):
            loaded = load_geometry(package)
            contacts = loaded.vertices[loaded.vertices[:, 2] < CONTACT_TOLERANCE_M][:, :2]
            margin = margin_inside(convex_hull_2d(contacts), loaded.center_of_mass_m[:2])
            if margin < MIN_CONTACT_MARGIN_M:
                toppling.append(f"{package.id}: {margin:.4f} m")
    assert not toppling, toppling


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_room_is_complete(name: str) -> None:
    asset = environment(name)
    assert len(geometry(name).faces) <= MAX_TRIANGLES["environment"]
    assert asset.openings and asset.light_slots and asset.camera_regions and len(asset.support_surfaces) >= 4
    replaceable = [slot for slot in asset.materials.values() if slot.replaceable_by]
    assert len(replaceable) >= 12
    for part in asset.parts:
        if asset.materials[part.material].replaceable_by:
            assert part.uv_per_m, part.name


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_room_is_closed_except_for_its_openings(name: str) -> None:
    """Rays from camera regions hit front faces or leave through an opening."""
    asset, rays = environment(name), room_rays(name)
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(60_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    share = len(directions) // len(asset.camera_regions)
    origins = np.concatenate(
        [rng.uniform(r.minimum_m, r.maximum_m, size=(share, 3)) for r in asset.camera_regions]
    )
    directions = directions[: len(origins)]
    hits = rays.cast(origins, directions)
    assert rays.is_back_hit(hits, directions).mean() < 2e-4
    escaped = ~hits.hit_mask
    assert 0.001 < escaped.mean() < 0.3
    leaves = np.zeros(len(origins), dtype=bool)
    for opening in asset.openings:
        leaves |= crosses(origins, directions, opening)
    assert not (escaped & ~leaves).any()


def crosses(origins: np.ndarray, directions: np.ndarray, opening: object, slack: float = 0.02) -> np.ndarray:
    """Return the mask (N,) of rays through the opening's rectangle, widened by ``slack`` metres."""
    origin, u, v = (np.array(getattr(opening, key)) for key in ("origin_m", "edge_u_m", "edge_v_m"))
    normal = np.cross(u, v)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((origin - origins) @ normal) / (directions @ normal)
        at = origins + t[:, None] * directions - origin
    s, r = at @ u / (u @ u), at @ v / (v @ v)
    du, dv = slack / np.linalg.norm(u), slack / np.linalg.norm(v)
    return (t > 0) & (s > -du) & (s < 1 + du) & (r > -dv) & (r < 1 + dv)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_opening_points_into_the_room(name: str) -> None:
    rays = room_rays(name)
    for opening in environment(name).openings:
        u, v = np.array(opening.edge_u_m), np.array(opening.edge_v_m)
        inward = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
        # nine positions, because a bar may cover the centre of a pane
        steps = np.array([0.2, 0.45, 0.8])
        starts = np.array([np.array(opening.origin_m) + a * u + b * v for a in steps for b in steps])
        hits = rays.cast(starts + 0.01 * inward, np.tile(inward, (9, 1)))
        assert (hits.distance_m > 1.0).sum() >= 4, opening.name
        assert not rays.cast(starts - 0.01 * inward, np.tile(-inward, (9, 1))).hit_mask.any(), opening.name


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_camera_regions_are_free(name: str) -> None:
    corners = room_rays(name).corners
    loaded = geometry(name)
    for region in environment(name).camera_regions:
        cut = triangles_cut_box(corners, np.array(region.minimum_m), np.array(region.maximum_m))
        if cut.any():
            inside = np.array([not p.name.startswith(OUTSIDE) for p in loaded.asset.parts])
            parts = loaded.part_of_face[inside[loaded.part_of_face]][cut]
            blame = sorted({loaded.asset.parts[i].name for i in parts})
            pytest.fail(f"{name}: {blame} in the region {region.minimum_m} .. {region.maximum_m}")


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_support_surfaces_are_level_and_free(name: str) -> None:
    rays = room_rays(name)
    faults = []
    for surface in environment(name).support_surfaces:
        fault = support_fault(rays, surface)
        if fault:
            faults.append(f"{name}, {surface.name}: {fault}")
    assert not faults, "\n".join(faults)


def support_fault(rays: RayScene, surface: SupportSurface) -> str:
    """Return the fault of a support surface, or ''; the mesh of a soft seat may deviate by 3.5 cm."""
    origin, u, v = (np.array(e) for e in (surface.origin_m, surface.edge_u_m, surface.edge_v_m))
    if abs(u[2]) > 1e-6 or abs(v[2]) > 1e-6 or np.cross(u, v)[2] <= 0:
        return "not level"
    grid = np.array(
        [origin + a * u + b * v for a in np.linspace(0.03, 0.97, 9) for b in np.linspace(0.03, 0.97, 9)]
    )
    lift = 0.05
    hits = rays.cast(grid + np.array([0, 0, lift]), np.tile([0.0, 0.0, -1.0], (len(grid), 1)))
    off = np.abs(hits.distance_m - lift)
    allowed = 0.035 if surface.kind == "seat" else 0.004
    if off.max() > allowed:
        return f"the ground lies {off.max():.3f} m off"
    corners = np.array([origin, origin + u, origin + v, origin + u + v])
    low = corners.min(axis=0) + np.array([0, 0, max(allowed, 0.006)])
    high = corners.max(axis=0) + np.array([0, 0, surface.clearance_m])
    if abs(u[0] * u[1]) < 1e-9 and triangles_cut_box(rays.corners, low, high).any():
        cut = rays.corners[triangles_cut_box(rays.corners, low, high)].reshape(-1, 3)
        return f"not free: {cut.min(axis=0).round(3)} .. {cut.max(axis=0).round(3)}"
    return ""


def test_a_leak_is_detected() -> None:
    """Injected fault: rays escape from a room without its walls."""
    name = "kitchen"
    loaded, asset = geometry(name), environment(name)
    keep = np.array([not p.name.startswith((OUTSIDE, "walls")) for p in asset.parts])
    rays = RayScene(loaded.vertices, loaded.faces[keep[loaded.part_of_face]])
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = rng.uniform(
        asset.camera_regions[0].minimum_m, asset.camera_regions[0].maximum_m, size=(4000, 3)
    )
    leaves = np.zeros(4000, dtype=bool)
    for opening in asset.openings:
        leaves |= crosses(origins, directions, opening)
    assert (~rays.cast(origins, directions).hit_mask & ~leaves).mean() > 0.05


def test_packages_open_one_by_one() -> None:
    """Each package can be opened alone, because none refers to another."""
    for package in library():
        assert open_package(package.path).asset.id == package.path.name
