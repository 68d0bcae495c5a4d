# SPDX-License-Identifier: MIT
"""The whole pipeline without ground-truth input: photographs by Cycles, cameras by COLMAP, `materials infer`.

    python -m benchmarks.studies.colmap_end_to_end --out DIR     as in docs/measurements.md: 20 minutes
    python -m benchmarks.studies.colmap_end_to_end --out DIR --cameras true    true cameras, no COLMAP
    python -m benchmarks.studies.colmap_end_to_end --out DIR --faults phone --mesh colmap    no ground truth

1. The scene is the bundled room ``study``, which is not in the training data of the bundled checkpoint,
   with objects, ceiling light and daylight; the cameras circle around its centre and look across it.
2. Cycles (cycles_photographs.py) renders the views with depth of field; :func:`developed` adds shot and
   read noise and makes 8-bit JPEGs: exposure, the sRGB curve ("Standard"), clipping, no tone mapping.
   ``--faults`` develops with a preset of model/evaluation/camera_faults.py instead.
3. ``colmap`` finds the cameras; ``model_aligner`` moves them into the room's frame by measured camera centres
   (at least three): here all true centres, with noise of 5 mm standard deviation per axis.
4. The mesh is the room welded and collapsed to ``--triangles``, without UVs, or the surface through COLMAP's
   points, as in `materials photos`.
5. ``materials infer`` runs, including its check.
6. Atlas and truth are rendered as maps from every third true camera and compared where both show the same
   surface (depth within 5 %). Baselines are each map's mean, which is the best possible constant, and the
   photographs as diffuse albedo.

Plan, renderings, meshes and captures are stored in a folder of --out, and reused for the same options and
versions.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.studies.cycles_scene import export
from benchmarks.timing import launch, write_report
from datagen.formats.base import canonical_json, read_json, sha256_hex
from datagen.formats.configuration import Configuration, ViewCamera, configuration_of
from datagen.formats.package import open_package
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.budget import Budget
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.bundled import bundled_library
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import exposure_for, linear_from_srgb, srgb_from_linear
from datagen.foundation.images import read_image
from datagen.foundation.meshes.ply import encode_ply
from datagen.foundation.versions import pixel_versions
from datagen.library import Library
from datagen.rendering.renderer import SceneRenderer
from model.evaluation.camera_faults import PRESETS, photographed
from model.reconstruction.captures.colmap import read_sights
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from model.reconstruction.photos.colmap_run import MAX_POINT_ERROR_PX, camera_steps
from model.reconstruction.photos.sparse_mesh import sparse_surface

FOV_X_DEG = 72.0
FULL_WELL, READ_NOISE = 12000.0, 8.0  # electrons: a small sensor at base ISO
JPEG_QUALITY = 92
CENTER_ERROR_M = 0.005
COMPARED_EVERY = 3  # views
RECIPE = {
    "name": "study",
    "seed": 3,
    "configurations": 1,
    "views": 2,
    "environments": {"include": ["study"]},
    "objects": {"count": [14, 14]},
    "materials": {"replace_probability": 0.0, "vary_probability": 0.0},
    "lights": {"area_probability": 1.0, "daylight_probability": 1.0, "color_temperature_k": [4500, 6000]},
}


def walk(num: int, size: tuple[int, int]) -> list[ViewCamera]:
    """``num`` cameras around the room's centre, at two alternating heights, directed across the room."""
    width, height = size
    focal = 0.5 * width / float(np.tan(np.radians(FOV_X_DEG) / 2))
    made = []
    for k in range(num):
        angle = 2 * np.pi * k / num
        outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array([-0.15, -0.27, 1.3 if k % 2 else 1.75]) + outwards * [0.85, 0.85, 0]
        target = np.array([-0.15, -0.27, 0.85 if k % 2 else 1.0]) - 1.0 * outwards
        camera = Camera(width, height, focal, focal, width / 2, height / 2, look_at(eye, target))
        made.append(ViewCamera.from_camera(f"view-{k:03d}", camera))
    return made


def developed(linear: NDArray[np.float32], exposure: float, seed: int) -> NDArray[np.uint8]:
    """Develop radiance (H, W, 3) to 8-bit sRGB, with noise and clipping, without tone mapping."""
    rng = np.random.default_rng(seed)
    electrons = np.clip(linear * exposure, 0, None) * FULL_WELL
    electrons = rng.poisson(np.minimum(electrons, 1e7)) + rng.normal(0, READ_NOISE, linear.shape)
    shown = srgb_from_linear(np.clip(electrons / FULL_WELL, 0, 1))
    return (shown * 255 + 0.5).astype(np.uint8)


def jpeg(pixels: NDArray[np.uint8], camera: Camera) -> bytes:
    """Encode ``pixels`` (H, W, 3) as JPEG, with the camera's focal length in EXIF."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Cycles", "Cycles"
    details = exif.get_ifd(0x8769)
    details[0xA405] = round(36.0 * camera.fx_px / camera.width_px)
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif)
    return data.getvalue()


@dataclass
class EndToEnd:
    """The steps of the pipeline for the command's options, in order; each stores its result below ``out``."""

    out: Path
    views: int
    size: tuple[int, int]
    samples: int
    triangles: int
    cameras: str
    atlas: str
    faults: str | None = None
    mesh: str = "retopology"

    def __post_init__(self) -> None:
        key = {"cameras": [self.views, *self.size], "samples": self.samples, "triangles": self.triangles}
        self.out /= sha256_hex(canonical_json({**key, "versions": pixel_versions()}))[:12]
        self.out.mkdir(parents=True, exist_ok=True)
        taken = "" if self.faults is None else f"-{self.faults}"
        meshed = "" if self.mesh == "retopology" else f"-{self.mesh}"
        self.images = self.out / f"images{taken}"
        self.capture = self.out / f"capture-{self.cameras}{taken}"
        self.name = f"{self.cameras}{taken}{meshed}"
        self.result = self.out / f"result-{self.name}"

    # ---------------------------------------------------------------- the room and its photographs

    def configuration(self) -> Configuration:
        """Plan the room with the cameras of :func:`walk`."""
        path = self.out / "configuration.json"
        if not path.is_file():
            recipe = self.out / "recipe.yaml"
            recipe.write_bytes(canonical_json({"format": "scene-materials/recipe", "version": 1, **RECIPE}))
            shutil.rmtree(self.out / "plan", ignore_errors=True)
            launch("datagen", "plan", str(recipe), "--out", str(self.out / "plan"), log=self.out / "plan.log")
            (planned,) = (self.out / "plan" / "configurations").glob("*.json")
            cameras = tuple(walk(self.views, self.size))
            made = read_json(Configuration, planned).model_copy(update={"cameras": cameras})
            path.write_bytes(canonical_json(made))
        return read_json(Configuration, path)

    def photograph(self) -> None:
        """Export the room, render it with Cycles, develop the photographs, and make the coarse mesh."""
        configuration = self.configuration()
        blend, log = self.out / "room.blend", self.out / "cycles.log"
        if not blend.is_file():
            shutil.rmtree(self.out / "export", ignore_errors=True)
            export(configuration, Library([bundled_library()]), self.out / "export")
            launch(
                "benchmarks.studies.cycles_baseline", "build", str(self.out / "export"), str(blend), log=log
            )
        mesh, study = self.out / "retopology.ply", "benchmarks.studies.cycles_photographs"
        if not mesh.is_file():
            options = ("--triangles", str(self.triangles))
            launch(study, "retopology", str(blend), str(mesh), *options, log=log)
        rendered, images = self.out / "cycles", self.images
        options = ("--samples", str(self.samples))
        launch(study, "render", str(blend), str(rendered), *options, log=log)
        images.mkdir(exist_ok=True)
        linear = {
            view.name: read_image(rendered / f"{view.name}.exr")[..., :3].astype(np.float32)
            for view in configuration.cameras
        }
        exposure = exposure_for(np.stack(list(linear.values())))  # one for all views, as set by hand
        for number, view in enumerate(configuration.cameras):
            pixels = self._developed(linear[view.name], exposure, number, view)
            (images / f"{view.name}.jpg").write_bytes(jpeg(pixels, view.camera()))

    def _developed(
        self, linear: NDArray[np.float32], exposure: float, number: int, view: ViewCamera
    ) -> NDArray[np.uint8]:
        if self.faults is None:
            return developed(linear, exposure, number)
        read = photographed(
            linear.astype(np.float64) * exposure, view.camera(), PRESETS[self.faults], view.name
        )
        return (srgb_from_linear(read) * 255 + 0.5).astype(np.uint8)

    # ---------------------------------------------------------------- cameras

    def calibrate(self) -> None:
        """Write a capture of the photographs, with COLMAP's cameras in the room's frame or the true ones."""
        if self.capture.is_dir():
            return
        partial = self.capture.with_name(f"{self.capture.name}-partial")
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(self.images, partial / "images")
        if self.cameras == "true":
            self._write_true_cameras(partial)
        else:
            self._run_colmap(partial)
        partial.rename(self.capture)

    def _write_true_cameras(self, folder: Path) -> None:
        frames = []
        for view in self.configuration().cameras:
            matrix = np.array(view.world_from_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
            frames.append(
                {"file_path": f"images/{view.name}.jpg", "w": view.width_px, "h": view.height_px,
                 "fl_x": view.fx_px, "fl_y": view.fy_px, "cx": view.cx_px, "cy": view.cy_px,
                 "transform_matrix": matrix.tolist()}
            )  # fmt: skip
        (folder / "transforms.json").write_text(json.dumps({"frames": frames}))

    def _run_colmap(self, folder: Path) -> None:
        """Run COLMAP: features and matches on the CPU, incremental mapping, alignment by camera centres."""
        log, found, aligned = self.out / "colmap.log", folder / "found", folder / "sparse"
        found.mkdir()
        aligned.mkdir()
        for step in camera_steps("colmap", folder / "images", folder, lists=()):
            for command in step.commands:
                launch(*command, log=log, is_module=False)
        models = sorted(found.iterdir(), key=lambda m: (m / "images.bin").stat().st_size)
        if not models:
            raise RuntimeError(f"COLMAP found no model; see {log}")
        rng = np.random.default_rng(5)
        lines = []
        for view in self.configuration().cameras:
            x, y, z = view.camera().position_m + rng.normal(0, CENTER_ERROR_M, 3)
            lines.append(f"{view.name}.jpg {x} {y} {z}\n")
        references = folder / "measured_centers.txt"
        references.write_text("".join(lines))
        launch("colmap", "model_aligner", "--input_path", str(models[-1]), "--output_path", str(aligned),
               "--ref_images_path", str(references), "--ref_is_gps", "0", "--alignment_type", "custom",
               "--robust_alignment", "1", "--robust_alignment_max_error", str(6 * CENTER_ERROR_M),
               log=log, is_module=False)  # fmt: skip
        (folder / "database.db").unlink()

    # ---------------------------------------------------------------- inference and comparison

    def infer(self) -> None:
        """Run ``materials infer`` on the capture."""
        mesh, log = self.out / f"{self.mesh}.ply", self.out / f"infer-{self.name}.log"
        if self.mesh == "colmap":
            model = self.capture / "sparse"
            surface = sparse_surface(read_sights(model, Budget(model), MAX_POINT_ERROR_PX))
            mesh = self.capture / "sparse.ply"
            mesh.write_bytes(encode_ply(surface))
        options = ["--mesh", str(mesh), "--out", str(self.result), "--atlas", self.atlas, "--quiet"]
        if self.mesh == "colmap":
            options.append("--no-mend-mesh")  # as materials photos does with a sparse surface
        launch("model.cli", "infer", str(self.capture), *options, log=log)

    def pose_errors(self) -> dict[str, float]:
        """Number of registered cameras; errors of centre [mm], rotation [degrees] and focal length [%]."""
        capture = read_capture(self.capture, CaptureOptions(mesh=self.out / "retopology.ply"))
        truth = {view.name: view.camera() for view in self.configuration().cameras}
        millimetres, degrees, focal = [], [], []
        for view in capture.views:
            true = truth[view.name.removeprefix("images-")]
            relative = view.camera.world_from_camera[:3, :3].T @ true.world_from_camera[:3, :3]
            degrees.append(np.degrees(np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1))))
            millimetres.append(1000 * np.linalg.norm(view.camera.position_m - true.position_m))
            focal.append(view.camera.fx_px / true.fx_px * true.width_px / view.camera.width_px - 1)
        return {
            "registered": len(capture.views),
            "center_mm_median": float(np.median(millimetres)),
            "center_mm_max": float(np.max(millimetres)),
            "turn_deg_median": float(np.median(degrees)),
            "turn_deg_max": float(np.max(degrees)),
            "focal_percent": float(100 * np.mean(focal)),
        }

    def compare(self) -> dict[str, Any]:
        """Errors of the atlas in the true views, where depths agree within 5 %, and of the baselines."""
        configuration = self.configuration()
        cameras = configuration.cameras[::COMPARED_EVERY]
        configuration = configuration.model_copy(update={"cameras": cameras})
        sums: dict[str, list[float]] = {name: [] for name in MATERIAL_MAPS}
        constants: dict[str, list[NDArray]] = {name: [] for name in MATERIAL_MAPS}
        shares, taken = [], []
        found = self._asset_maps(configuration)
        true = rendered_maps(configuration, Library([bundled_library()]))
        for view, ours, truth in zip(configuration.cameras, found, true, strict=True):
            mask = (ours["depth_z_m"][..., 0] > 0) & (truth["depth_z_m"][..., 0] > 0)
            mask &= np.abs(ours["depth_z_m"] / np.maximum(truth["depth_z_m"], 1e-6) - 1)[..., 0] < 0.05
            shares.append(float(mask.mean()))
            for name in MATERIAL_MAPS:
                sums[name].append(float(((ours[name] - truth[name])[mask] ** 2).mean()))
                constants[name].append(truth[name][mask])
            photograph = linear_from_srgb(read_image(self.images / f"{view.name}.jpg") / 255.0)
            taken.append(float(((photograph - truth["diffuse_albedo"])[mask] ** 2).mean()))
            if view.name in _SHOWN:
                self._picture(view.name, ours, truth)
        table = {}
        for name in MATERIAL_MAPS:
            values = np.concatenate(constants[name])
            table[name] = {
                "mse": float(np.mean(sums[name])),
                "constant_mse": float(((values - values.mean(axis=0)) ** 2).mean()),
            }
        table["diffuse_albedo"]["photograph_mse"] = float(np.mean(taken))
        return {"maps": table, "compared_share": float(np.mean(shares))}

    def _asset_maps(self, configuration: Configuration) -> list[dict[str, NDArray]]:
        path = self.result / "asset"
        with open_package(path) as package:
            made = configuration_of(package)
        return rendered_maps(made.model_copy(update={"cameras": configuration.cameras}), Library([path]))

    def _picture(self, name: str, ours: dict[str, NDArray], truth: dict[str, NDArray]) -> None:
        """Write a picture: the photograph and true maps above the result's normals and maps."""
        photograph = np.asarray(Image.open(self.images / f"{name}.jpg"))
        rows = []
        for maps in (truth, ours):
            shown = [
                srgb_from_linear(np.clip(maps["diffuse_albedo"], 0, 1)),
                srgb_from_linear(np.clip(maps["specular_albedo"], 0, 1)),
                np.repeat(np.clip(maps["roughness"], 0, 1), 3, axis=-1),
            ]
            normal = (0.5 + 0.5 * maps["normal_world"].astype(np.float32)) * 255
            first = photograph if maps is truth else normal.clip(0, 255).astype(np.uint8)
            rows.append(np.concatenate([first, *((s * 255 + 0.5).astype(np.uint8) for s in shown)], axis=1))
        folder = self.out / f"pictures-{self.name}"
        folder.mkdir(exist_ok=True)
        Image.fromarray(np.concatenate(rows)).save(folder / f"{name}.png")


_SHOWN = ("view-000", "view-009", "view-018", "view-027")


def rendered_maps(configuration: Configuration, library: Any) -> list[dict[str, NDArray]]:
    """Render D, S, R, depth and normal of each view, (H, W, C) float32 by name."""
    recipe = RenderRecipe(path_samples=1, auxiliary_samples=16, denoise=False)
    renderer = SceneRenderer(configuration, library, recipe)
    names = (*MATERIAL_MAPS, "depth_z_m", "normal_world")
    found = [
        {name: view.buffers[name].astype(np.float32) for name in names}
        for view in renderer.render_views(range(len(configuration.cameras)))
    ]
    renderer.close()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--views", type=int, default=30)
    parser.add_argument("--size", type=int, nargs=2, default=(576, 384))
    parser.add_argument("--samples", type=int, default=14, help="paths per pixel of Cycles")
    parser.add_argument("--triangles", type=int, default=20000)
    parser.add_argument("--cameras", choices=("colmap", "true"), default="colmap")
    parser.add_argument("--atlas", default="2048")
    parser.add_argument("--faults", choices=tuple(PRESETS))
    parser.add_argument("--mesh", choices=("retopology", "colmap"), default="retopology")
    chosen = parser.parse_args()
    steps = EndToEnd(chosen.out.resolve(), chosen.views, tuple(chosen.size), chosen.samples, chosen.triangles,
                     chosen.cameras, chosen.atlas, chosen.faults, chosen.mesh)  # fmt: skip
    steps.photograph()
    steps.calibrate()
    found: dict[str, Any] = {"poses": steps.pose_errors()}
    print(json.dumps(found), flush=True)
    steps.infer()
    found.update(steps.compare())
    write_report(found, steps.out / f"found-{steps.name}.json")


if __name__ == "__main__":
    main()
