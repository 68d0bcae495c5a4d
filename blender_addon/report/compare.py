# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders the report's scenes with Cycles here and with Mitsuba in a separate process, and compares them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Generator, Sequence
from pathlib import Path

import bpy
import numpy as np

from ..assembly import Progress, write_target
from ..bake.execute import BakeSession
from ..cycles import read_linear, render_linear
from ..gather.cameras import gather_camera
from ..problems import Problem, ProblemList
from ..reading import Reader
from ..settings import ExportSettings
from ..targets import Target
from ..write import PackageWriter
from .page import CameraCheck, Comparison, page
from .stage import SAMPLES, light_stage, material_stage

_MATERIAL_LIMIT, _LIGHT_LIMIT = 0.10, 0.05
_MITSUBA_SAMPLES = 4 * SAMPLES  # Mitsuba's samples are independent, Cycles' are stratified
TIMEOUT_S = 3600.0
_RENDER_MODULE = "datagen.inspection.render_package"


def report_steps(
    path: Path,
    title: str,
    settings: ExportSettings,
    materials: dict[str, tuple[str, ...]],
    things: Sequence[str],
    problems: Sequence[Problem],
) -> Generator[Progress, None, None]:
    """Write the fidelity report to ``path``; yields the progress.

    ``materials``: names of the UV maps that each material's nodes read, by the material's name. ``things``:
    names of the exported objects, including lights and cameras.
    """
    scene = bpy.context.scene
    objects = [scene.objects[name] for name in sorted(things) if name in scene.objects]
    lights = [t for t in objects if t.type == "LIGHT" and not t.get("sm_role") and not t.hide_render]
    cameras = [t for t in objects if t.type == "CAMERA" and t.data.type == "PERSP"]
    with tempfile.TemporaryDirectory(prefix="scene_materials_report_") as name:
        folder = Path(name)
        names = list(materials)
        material_images: list[np.ndarray] = []
        yield Progress(0.0, "report: materials in Cycles")
        if materials:
            material_images = yield from _render_materials(folder, settings, materials)
        light_images: list[tuple[str, str, np.ndarray]] = []
        worlds = [scene.world] if scene.world is not None and things else []
        for index, light in enumerate([*lights, *worlds]):
            yield Progress(0.5 + 0.2 * index / (len(lights) + 1), f"report: {light.name} in Cycles")
            with BakeSession() as stage:
                light_stage(stage, light)
                _export_stage(stage, f"light_{index:03d}", settings, folder)
                kind = "world" if isinstance(light, bpy.types.World) else light.data.type.lower()
                light_images.append((light.name, kind, render_linear(stage.scene)))
        yield Progress(0.7, "report: Mitsuba")
        packages = sorted(path.parent for path in folder.glob("packages/*/asset.json"))
        remark = "Nothing to render."
        if packages:
            remark = render_with_mitsuba(folder, packages, settings.report_python)
        page_materials = []
        for index, (material, image) in enumerate(zip(names, material_images, strict=True)):
            mitsuba = _mitsuba_image(folder, "report_materials", index)
            textures = _textures(folder, material)
            page_materials.append(Comparison(material, textures, image, mitsuba, _MATERIAL_LIMIT))
        page_lights = [
            Comparison(name, kind, image, _mitsuba_image(folder, f"light_{index:03d}", 0), _LIGHT_LIMIT)
            for index, (name, kind, image) in enumerate(light_images)
        ]
        checks = [_check_camera(camera, scene) for camera in cameras]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page(title, page_materials, page_lights, checks, problems, remark), encoding="utf-8")


def _export_stage(stage: BakeSession, identity: str, settings: ExportSettings, folder: Path) -> None:
    """Export a session's scene as an environment named ``identity``."""
    problems = ProblemList()
    scene = stage.scene
    layer = scene.view_layers[0]
    layer.update()
    target = Target(
        "environment", identity, identity, scene, frozenset(thing.name for thing in scene.objects)
    )
    with BakeSession() as session:
        reader = Reader(settings, session, problems, scene, lambda: layer.depsgraph)
        contents = reader.prepare(target)
        problems.refuse_errors()
        with PackageWriter(folder / "packages" / identity) as writer:
            for _ in write_target(reader, contents, writer):
                pass


def _render_materials(
    folder: Path, settings: ExportSettings, materials: dict[str, tuple[str, ...]]
) -> Generator[Progress, None, list[np.ndarray]]:
    images = []
    with BakeSession() as stage:
        names = list(materials)
        blocks = [bpy.data.materials[name] for name in names]
        cameras = material_stage(stage, blocks, [materials[name] for name in names])
        _export_stage(stage, "report_materials", settings, folder)
        # the exporter sorts cameras by name, which is the order of creation
        for index, camera in enumerate(cameras):
            yield Progress(0.5 * index / len(cameras), f"report: {names[index]} in Cycles")
            stage.scene.camera = camera
            images.append(render_linear(stage.scene))
    return images


def render_with_mitsuba(folder: Path, packages: Sequence[Path], python: str) -> str:
    """Render the packages with Mitsuba; returns the page's remark: sample counts, or the failure."""
    # by default this interpreter, if bpy is a module installed in it; inside Blender there is no default
    executable = python or ("" if bpy.app.binary_path else sys.executable)
    if not executable:
        return (
            "Rendered by Cycles only: to compare with Mitsuba, name a Python executable that has this "
            "project installed."
        )
    command = [executable, "-m", _RENDER_MODULE, *map(str, packages), "--out", str(folder / "mitsuba")]
    command += ["--samples", str(_MITSUBA_SAMPLES)]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONHOME"}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False, env=environment
        )
    except OSError as error:
        return f"Rendered by Cycles only: {executable} cannot be run ({error})."
    except subprocess.TimeoutExpired:
        return f"Rendered by Cycles only: {executable} took longer than {TIMEOUT_S / 60:g} minutes."
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return f"Rendered by Cycles only: {executable} failed with {last}"
    return (
        f"Cycles {bpy.app.version_string} with {SAMPLES} samples per pixel against Mitsuba with "
        f"{_MITSUBA_SAMPLES}, not denoised."
    )


def _mitsuba_image(folder: Path, package: str, index: int) -> np.ndarray | None:
    path = folder / "mitsuba" / package / f"view_{index:03d}.exr"
    return read_linear(path) if path.is_file() else None


def _textures(folder: Path, material: str) -> str:
    """Describe for each channel of an exported material whether it is a constant or a texture."""
    description = folder / "packages" / "report_materials" / "asset.json"
    entries = json.loads(description.read_text(encoding="utf-8"))["materials"]
    names = [name for name in entries if name == material or name.startswith(f"{material} on ")]
    if not names:
        return ""
    found = []
    for channel in ("diffuse_albedo", "specular_albedo", "roughness", "opacity", "normal"):
        value = entries[names[0]].get(channel)
        if value is not None:
            found.append(f"{channel}: {'texture' if isinstance(value, dict) else 'constant'}")
    return ", ".join(found)


def _check_camera(thing: bpy.types.Object, scene: bpy.types.Scene) -> CameraCheck:
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    data = gather_camera(thing, scene.render, 1.0, ProblemList())
    assert data is not None
    generator = np.random.default_rng(0)
    pose = data.asset_from_camera
    local = np.concatenate([generator.uniform(-0.4, 0.4, (64, 2)), generator.uniform(1, 5, (64, 1))], axis=1)
    local[:, :2] *= local[:, 2:]
    exported = [data.fx_px, data.fy_px] * local[:, :2] / local[:, 2:] + [data.cx_px, data.cy_px]
    world = local @ pose[:3, :3].T + pose[:3, 3]
    seen = [world_to_camera_view(scene, thing, Vector(point)) for point in world]
    blender = np.array([(p.x * data.width_px, (1 - p.y) * data.height_px) for p in seen])
    return CameraCheck(thing.name, float(np.abs(exported - blender).max()))
