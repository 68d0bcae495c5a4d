# SPDX-License-Identifier: MIT
"""Scenes of a few quads and boxes with analytic images, for the tests of the renderer."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from datagen.formats.asset import EnvironmentAsset, MaterialAsset, ObjectAsset, Part, Provenance, SlotMaterial
from datagen.formats.configuration import Configuration, PlacedAsset, ViewCamera
from datagen.formats.package import write_package
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.meshes.mesh import Mesh, flat_shaded
from datagen.foundation.meshes.ply import encode_ply
from datagen.library import Library
from datagen.rendering.renderer import SceneRenderer

CC0 = Provenance(license="CC0-1.0", author="tests")
GREY = SlotMaterial(diffuse_albedo=(0.5, 0.5, 0.5), specular_albedo=(0.0, 0.0, 0.0), roughness=1.0)


def quad(origin: Any, edge_u: Any, edge_v: Any, *, has_uv: bool = True, flip_u: bool = False) -> Mesh:
    """Rectangle from a corner and two edges [m], with normal edge_u x edge_v; ``flip_u`` mirrors u."""
    o, u, v = (np.asarray(a, dtype=np.float64) for a in (origin, edge_u, edge_v))
    normal = np.cross(u, v)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    if flip_u:
        uv[:, 0] = 1 - uv[:, 0]
    return Mesh(
        np.stack([o, o + u, o + u + v, o + v]).astype(np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.tile(normal / np.linalg.norm(normal), (4, 1)).astype(np.float32),
        uv if has_uv else None,
    )


def box(side: float = 1.0) -> Mesh:
    """Flat-shaded cube without UVs, centred on the z axis with its bottom at z = 0; ``side`` in metres."""
    shape = trimesh.creation.box([side, side, side])
    shape.apply_translation([0, 0, side / 2])
    return flat_shaded(Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32)))


def down_camera(
    width: int = 8, height: int = 8, view_m: float = 0.01, at: Any = (0.0, 0.0), z: float = 1.0
) -> Camera:
    """Camera that looks down from height ``z`` above ``at`` (x, y); its image is ``view_m`` wide at z = 0.

    Lengths are in metres. The image's right is +x and its top is +y.
    """
    focal = width * z / view_m
    pose = look_at([at[0], at[1], z], [at[0], at[1], 0.0], up=(0.0, 1.0, 0.0))
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


@dataclass
class SmallScene:
    """Assets of a small library: an environment, objects and materials.

    Environment: ``parts``, (mesh, slot) by name; ``slots``, material by slot; ``files``, content by name;
    ``uv_per_m``, UV units per metre. ``objects``: (mesh, material of the slot ``skin``) by id. ``materials``:
    (material, files) by id.
    """

    parts: dict[str, tuple[Mesh, str]] = field(
        default_factory=lambda: {"floor": (quad([-5, -5, 0], [10, 0, 0], [0, 10, 0]), "grey")}
    )
    slots: dict[str, SlotMaterial] = field(default_factory=lambda: {"grey": GREY})
    files: dict[str, bytes] = field(default_factory=dict)
    objects: dict[str, tuple[Mesh, SlotMaterial]] = field(default_factory=dict)
    materials: dict[str, tuple[Any, dict[str, bytes]]] = field(default_factory=dict)
    uv_per_m: float | None = None

    def write(self, root: Path) -> Library:
        """Write the packages to the folder ``root`` and open it as a library."""
        environment = EnvironmentAsset(
            id="room",
            title="room",
            provenance=CC0,
            materials=self.slots,
            parts=tuple(
                Part(name=name, mesh=f"{name}.ply", material=slot, uv_per_m=self.uv_per_m)
                for name, (_, slot) in self.parts.items()
            ),
        )
        meshes = {f"{name}.ply": encode_ply(mesh) for name, (mesh, _) in self.parts.items()}
        write_package(root / "room", environment, {**meshes, **self.files})
        for name, (mesh, material) in self.objects.items():
            (x0, y0, z0), (x1, y1, z1) = (
                mesh.positions.min(axis=0).tolist(),
                mesh.positions.max(axis=0).tolist(),
            )
            asset = ObjectAsset(
                id=name,
                title=name,
                provenance=CC0,
                category="thing",
                minimum_m=(x0, y0, z0),
                maximum_m=(x1, y1, z1),
                materials={"skin": material},
                parts=(Part(name="body", mesh="body.ply", material="skin"),),
            )
            write_package(root / name, asset, {"body.ply": encode_ply(mesh)})
        for name, (material, files) in self.materials.items():
            asset_of_material = MaterialAsset(id=name, title=name, provenance=CC0, material=material)
            write_package(root / name, asset_of_material, files)
        return Library([root])


def configure(library: Library, cameras: list[Camera], **fields: Any) -> Configuration:
    """Configuration of the room with all packages of ``library`` as assets; ``fields`` are further fields."""
    fields.setdefault("environment", PlacedAsset(name="room", asset="room"))
    views = tuple(ViewCamera.from_camera(f"view_{k}", camera) for k, camera in enumerate(cameras))
    assets = {package.id: package.sha256 for package in library}
    return Configuration(id="test", index=0, seed=3, cameras=views, assets=assets, **fields)


def renderer(
    root: Path,
    scene: SmallScene | None = None,
    cameras: list[Camera] | None = None,
    recipe: RenderRecipe | None = None,
    **fields: Any,
) -> SceneRenderer:
    """Renderer of a scene, written to ``root``; default: grey floor from above, direct light, no denoiser."""
    library = (scene or SmallScene()).write(root)
    recipe = recipe or RenderRecipe(path_samples=256, auxiliary_samples=16, max_depth=2, denoise=False)
    return SceneRenderer(configure(library, cameras or [down_camera()], **fields), library, recipe)


def placed(x: float, y: float, yaw: float = 0.0, scale: float = 1.0, z: float = 0.0) -> Any:
    """Matrix ``world_from_asset`` as tuples, for a position [m], a yaw about z [rad] and a uniform scale."""
    cosine, sine = scale * np.cos(yaw), scale * np.sin(yaw)
    matrix = np.array([[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, scale, z], [0, 0, 0, 1.0]])
    return tuple(tuple(float(c) for c in row) for row in matrix)
