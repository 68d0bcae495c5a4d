# SPDX-License-Identifier: MIT
"""Results of `materials infer` in other programs: Cycles through the add-on, GLB through Blender's importer,
Khronos' validator."""

from __future__ import annotations

import importlib.util
import io
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from datagen.formats.lights import PointLight
from datagen.foundation.color import linear_from_srgb
from datagen.foundation.images import read_image
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.predict.sources import TRUTH
from model.reconstruction.render.relight import RelightOptions, render_asset
from oracles.textured_room import room_capture
from tests.conftest import REPOSITORY

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
needs_bpy = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None, reason="needs bpy: pip install '.[blender]' on Python 3.11"
)
VIEW, SAMPLES = "view_03", 128
HAS_USD = importlib.util.find_spec("pxr") is not None
VALIDATOR = REPOSITORY / ".ci" / "gltf"


@pytest.fixture(scope="module")
def asset(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> Path:
    """The textured room with coloured F0 from 0.05 to 0.3 and a lamp, merged from its true maps."""
    out = tmp_path_factory.mktemp("asset") / "out"
    lamp = PointLight(name="lamp", position_m=(2.1, 1.4, 2.2), intensity=(5.0, 5.0, 4.0))
    capture = replace(room_capture(8, (96, 64), has_equal_views=True), lights=(lamp,))
    infer(capture, out, TRUTH, InferOptions(atlas=256, has_usd=HAS_USD))
    return out


@pytest.fixture(scope="module")
def mitsuba_image(asset: Path) -> NDArray[np.float32]:
    options = RelightOptions(views=(VIEW,), samples=SAMPLES, max_depth=8, denoise=False)
    return next(iter(render_asset(asset / "asset", options))).color


@pytest.fixture(scope="module")
def cycles(asset: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], NDArray[np.float32]]:
    """Function that renders a source with tests/model/cycles_of_asset.py in a separate process."""

    def render(source: str) -> NDArray[np.float32]:
        out = tmp_path_factory.mktemp("cycles")
        command = [sys.executable, "-m", "tests.model.cycles_of_asset", source, str(out), str(SAMPLES), VIEW]
        done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
        assert json.loads(done.stdout.splitlines()[-1]) == {"remarks": []}
        return np.load(out / f"{VIEW}.npy")

    return render


def blurred_ratio(a: NDArray, b: NDArray) -> NDArray:
    """Ratio a / b of images averaged over about 50 pixels."""
    x, y = (cv2.GaussianBlur(image, (0, 0), 2.0) for image in (a, b))
    return x / y


@pytest.mark.bpy
@needs_bpy
def test_blender_renders_the_package_like_mitsuba(
    asset: Path, mitsuba_image: NDArray[np.float32], cycles: Callable[[str], NDArray[np.float32]]
) -> None:
    """Measured: means of two views agree within 0.1 % at 256 samples (noise at 128: 0.3 %), blurred pixels
    within 8 %, which is noise, at the 1st and 99th percentile. The mean reveals an albedo error of 1 %."""
    image = cycles(str(asset / "asset"))
    assert image.shape == mitsuba_image.shape
    np.testing.assert_allclose(image.mean(axis=(0, 1)) / mitsuba_image.mean(axis=(0, 1)), 1, atol=0.01)
    ratio = blurred_ratio(image, mitsuba_image)
    low, high = np.percentile(ratio, [1, 99])
    assert low > 0.88 and high < 1.12, (low, high)
    assert abs(float(np.median(ratio)) - 1) < 0.01


@pytest.mark.bpy
@needs_bpy
def test_blender_opens_the_glb(
    asset: Path, mitsuba_image: NDArray[np.float32], cycles: Callable[[str], NDArray[np.float32]]
) -> None:
    """Blender's Principled BSDF reduces the diffuse part by the specular reflection, also at grazing angles:
    a closed room is 15 % darker for F0 up to 0.3. Geometry, colours and textures must equal the package's."""
    image = cycles(f"{asset / 'asset'}+{asset / 'room.glb'}")
    ratio = image.mean(axis=(0, 1)) / mitsuba_image.mean(axis=(0, 1))
    assert (ratio > 0.78).all() and (ratio < 0.98).all(), ratio
    x, y = (cv2.GaussianBlur(i, (0, 0), 2.0).ravel() for i in (image, mitsuba_image))
    assert np.corrcoef(x, y)[0, 1] > 0.98
    turned = cv2.GaussianBlur(np.ascontiguousarray(image[:, ::-1]), (0, 0), 2.0).ravel()
    assert np.corrcoef(turned, y)[0, 1] < 0.8  # injected fault: a mirrored image fails


@pytest.mark.bpy
@needs_bpy
@pytest.mark.skipif(not HAS_USD, reason="needs usd-core")
def test_blender_opens_the_usdz(
    asset: Path, mitsuba_image: NDArray[np.float32], cycles: Callable[[str], NDArray[np.float32]]
) -> None:
    """Like the test of the GLB; a USDZ has one refractive index for all dielectrics."""
    image = cycles(f"{asset / 'asset'}+{asset / 'room.usdz'}")
    ratio = image.mean(axis=(0, 1)) / mitsuba_image.mean(axis=(0, 1))
    assert (ratio > 0.78).all() and (ratio < 1.02).all(), ratio
    x, y = (cv2.GaussianBlur(i, (0, 0), 2.0).ravel() for i in (image, mitsuba_image))
    assert np.corrcoef(x, y)[0, 1] > 0.98


def test_the_glb_contains_the_written_maps(asset: Path) -> None:
    """D, S and R of the GLB by glTF 2.0 and KHR_materials_specular equal the EXR files where F0 is
    dielectric; the packed texture has an occlusion of 1, as engines expect."""
    data = (asset / "room.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    material = next(m for m in document["materials"] if m["name"] == "surface")
    pbr, specular = material["pbrMetallicRoughness"], material["extensions"]["KHR_materials_specular"]

    def stored(texture: dict[str, int]) -> NDArray[np.float64]:
        source = document["textures"][texture["index"]]["source"]
        view = document["bufferViews"][document["images"][source]["bufferView"]]
        first = 28 + length + view["byteOffset"]
        return np.asarray(Image.open(io.BytesIO(data[first : first + view["byteLength"]]))) / 255.0

    base = linear_from_srgb(stored(pbr["baseColorTexture"]))
    orm = stored(pbr["metallicRoughnessTexture"])
    metallic, color = orm[..., 2:], linear_from_srgb(stored(specular["specularColorTexture"]))
    f0 = np.minimum(0.04 * np.array(specular["specularColorFactor"]) * color, 1) * specular.get(
        "specularFactor", 1
    )
    got = {
        "diffuse_albedo": base * (1 - metallic),
        "specular_albedo": f0 * (1 - metallic) + base * metallic,
        "roughness": orm[..., 1:2],
    }
    assert material["occlusionTexture"] == pbr["metallicRoughnessTexture"] and (orm[..., 0] == 1).all()
    specular_map = read_image(asset / "atlas" / "specular_albedo.exr")
    is_surface = np.asarray(Image.open(asset / "atlas" / "mask.png")) > 0
    is_surface &= specular_map.max(axis=-1) <= 0.16
    assert is_surface.mean() > 0.1
    for name, values in got.items():
        difference = np.abs(values - read_image(asset / "atlas" / f"{name}.exr"))[is_surface]
        assert difference.mean() < 0.003 and np.percentile(difference, 99) < 0.02, name
    without = {**got, "specular_albedo": 0.04 * (1 - metallic) + base * metallic}["specular_albedo"]
    assert np.abs(without - specular_map)[is_surface].mean() > 0.01  # injected fault: without the extension


def test_khronos_validator_finds_nothing(asset: Path) -> None:
    """No errors, warnings or hints from gltf-validator, which `make setup-dev` installs from npm."""
    if shutil.which("node") is None or not (VALIDATOR / "node_modules").is_dir():
        pytest.skip("needs node and npm packages: cd .ci/gltf && npm ci")
    for glb, has_errors in ((asset / "room.glb", False), (asset / "broken.glb", True)):
        if has_errors:  # injected fault: an index out of range is found
            data = (asset / "room.glb").read_bytes()
            glb.write_bytes(data.replace(b'"material":0', b'"material":7'))
        done = subprocess.run(
            ["node", "validate.mjs", str(glb)], cwd=VALIDATOR, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        issues = json.loads(done.stdout)["issues"]
        assert bool(issues["numErrors"]) == has_errors, issues
        if not has_errors:
            assert issues["numWarnings"] == 0, issues
