# SPDX-License-Identifier: MIT
"""The lights that `materials infer` finds, and their export: report, Mitsuba scene, package, GLB."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from datagen.formats.asset import EnvironmentAsset
from datagen.formats.lights import AreaLight
from datagen.formats.package import open_package
from datagen.foundation.images import read_image
from datagen.geometry.traced import TracedGeometry
from model.checkpoint import CheckpointCard, save_checkpoint
from model.networks import MaterialNetwork, NetworkConfig
from model.reconstruction.atlas.atlas import empty_atlas
from model.reconstruction.export import balance
from model.reconstruction.export.atlas_images import write_atlas_images
from model.reconstruction.export.slots import Reconstruction
from model.reconstruction.found_lights import Color, FoundLamp, FoundLights, RadianceSamples
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.light.found import found_lights, radiance_samples
from model.reconstruction.predict.sources import CheckpointMaps
from oracles.textured_room import room_capture as small_capture
from tests.model.light_room import LAMP, SKY, photographed_room, room_capture, sunlit_room
from tests.model.test_light_room import sunlit

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
CLAIMED = (1.0, 2.0, 3.0)
"""Wrong radiance of the lamp in the capture's geometry; outputs must contain the recovered one."""
WINDOW_M2 = 1.2
SHOWN = (0, 3, 8, 13, 17, 22)
SAMPLES = 64


@dataclass(frozen=True)
class Inferred:
    """Output folder of an inference, and the inputs of its balance, which fits gains of the lights."""

    out: Path
    reconstruction: Reconstruction
    samples: RadianceSamples


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> Inferred:
    """The room reconstructed from light with untrained networks."""
    folder = tmp_path_factory.mktemp("found")
    torch.manual_seed(1)
    network = NetworkConfig(base_channels=4, global_channels=8)
    card = CheckpointCard(network=network, loss="none", phase="untrained", step=0)
    save_checkpoint(folder / "random.safetensors", card, MaterialNetwork(network))
    options = InferOptions(
        atlas=256, materials="light", is_leveled=False, is_checked=False, has_punctual=True
    )
    given: list[tuple[Reconstruction, RadianceSamples]] = []

    def balanced(reconstruction: Reconstruction, samples: RadianceSamples) -> balance.Balance | None:
        given.append((reconstruction, samples))
        return balance.balanced(reconstruction, samples)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("model.reconstruction.infer.balanced", balanced)
        infer(room_capture(CLAIMED), folder / "out", CheckpointMaps(folder / "random.safetensors"), options)
    return Inferred(folder / "out", *given[0])


@pytest.fixture(scope="module")
def inferred(run: Inferred) -> Path:
    return run.out


def report_of(out: Path) -> dict[str, Any]:
    return json.loads((out / "report.json").read_text())  # type: ignore[no-any-return]


def lights_of(out: Path) -> dict[str, dict[str, Any]]:
    return {row["slot"]: row for row in report_of(out)["light"]["lights"]}


def test_lamp_and_window_are_found(inferred: Path) -> None:
    """Radiance, area and power are within 5 %, positions within 1 cm (lamp) and 4 cm (window)."""
    lights = lights_of(inferred)
    assert sorted(lights) == ["lamp-0", "window-0"]
    lamp, window = lights["lamp-0"], lights["window-0"]
    assert (lamp["kind"], window["kind"]) == ("lamp", "window")
    np.testing.assert_allclose(lamp["place_m"], [2.0, 1.5, 2.48], atol=0.01)
    np.testing.assert_allclose(window["place_m"], [4.0, 1.5, 1.4], atol=0.04)
    for light, area, radiance in ((lamp, 1.0, LAMP), (window, WINDOW_M2, SKY)):
        assert light["area_m2"] == pytest.approx(area, rel=0.05)
        np.testing.assert_allclose(light["radiance"], radiance, rtol=0.05)
        np.testing.assert_allclose(light["power"], np.pi * area * np.array(radiance), rtol=0.05)


def gains_of(run: Inferred, factors: dict[str, Color]) -> dict[str, NDArray[np.float64]]:
    """Multiply the lights by ``factors``; return the fitted gains times ``factors`` by slot, ideally 1."""
    assert run.reconstruction.lights is not None
    wrong = replace(run.reconstruction, lights=run.reconstruction.lights.with_gains(factors))
    found = balance.balanced(wrong, run.samples)
    assert found is not None and found.loss_after < found.loss_before
    return {slot: np.array(gain) * factors[slot] for slot, gain in found.gains.items()}


def test_wrong_lights_are_corrected(run: Inferred) -> None:
    """Each light and channel is corrected for its error."""
    found = gains_of(run, {"lamp-0": (0.4, 0.5, 0.4), "window-0": (2.5, 2.5, 2.0)})
    for slot in ("lamp-0", "window-0"):
        np.testing.assert_allclose(found[slot], 1, rtol=0.07, err_msg=slot)


def test_wrong_sun_is_corrected(run: Inferred) -> None:
    """A sun of half the true irradiance is corrected from photographs of the sunlit room."""
    geometry = run.reconstruction.capture.geometry
    found = found_lights(sunlit().lit, TracedGeometry(geometry), geometry)
    lights = found.with_gains({"sun": (0.5, 0.5, 0.5)})
    wrong = replace(run.reconstruction, lights=lights)
    balance_of_sun = balance.balanced(wrong, radiance_samples(sunlit_room()))
    assert balance_of_sun is not None
    np.testing.assert_allclose(balance_of_sun.gains["sun"], 2, rtol=0.1)


def test_lights_over_the_limit_share_a_gain(run: Inferred, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(balance, "MAX_LIGHTS", 1)
    found = gains_of(run, {"lamp-0": (0.5, 0.5, 0.5), "window-0": (0.5, 0.5, 0.5)})
    assert found["lamp-0"].tolist() == found["window-0"].tolist()
    np.testing.assert_allclose(found["lamp-0"], 1, rtol=0.07)


def test_right_lights_keep_their_radiance(inferred: Path) -> None:
    for light in lights_of(inferred).values():
        np.testing.assert_allclose(light.get("gain", (1, 1, 1)), 1, rtol=0.07)


def test_without_light_or_samples_nothing_is_corrected(run: Inferred) -> None:
    few = radiance_samples(photographed_room(), 72)
    assert len(few) < balance.MIN_SAMPLES
    assert balance.balanced(run.reconstruction, few) is None
    assert balance.balanced(replace(run.reconstruction, lights=FoundLights()), run.samples) is None


def test_black_samples_correct_nothing(tmp_path: Path) -> None:
    """The floor of log radiance is relative to the samples' median, which is 0 if most are black."""
    capture, random = small_capture(2, (32, 24)), np.random.default_rng(0)
    atlas = empty_atlas(64)
    write_atlas_images(tmp_path, atlas, has_exr=False)
    lamp = FoundLamp("found-0", np.arange(2, dtype=np.int32), 1, (5.0,) * 3, (0.0,) * 3, 1.0, False)
    dark = Reconstruction(capture, capture.geometry.mesh, atlas, tmp_path, FoundLights((lamp,)))
    direction = random.normal(size=(200, 3)).astype(np.float32)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radiance = np.repeat(np.arange(200) % 5 < 2, 3).reshape(200, 3).astype(np.float32)
    origin = np.tile(np.float32([2.0, 1.5, 1.5]), (200, 1))
    assert balance.balanced(dark, RadianceSamples(origin, direction, radiance)) is None


def test_samples_are_unclipped_pixels_in_any_order_of_the_views() -> None:
    clipped = np.zeros((60, 80, 3), bool)
    clipped[:, :40, 1] = True
    views = [replace(view, clipped_mask=clipped) for view in photographed_room()]
    samples = radiance_samples(views, 240)
    assert len(samples) == 240
    again = radiance_samples(views[::-1], 240)
    assert samples.radiance.tobytes() == again.radiance.tobytes()
    found = 0
    for view in views:
        mine = np.abs(samples.origin_m - view.camera.position_m).max(axis=1) < 1e-6
        pixel, _ = view.camera.project(samples.origin_m[mine] + samples.direction[mine])
        column, row = np.floor(pixel).astype(int).T
        assert column.min() >= 40
        np.testing.assert_array_equal(samples.radiance[mine], view.color[row, column])
        found += int(mine.sum())
    assert found == 240


def rendered(out: Path, xml: str | None = None) -> dict[int, NDArray[np.float64]]:
    """Renderings of the exported Mitsuba scene or of ``xml``, by view."""
    import mitsuba as mi

    from mitsuba_plugins import register

    register()
    path = out / "mitsuba" / "scene.xml"
    if xml is not None:
        path = path.with_name("changed.xml")
        path.write_text(xml)
    scene = mi.load_file(str(path))
    return {
        k: np.asarray(mi.render(scene, sensor=k, spp=SAMPLES, seed=k), np.float64)[..., :3] for k in SHOWN
    }


def apart(shown: dict[int, NDArray[np.float64]]) -> tuple[float, float]:
    """Absolute log ratio of mean rendered to mean photographed radiance, and the median of this ratio over
    blocks of 5 x 5 pixels and channels."""
    blocks, sums = [], np.zeros(2)
    for index, image in shown.items():
        pair = [np.asarray(values, np.float64) for values in (image, photographed_room()[index].color)]
        sums += [values.mean() for values in pair]
        a, b = (v.reshape(12, 5, 16, 5, 3).mean(axis=(1, 3)) for v in pair)
        blocks.append(np.abs(np.log(np.maximum(a, 1e-4) / np.maximum(b, 1e-4))).ravel())
    return abs(float(np.log(sums[0] / sums[1]))), float(np.median(np.concatenate(blocks)))


def test_mitsuba_scene_reproduces_the_photographs(inferred: Path) -> None:
    """The closed room renders like the photographs from only the recovered materials and lights."""
    mean, block = apart(rendered(inferred))
    assert mean < 0.05 and block < 0.06, (mean, block)


def test_a_ten_per_cent_light_error_is_detected(inferred: Path) -> None:
    """Injected fault: lamp and window 10 % brighter."""
    import re

    xml = (inferred / "mitsuba" / "scene.xml").read_text()

    def brighter(match: re.Match[str]) -> str:
        values = " ".join(repr(1.1 * float(word)) for word in match[1].split())
        return f'name="radiance" value="{values}"'

    changed, count = re.subn(r'name="radiance" value="([^"]+)"', brighter, xml)
    assert count >= 2
    mean, block = apart(rendered(inferred, changed))
    assert mean > 0.05 and block > 0.06, (mean, block)


def test_package_contains_the_lights(inferred: Path) -> None:
    with open_package(inferred / "asset") as package:
        asset = package.asset
        assert isinstance(asset, EnvironmentAsset)
        np.testing.assert_allclose(asset.materials["lamp-0"].emission, LAMP, rtol=0.05)
        panels = [light for light in asset.lights if isinstance(light, AreaLight)]
        assert len(panels) == len(asset.lights) > 0
        area = [float(np.linalg.norm(np.cross(p.edge_u_m, p.edge_v_m))) for p in panels]
        power = sum(a * np.array(p.radiance) for a, p in zip(area, panels, strict=True))
        np.testing.assert_allclose(power, WINDOW_M2 * np.array(SKY), rtol=0.05)
        inward = [np.cross(p.edge_u_m, p.edge_v_m)[0] for p in panels]  # the window is in the east wall
        assert max(inward) < 0


def test_package_renders_under_its_lights(inferred: Path) -> None:
    """The package alone renders like the photographs in the project's renderer."""
    from model.reconstruction.render.relight import RelightOptions, render_asset

    names = tuple(f"view-{k:03d}" for k in SHOWN[:3])
    options = RelightOptions(views=names, samples=SAMPLES, denoise=False)
    shown = {int(image.name[-3:]): image.color for image in render_asset(inferred / "asset", options)}
    mean, block = apart(shown)
    assert mean < 0.05 and block < 0.06, (mean, block)


def glb_document(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length])  # type: ignore[no-any-return]


def test_glb_round_trips_with_its_lights(inferred: Path, tmp_path: Path) -> None:
    """Emission is read by the project's importer and trimesh; the lamp is too large for a point light."""
    import trimesh

    from datagen.importers.common import ImportOptions
    from datagen.importers.gltf import import_gltf

    glb = inferred / "box.glb"
    (imported,) = import_gltf(glb, tmp_path, ImportOptions(kind="environment", license="CC0-1.0"))
    with open_package(imported.path) as package:
        assert isinstance(package.asset, EnvironmentAsset)
        emission = {slot: m.emission for slot, m in package.asset.materials.items() if m.emission is not None}
        np.testing.assert_allclose(emission["lamp-0"], LAMP, rtol=0.05)
        windows = [value for slot, value in emission.items() if slot.startswith("window-0")]
        np.testing.assert_allclose(np.mean(windows, axis=0), SKY, rtol=0.1)
    document = glb_document(glb)
    assert "KHR_lights_punctual" not in document.get("extensionsUsed", ())
    for material in document["materials"]:
        assert max(material.get("emissiveFactor", [0])) <= 1
    scene = trimesh.load(glb)
    assert {g.visual.material.name for g in scene.geometry.values()} == {
        material["name"] for material in document["materials"]
    }


def test_confidence_has_an_image_and_pictures(inferred: Path) -> None:
    """With materials from light only, exactly the seen texels have confidence."""
    confidence = read_image(inferred / "atlas" / "confidence.png")
    seen = read_image(inferred / "atlas" / "mask.png")[..., 0] == 255
    assert confidence.shape == (256, 256, 3)
    assert (confidence[seen] == 255).mean() > 0.98 and confidence[~seen].max() == 0
    exr = read_image(inferred / "atlas" / "confidence.exr")
    np.testing.assert_allclose(exr[..., :3], confidence / 255, atol=5e-4)


def test_reports_contain_lights_confidence_and_cost(inferred: Path) -> None:
    report, page = report_of(inferred), (inferred / "report.html").read_text()
    steps = report["light"]["seconds"]
    assert {"surfels", "irradiance", "solve", "maps", "lights"} <= set(steps)
    assert set(report["light"]["memory_mb"]) == set(steps)
    assert set(report["memory_mb"]) == set(report["seconds"]) and min(report["memory_mb"].values()) > 50
    for text in ("lamp surface", "window opening", "confidence of D", "irradiance", "2.00 1.50 2.48"):
        assert text in page, text
    assert page.count("<img") == 1 + 3 * 6 and "http" not in page
