# SPDX-License-Identifier: MIT
"""Writes 3D boxes and object poses in the layout of the BOP benchmark: ``<split>/000000/scene_gt.json`` etc.

Lengths are in millimetres; camera axes are as in this project: x right, y down, z forward. BOP's poses are
rigid, so each scale of an object is a separate model. ``boxes3d.json`` contains the world-space boxes, in
metres, of all objects, visible or not. ``mask_visib`` and ``bbox_visib`` cover the visible pixels of an
object, ``bbox_obj`` all its projected vertices.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.exports.rooms import Export, Room, RoomView, pixel_box
from datagen.formats.asset import GeometryAsset
from datagen.formats.configuration import PlacedAsset
from datagen.foundation.errors import input_error
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.mesh import Mesh, joined
from datagen.foundation.meshes.ply import decode_ply, encode_ply

ModelKey = tuple[str, tuple[float, float, float]]
"""Id of an asset and its scale along each axis."""


def pose_and_scale(placed: PlacedAsset) -> tuple[NDArray[np.float64], tuple[float, float, float]]:
    """Return an object's rigid pose ``world_from_object`` (4, 4) and its scale along each of its axes.

    Raises :class:`InputError` for a sheared or mirrored object.
    """
    matrix = np.asarray(placed.world_from_asset, dtype=np.float64)
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    pose = matrix.copy()
    pose[:3, :3] /= scale
    if not np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-6) or np.linalg.det(pose) < 0:
        expected = "a rotation, scale and translation"
        raise input_error(placed.name, "world_from_asset", "sheared or mirrored", expected)
    return pose, tuple(round(float(s), 6) for s in scale)  # type: ignore[return-value]


class BopFiles:
    """Writer of one BOP scene per room; :meth:`finish` writes the numbered models of all objects.

    Raises :class:`InputError` if the export has no library from which the models' meshes can be read.
    """

    def __init__(self, export: Export):
        if export.library is None:
            remedy = "name the folders of its assets with --library"
            raise input_error("bop", got="no library", expected="the objects' meshes", remedy=remedy)
        self.export, self.library = export, export.library
        keys = {self.key(placed) for room in export.rooms for placed in room.objects().values()}
        self.numbers: dict[ModelKey, int] = {key: k for k, key in enumerate(sorted(keys), start=1)}
        self.meshes: dict[str, Mesh] = {}
        self.num_scenes: dict[str, int] = {}

    def key(self, placed: PlacedAsset) -> ModelKey:
        return placed.asset, pose_and_scale(placed)[1]

    def mesh(self, key: ModelKey) -> Mesh:
        """Return the mesh of a model at its scale, in the asset's frame, in metres."""
        asset_id, scale = key
        if asset_id not in self.meshes:
            package = self.library.package(asset_id)
            parts = []
            for part in package.as_kind(GeometryAsset).parts:
                mesh = decode_ply(package.read_bytes(part.mesh), f"{package.path}/{part.mesh}")
                bare = Mesh(mesh.positions, mesh.faces)
                parts.append(bare.placed(np.asarray(part.asset_from_part, dtype=np.float64)))
            self.meshes[asset_id] = joined(parts)
        return self.meshes[asset_id].transformed(np.diag([*scale, 1.0]))

    def add(self, room: Room) -> None:
        """Write a room as a scene: images, depth, masks, poses and boxes."""
        number = self.num_scenes.get(room.split, 0)
        self.num_scenes[room.split] = number + 1
        folder = f"{room.split}/{number:06d}"
        objects = {
            name: (*pose_and_scale(placed), self.key(placed)) for name, placed in room.objects().items()
        }
        vertices = {name: self.mesh(o[2]).positions.astype(np.float64) for name, o in objects.items()}
        boxes = []
        for name, (pose, scale, key) in objects.items():
            low, high = vertices[name].min(0), vertices[name].max(0)
            boxes.append(
                {
                    "instance": name,
                    "asset": key[0],
                    "obj_id": self.numbers[key],
                    "scale": scale,
                    "world_from_object": pose.tolist(),
                    "center_m": (pose[:3, :3] @ ((low + high) / 2) + pose[:3, 3]).tolist(),
                    "size_m": (high - low).tolist(),
                    "rotation": pose[:3, :3].tolist(),
                }
            )
        self.export.write_json(
            f"{folder}/boxes3d.json", {"configuration": room.configuration.id, "boxes": boxes}
        )
        tables: dict[str, dict[str, Any]] = {"scene_camera": {}, "scene_gt": {}, "scene_gt_info": {}}
        for image, view in enumerate(room.views):
            camera_entry, poses, infos = self.view(folder, image, view, objects, vertices)
            for table, entry in zip(tables.values(), (camera_entry, poses, infos), strict=True):
                table[str(image)] = entry
        for name, table in tables.items():
            self.export.write_json(f"{folder}/{name}.json", table)

    def view(
        self,
        folder: str,
        image: int,
        view: RoomView,
        objects: dict[str, tuple[NDArray[np.float64], tuple[float, float, float], ModelKey]],
        vertices: dict[str, NDArray[np.float64]],
    ) -> tuple[dict[str, Any], list[dict[str, Any]], list[dict[str, Any]]]:
        """Write view number ``image``; return its entries in the scene's tables: camera, poses and boxes.

        ``objects``: pose, scale and model by name; ``vertices``: scaled mesh vertices (N, 3) by name.
        """
        camera = view.camera
        buffers = view.read("beauty", "depth_z_m", "instance_id")
        depth_mm = buffers["depth_z_m"][..., 0].astype(np.float64) * 1e3
        unit_mm = max(0.1, float(depth_mm.max()) / 65535)
        self.export.write_picture(f"{folder}/rgb/{image:06d}.png", buffers["beauty"], view.record.exposure)
        stored = np.clip(depth_mm / unit_mm + 0.5, 0, 65535).astype(np.uint16)
        self.export.write(f"{folder}/depth/{image:06d}.png", encode_png(stored))
        ids = buffers["instance_id"][..., 0]
        id_of = {name: int(key) for key, name in view.record.instances.items()}
        poses: list[dict[str, Any]] = []
        infos: list[dict[str, Any]] = []
        for name, (pose, _, key) in objects.items():
            mask = ids == id_of.get(name, 0)
            if name not in id_of or not mask.any():
                continue
            camera_from_object = camera.camera_from_world @ pose
            label = f"{folder}/mask_visib/{image:06d}_{len(poses):06d}.png"
            self.export.write(label, encode_png(np.where(mask, 255, 0).astype(np.uint8)))
            poses.append(
                {
                    "cam_R_m2c": camera_from_object[:3, :3].ravel().tolist(),
                    "cam_t_m2c": (1e3 * camera_from_object[:3, 3]).tolist(),
                    "obj_id": self.numbers[key],
                }
            )
            pixels, depth = camera.project(vertices[name] @ pose[:3, :3].T + pose[:3, 3])
            infos.append(
                {
                    "bbox_obj": _box(pixels[:, 0], pixels[:, 1]) if depth.min() > 0 else [-1, -1, -1, -1],
                    "bbox_visib": pixel_box(mask),
                    "px_count_visib": int(mask.sum()),
                    "px_count_valid": int((mask & (depth_mm > 0)).sum()),
                }
            )
        cx, cy = camera.cx_px - 0.5, camera.cy_px - 0.5  # BOP's origin is the centre of the first pixel
        entry = {
            "cam_K": [camera.fx_px, 0.0, cx, 0.0, camera.fy_px, cy, 0.0, 0.0, 1.0],
            "depth_scale": unit_mm,
            "cam_R_w2c": camera.camera_from_world[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1e3 * camera.camera_from_world[:3, 3]).tolist(),
        }
        return entry, poses, infos

    def finish(self) -> None:
        """Write the models and ``models_info.json`` in mm; ``diameter`` is the bounding box's diagonal."""
        infos: dict[str, Any] = {}
        for key, number in self.numbers.items():
            mesh = self.mesh(key).transformed(np.diag([1e3, 1e3, 1e3, 1.0]))
            low, high = mesh.positions.min(0), mesh.positions.max(0)
            infos[str(number)] = {
                "diameter": float(np.linalg.norm(high - low)),
                **{f"min_{axis}": float(low[k]) for k, axis in enumerate("xyz")},
                **{f"size_{axis}": float(high[k] - low[k]) for k, axis in enumerate("xyz")},
                "asset": key[0],
                "scale": key[1],
            }
            self.export.write(f"models/obj_{number:06d}.ply", encode_ply(mesh))
        self.export.write_json("models/models_info.json", infos)


def _box(x: NDArray, y: NDArray) -> list[int]:
    left, top = int(np.floor(x.min())), int(np.floor(y.min()))
    return [left, top, int(np.ceil(x.max())) - left, int(np.ceil(y.max())) - top]
