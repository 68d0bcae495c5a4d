# SPDX-License-Identifier: MIT
"""Small stand-ins for files that the documentation names: recipes, library, dataset, photographs, checkpoint.

Each is made once per session by the project's code and copied where needed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tests.conftest import REPOSITORY
from tests.docs.pages import read_page

SIZE_PX = (64, 48)
LIBRARY = ".library"
PACKAGES = ("datagen", "mitsuba_plugins", "model", "blender_addon")


def write_recipes(folder: Path) -> None:
    """Write the project's recipes, reduced to two configurations of three small views of a small library."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted((REPOSITORY / "scenes" / "recipes").glob("*.yaml")):
        recipe: dict[str, Any] = yaml.safe_load(path.read_text())
        recipe.update(configurations=2, views=3, resolution=list(SIZE_PX), objects={"count": [2, 3]})
        recipe.setdefault("library", [LIBRARY])
        for key in ("environments", "lights"):  # generated rooms and panoramas: absent from the small library
            recipe.pop(key, None)
        recipe["cameras"] = {"min_content": 2}
        recipe["render"] = {"path_samples": 2, "auxiliary_samples": 4}
        if "splits" in recipe:
            recipe["splits"] = {"train": 0.5, "validation": 0.5}
        (folder / path.name).write_text(yaml.safe_dump(recipe))


def _library(out: Path) -> None:
    from tests.datagen.small_library import write_small_library

    write_small_library(out, num_rooms=2)


def _rooms(out: Path, has_light: bool = False) -> None:
    """A rendered dataset of two configurations in different splits."""
    desk = out.parent / f"desk-{out.name}"
    write_recipes(desk / "scenes" / "recipes")
    _library(desk / LIBRARY)
    recipe = desk / "scenes" / "recipes" / "paper.yaml"
    if has_light:
        fields = yaml.safe_load(recipe.read_text()) | {"statistics": {"light": True}}
        recipe.write_text(yaml.safe_dump(fields))
    command = [sys.executable, "-m", "datagen", "run", str(recipe), "--out", str(out), "--workers", "1"]
    subprocess.run(command, cwd=desk, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, check=True)


def _staircase(out: Path) -> None:
    """A Mitsuba scene of a few shapes with its licence file."""
    out.mkdir()
    (out / "LICENSE.txt").write_text("https://creativecommons.org/publicdomain/zero/1.0/\n")
    wall = '<shape type="rectangle"><transform name="to_world">{}</transform><ref id="Walls"/></shape>'
    turns = [
        '<scale value="2"/><rotate x="1" angle="-90"/>',
        '<scale value="2"/><translate z="-2" y="2"/>',
        '<scale value="2"/><rotate y="1" angle="90"/><translate x="-2" y="2"/>',
        '<scale value="2"/><rotate y="1" angle="-90"/><translate x="2" y="2"/>',
        '<scale value="2"/><rotate x="1" angle="90"/><translate y="4"/>',
    ]
    (out / "scene.xml").write_text(
        '<scene version="3.0.0"><integrator type="path"/>'
        '<sensor type="perspective"><float name="fov" value="60"/><transform name="to_world">'
        '<lookat origin="0, 1.5, 1.9" target="0, 1.2, 0" up="0, 1, 0"/></transform>'
        '<film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="48"/></film>'
        '</sensor><bsdf type="diffuse" id="Walls"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf>'
        '<bsdf type="dielectric" id="Glass"/>'
        + "".join(wall.format(turn) for turn in turns)
        + '<shape type="cube"><transform name="to_world"><scale value="0.3"/><translate y="0.3"/></transform>'
        '<ref id="Glass"/></shape>'
        '<shape type="rectangle"><transform name="to_world"><scale value="0.5"/><rotate x="1" angle="90"/>'
        '<translate y="3.9"/></transform><emitter type="area"><rgb name="radiance" value="8"/></emitter>'
        "</shape></scene>"
    )


def _sofa(out: Path) -> None:
    import trimesh

    out.write_bytes(trimesh.creation.box(extents=(1.6, 0.7, 0.8)).export(file_type="glb"))


def _photographs(out: Path) -> None:
    """The rendered room in COLMAP's format: images, cameras and a mesh."""
    from PIL import Image

    from datagen.foundation.color import exposure_for, srgb_from_linear
    from datagen.foundation.meshes.ply import encode_ply
    from model.reconstruction.captures.read import read_capture
    from tests.model.test_reconstruction_captures import quaternion_of

    rooms = out.parents[1] / "rooms" / "rooms"
    if not rooms.exists():  # the stand-in `rooms`, if not yet made
        rooms.parent.mkdir()
        _rooms(rooms)
    capture = read_capture(sorted((rooms / "shards").glob("*.tar"))[0])
    cameras, images = [], []
    (out / "images").mkdir(parents=True)
    (out / "sparse" / "0").mkdir(parents=True)
    for number, view in enumerate(capture.views, start=1):
        camera, color = view.camera, view.read().color
        lens = f"{camera.fx_px} {camera.fy_px} {camera.cx_px} {camera.cy_px}"
        cameras.append(f"{number} PINHOLE {camera.width_px} {camera.height_px} {lens}")
        pose = camera.camera_from_world
        numbers = [number, *quaternion_of(pose[:3, :3]), *pose[:3, 3], number]
        images.append(" ".join(map(str, numbers)) + f" {view.name}.png\n")
        shown = np.clip(srgb_from_linear(color * exposure_for(color)), 0, 1)
        Image.fromarray((255 * shown + 0.5).astype(np.uint8)).save(out / "images" / f"{view.name}.png")
    (out / "sparse" / "0" / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (out / "sparse" / "0" / "images.txt").write_text("\n".join(images) + "\n")
    (out / "room.ply").write_bytes(encode_ply(capture.geometry.mesh))


def _checkpoint(out: Path) -> None:
    """A checkpoint of a tiny network with random weights."""
    from model.checkpoint import CheckpointCard, save_checkpoint
    from model.confidence import ConfidenceNets
    from model.networks import MaterialNetwork, NetworkConfig

    out.mkdir()
    network = NetworkConfig(base_channels=4, global_channels=4)
    card = CheckpointCard(network=network, loss="none", phase="untrained", step=0)
    save_checkpoint(out / "final.safetensors", card, MaterialNetwork(network), ConfidenceNets())


def _room_blend(out: Path) -> None:
    """The Blender scene that docs/tutorials/blender-scene.md makes."""
    blocks = read_page(REPOSITORY / "docs" / "tutorials" / "blender-scene.md").blocks
    script = next(block.text for block in blocks if block.note == "file make_room.py")
    # Blender takes relative paths from PWD.
    environment = {**os.environ, "PWD": str(out.parent)}
    command = [sys.executable, "-"]
    subprocess.run(command, input=script, text=True, cwd=out.parent, env=environment, check=True)


def _oak(out: Path) -> None:
    """Texture maps of wood."""
    from PIL import Image

    out.mkdir()
    noise = np.random.default_rng(1).integers(90, 160, (32, 32, 3)).astype(np.uint8)
    Image.fromarray(noise).save(out / "oak_color.jpg")
    Image.fromarray(noise[..., 0]).save(out / "oak_roughness.png")


def _source(out: Path) -> None:
    """A copy of the project's packages, to which pages apply patches."""
    for name in PACKAGES:
        shutil.copytree(REPOSITORY / name, out / name, ignore=shutil.ignore_patterns("__pycache__"))


def _cork(out: Path) -> None:
    """A texture folder with the file names of ambientCG."""
    from PIL import Image

    out.mkdir()
    noise = np.random.default_rng(2).integers(90, 160, (32, 32, 3)).astype(np.uint8)
    Image.fromarray(noise).save(out / "Cork001_1K_Color.png")
    Image.fromarray(noise[..., 0]).save(out / "Cork001_1K_Roughness.png")


STAND_INS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "my-library": ("my-library", _library),
    "rooms": ("rooms", _rooms),
    "lit-rooms": ("lit-rooms", partial(_rooms, has_light=True)),
    "staircase": ("staircase", _staircase),
    "sofa": ("sofa.glb", _sofa),
    "photographs": ("kitchen", _photographs),
    "checkpoint": ("run", _checkpoint),
    "room.blend": ("room.blend", _room_blend),
    "oak": ("", _oak),
    "cork": ("Cork001", _cork),
    "source": ("", _source),
}
"""Path in the working folder and maker of each stand-in, by its name in the pages' notes."""


class StandIns:
    """Makes each stand-in once below ``root`` and copies it."""

    def __init__(self, root: Path):
        self.root = root

    def begin(self, folder: Path) -> None:
        """Create the stand-ins that every page needs: recipes with their library, and the bundled library."""
        write_recipes(folder / "scenes" / "recipes")
        (folder / "scenes" / "library").symlink_to(REPOSITORY / "scenes" / "library")
        self._copy(LIBRARY, folder / LIBRARY, _library)

    def bring(self, name: str, folder: Path) -> None:
        """Copy a stand-in to its path below ``folder`` if that does not exist."""
        place, make = STAND_INS[name]
        if not place or not (folder / place).exists():
            self._copy(place or name, folder / place, make)

    def _copy(self, name: str, target: Path, make: Callable[[Path], None]) -> None:
        made = self.root / name / name
        if not made.exists():
            made.parent.mkdir(exist_ok=True)
            make(made)
        if made.is_dir():
            shutil.copytree(made, target, dirs_exist_ok=True)
        else:
            shutil.copy(made, target)
