# SPDX-License-Identifier: MIT
"""Writes folders in the layout of Apple's Hypersim, with one array, ``dataset``, per HDF5 file.

A room is a scene, and its views with the same intrinsics are one camera trajectory (``cam_00``). As in
Hypersim, cameras look along -z with y up, ``depth_meters`` is the distance from the camera's centre, and
positions are in asset units, here metres. Specular albedo and roughness, which Hypersim lacks, accompany
``diffuse_reflectance``.
"""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from datagen.exports.rooms import Export, Room, RoomView
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import input_error

_FLIP = np.diag([1.0, -1.0, -1.0])
_NEAR_M, _FAR_M = 0.01, 1000.0
_BUFFERS = (
    "beauty", "diffuse_albedo", "specular_albedo", "roughness", "normal_world", "depth_z_m", "instance_id",
    "material_id",
)  # fmt: skip


def encode_hdf5(array: NDArray) -> bytes:
    """Encode ``array`` as the ``dataset`` of an HDF5 file. Raises :class:`InputError` without h5py."""
    try:
        import h5py
    except ImportError:
        remedy = "pip install 'scene-materials[export]'"
        raise input_error("hypersim", got="no h5py", expected="the package h5py", remedy=remedy) from None
    stream = io.BytesIO()
    with h5py.File(stream, "w", track_order=False) as file:
        file.create_dataset("dataset", data=array, compression="gzip", compression_opts=4, track_times=False)
    return stream.getvalue()


def cam_from_uv(camera: Camera) -> NDArray[np.float64]:
    """Return the (3, 3) matrix from (u, v, 1), u right and v up in [-1, 1], to camera rays (-z forward)."""
    half_width, half_height = camera.width_px / 2, camera.height_px / 2
    x = [half_width / camera.fx_px, 0.0, (half_width - camera.cx_px) / camera.fx_px]
    y = [0.0, half_height / camera.fy_px, (camera.cy_px - half_height) / camera.fy_px]
    return np.array([x, y, [0.0, 0.0, -1.0]])


def projection(camera: Camera) -> NDArray[np.float64]:
    """Return the projection matrix (4, 4) of a camera in OpenGL's convention (it looks along -z)."""
    width, height, depth = camera.width_px, camera.height_px, _FAR_M - _NEAR_M
    return np.array(
        [
            [2 * camera.fx_px / width, 0.0, 1 - 2 * camera.cx_px / width, 0.0],
            [0.0, 2 * camera.fy_px / height, 2 * camera.cy_px / height - 1, 0.0],
            [0.0, 0.0, -(_FAR_M + _NEAR_M) / depth, -2 * _FAR_M * _NEAR_M / depth],
            [0.0, 0.0, -1.0, 0.0],
        ]
    )


class HypersimFiles:
    """Writer of one scene per room; :meth:`finish` writes the table of all intrinsics."""

    def __init__(self, export: Export):
        self.export = export
        self.trajectories: list[tuple[str, str, Camera]] = []  # scene, trajectory, first camera

    def add(self, room: Room) -> None:
        """Write a room as a scene: frames and cameras of each trajectory, and the unit of length."""
        name = room.configuration.id
        trajectories: dict[tuple[float, ...], list[RoomView]] = {}
        for view in room.views:
            c = view.camera
            intrinsics = (c.width_px, c.height_px, c.fx_px, c.fy_px, c.cx_px, c.cy_px)
            trajectories.setdefault(intrinsics, []).append(view)
        for number, views in enumerate(trajectories.values()):
            label = f"cam_{number:02d}"
            self.trajectories.append((name, label, views[0].camera))
            positions = np.stack([view.camera.position_m for view in views])
            rotations = np.stack([view.camera.world_from_camera[:3, :3] @ _FLIP for view in views])
            detail = f"{name}/_detail/{label}/camera_keyframe_"
            self.export.write(f"{detail}positions.hdf5", encode_hdf5(positions))
            self.export.write(f"{detail}orientations.hdf5", encode_hdf5(rotations))
            self.export.write(f"{detail}frame_indices.hdf5", encode_hdf5(np.arange(len(views))))
            for frame, view in enumerate(views):
                self.frame(f"{name}/images/scene_{label}", frame, view)
        text = "parameter_name,parameter_value\nmeters_per_asset_unit,1.0\n"
        self.export.write(f"{name}/_detail/metadata_scene.csv", text.encode())

    def frame(self, folder: str, frame: int, view: RoomView) -> None:
        """Write a view's buffers as frame number ``frame``; ``folder`` is a prefix of the output folders."""
        camera, buffers = view.camera, view.read(*_BUFFERS)
        depth = buffers["depth_z_m"][..., 0].astype(np.float64)
        points = camera.unproject(camera.pixel_centers(), depth)
        distance = np.linalg.norm(points - camera.position_m, axis=-1)
        has_surface = depth > 0
        normal = buffers["normal_world"].astype(np.float32)
        in_camera = normal @ (camera.world_from_camera[:3, :3] @ _FLIP).astype(np.float32)
        nothing = np.float32(np.nan)
        final = {
            "color": buffers["beauty"],
            "diffuse_reflectance": buffers["diffuse_albedo"],
            "specular_reflectance": buffers["specular_albedo"],
            "roughness": buffers["roughness"][..., 0],
        }
        geometry = {
            "depth_meters": np.where(has_surface, distance, nothing).astype(np.float16),
            "position": np.where(has_surface[..., None], points, nothing).astype(np.float32),
            "normal_world": normal.astype(np.float16),
            "normal_cam": in_camera.astype(np.float16),
            "semantic_instance": _with_minus_one(buffers["instance_id"]),
            "render_entity_id": _with_minus_one(buffers["instance_id"]),
            "material_id": _with_minus_one(buffers["material_id"]),
        }
        for group, content in (("final", final), ("geometry", geometry)):
            for name, array in content.items():
                file = f"{folder}_{group}_hdf5/frame.{frame:04d}.{name}.hdf5"
                self.export.write(file, encode_hdf5(array))
        preview = f"{folder}_final_preview/frame.{frame:04d}.tonemap.png"
        self.export.write_picture(preview, buffers["beauty"], view.record.exposure)

    def finish(self) -> None:
        """Write ``metadata_camera_parameters.csv`` with the intrinsics of each trajectory."""
        fields = ["scene_name", "camera_name", "settings_output_img_width", "settings_output_img_height"]
        fields += [f"M_cam_from_uv_{r}{c}" for r in range(3) for c in range(3)]
        fields += [f"M_proj_{r}{c}" for r in range(4) for c in range(4)]
        lines = [",".join(fields)]
        for scene, label, camera in self.trajectories:
            numbers = [*cam_from_uv(camera).ravel().tolist(), *projection(camera).ravel().tolist()]
            lines.append(",".join(map(str, (scene, label, camera.width_px, camera.height_px, *numbers))))
        self.export.write("metadata_camera_parameters.csv", ("\n".join(lines) + "\n").encode())


def _with_minus_one(ids: NDArray) -> NDArray[np.int32]:
    """Return ids (H, W, 1) as (H, W), with Hypersim's -1 instead of 0 for pixels without an id."""
    values = ids[..., 0].astype(np.int64)
    return np.where(values == 0, -1, values).astype(np.int32)
