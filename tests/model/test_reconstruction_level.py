# SPDX-License-Identifier: MIT
"""Albedo scale from interreflection, in a room of known albedos."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from datagen.foundation.color import linear_from_srgb
from datagen.foundation.images import read_image
from datagen.geometry.traced import TracedGeometry, smooth_regions
from datagen.geometry.views import TracedView, trace_capture
from model.checkpoint import CheckpointCard, save_checkpoint
from model.networks import MaterialNetwork, NetworkConfig
from model.reconstruction.albedo_level import AlbedoLevel, clipped_share, find_level
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.predict.sources import CheckpointMaps
from tests.model.lit_box import ALBEDOS, box_capture, box_geometry, photographed_box

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
PREDICTED = 0.35


def predicted(views: Sequence[TracedView], level: float = PREDICTED) -> list[dict[str, NDArray]]:
    """Constant grey diffuse maps of a wrong albedo scale, without specular part."""
    shape = views[0].color.shape
    maps = {
        "diffuse_albedo": np.full(shape, level, np.float16),
        "specular_albedo": np.zeros(shape, np.float16),
    }
    return [dict(maps) for _ in views]


def level_of(views: Sequence[TracedView], maps: list[dict[str, NDArray]] | None = None) -> AlbedoLevel:
    traced = TracedGeometry(box_geometry())
    maps = predicted(views) if maps is None else maps
    return find_level(views, maps, traced, box_geometry().emitter_mask(), smooth_regions(traced.mesh))


def found_albedos(level: AlbedoLevel, maps_level: float = PREDICTED) -> NDArray:
    """Albedos (6, 3) of the walls after the correction."""
    region = smooth_regions(TracedGeometry(box_geometry()).mesh)
    return maps_level * level.gains[region[: 2 * len(ALBEDOS) : 2]]


@pytest.fixture(scope="module")
def level(mitsuba_variant: str) -> AlbedoLevel:
    """Albedo scale of the unchanged box."""
    return level_of(photographed_box())


def test_albedo_of_a_closed_room_is_found(level: AlbedoLevel) -> None:
    """Interreflection with a visible lamp determines the albedo of every wall and channel within 4 %, for any
    prediction and exposure."""
    views = photographed_box()
    assert level.report.is_applied and level.report.reason == ""
    np.testing.assert_allclose(found_albedos(level), ALBEDOS, rtol=0.04)
    assert level.report.coverage > 0.97 and level.report.spread < 0.1
    brighter = [TracedView(v.camera, 7 * v.color, v.geometry, v.valid_mask) for v in views]
    paler = level_of(brighter, predicted(views, 0.7))
    np.testing.assert_allclose(found_albedos(paler, 0.7), found_albedos(level), rtol=1e-3)


def test_unseen_sun_does_not_brighten_the_floor() -> None:
    """An unphotographed light makes a patch of floor several times brighter. A mean over the floor would be
    at least 1.5 times too bright; the mode is within 10 %."""
    views = photographed_box(has_sun=True)
    level = level_of(views)
    assert level.report.is_applied
    np.testing.assert_allclose(found_albedos(level), ALBEDOS, rtol=0.1)
    shown = np.concatenate([v.color[(v.geometry.face == 8) | (v.geometry.face == 9)] for v in views])
    assert shown.mean() > 1.5 * np.median(shown)  # the sun is present and strong


def test_corrected_maps_are_clipped_and_leave_the_rest(level: AlbedoLevel) -> None:
    diffuse = np.full((2, 2, 3), PREDICTED, np.float16)
    region = np.array([[0, -1], [1, 0]])
    corrected = level.corrected(diffuse, region)
    assert corrected.dtype == np.float16
    np.testing.assert_array_equal(corrected[0, 1], diffuse[0, 1])
    np.testing.assert_allclose(corrected[1, 0], PREDICTED * level.gains[1], rtol=2e-3)
    assert level.corrected(np.ones((2, 2, 3), np.float16), region).max() == 1
    assert (diffuse == np.float16(PREDICTED)).all()


def test_the_same_photographs_give_the_same_level(level: AlbedoLevel) -> None:
    again = level_of(photographed_box())
    np.testing.assert_array_equal(level.gains, again.gains)
    assert level.report == again.report


@pytest.mark.parametrize(
    ("kept", "reason"),
    [(slice(0, 1), "no photograph shows"), (slice(0, 0), "no view")],
    ids=["one view", "no view"],
)
def test_too_little_evidence_changes_nothing(kept: slice, reason: str) -> None:
    views = photographed_box()[kept]
    found = level_of(views, predicted(views) if views else [])
    assert not found.report.is_applied and reason in found.report.reason
    assert (found.gains == 1).all()


def test_unknown_light_is_estimated_from_known_light() -> None:
    """Every third square of all surfaces, lamp included, is missing from the photographs. Without division by
    the known share of light, albedos would be a seventh too bright."""
    views = []
    for view in photographed_box():
        depth = view.geometry.depth_z_m
        place = view.camera.unproject(view.camera.pixel_centers(), depth[..., 0])
        is_missing = np.floor(place / 0.9 + 0.25).sum(axis=-1, keepdims=True) % 3 == 0
        geometry = replace(
            view.geometry,
            depth_z_m=np.where(is_missing, 0, depth),
            surface_mask=np.where(is_missing, 0, view.geometry.surface_mask),
            face=np.where(is_missing[..., 0], -1, view.geometry.face),
        )
        views.append(replace(view, geometry=geometry, valid_mask=view.valid_mask & ~is_missing[..., 0]))
    found = level_of(views)
    assert found.report.is_applied and 0.75 < found.report.coverage < 0.9
    np.testing.assert_allclose(found_albedos(found), ALBEDOS, rtol=0.05)


def test_a_hidden_lamp_changes_nothing() -> None:
    """The lamp is masked in all photographs, so the room seems to reflect more than arrives."""
    views = []
    for view in photographed_box():
        is_lamp = view.geometry.face >= 12
        geometry = replace(view.geometry, depth_z_m=np.where(is_lamp[..., None], 0, view.geometry.depth_z_m))
        views.append(replace(view, geometry=geometry, valid_mask=~is_lamp))
    found = level_of(views)
    assert not found.report.is_applied and "no photograph shows" in found.report.reason
    assert found.report.coverage > 0.8 and found.report.impossible_share > 0.4


def test_contradictory_evidence_changes_nothing() -> None:
    """No gain corrects predictions that are unrelated to the reflectance within a wall."""
    views = photographed_box()
    random, maps = np.random.default_rng(0), predicted(views)
    values = np.exp(random.uniform(np.log(0.03), 0, (16, 16, 16)))
    for view, view_maps in zip(views, maps, strict=True):
        place = view.camera.unproject(view.camera.pixel_centers(), view.geometry.depth_z_m[..., 0])
        x, y, z = np.moveaxis(np.floor(place / 0.25).astype(int) % 16, -1, 0)
        view_maps["diffuse_albedo"] = np.repeat(values[x, y, z][..., None], 3, axis=2).astype(np.float16)
    level = level_of(views, maps)
    assert level.report.trust == 0 and "varies too much" in level.report.reason
    assert level.report.spread > 0.6 and level.gains.max() == 1


@pytest.mark.parametrize(("part", "is_applied"), [(0.05, True), (0.7, False)])
def test_uncertain_light_does_not_count(part: float, is_applied: bool) -> None:
    """About ``part`` of the incident light is uncertain everywhere."""
    views = photographed_box()
    traced = TracedGeometry(box_geometry())
    brightness = float(np.median(np.concatenate([view.color.mean(axis=2).ravel() for view in views])))

    def doubt_at(position_m: NDArray, normal: NDArray) -> NDArray[np.float64]:
        return np.full(len(position_m), part * brightness / 0.5)  # shading is radiance / albedo

    regions = smooth_regions(traced.mesh)
    emits = box_geometry().emitter_mask()
    found = find_level(views, predicted(views), traced, emits, regions, doubt_at=doubt_at)
    assert found.report.is_applied == is_applied


def test_inference_corrects_the_atlas_and_keeps_the_views(tmp_path: Path) -> None:
    """The atlas is multiplied by the gains, and views stay as an untrained network predicts them. A lamp at
    the clipping limit changes little."""
    torch.manual_seed(3)
    network = NetworkConfig(base_channels=4, global_channels=8)
    card = CheckpointCard(network=network, loss="none", phase="untrained", step=0)
    save_checkpoint(tmp_path / "random.safetensors", card, MaterialNetwork(network))
    found, reports = {}, {}
    for name, is_leveled, white in (
        ("with", True, np.inf),
        ("without", False, np.inf),
        ("clipped", True, 0.6),
    ):
        options = InferOptions(
            atlas=128, is_leveled=is_leveled, materials="network", is_checked=False, has_exr=False
        )
        reports[name] = infer(
            box_capture(white), tmp_path / name, CheckpointMaps(tmp_path / "random.safetensors"), options
        )
        atlas = read_image(tmp_path / name / "atlas" / "diffuse_albedo.png")[..., :3] / 255.0
        seen = read_image(tmp_path / name / "atlas" / "mask.png")[..., 0] == 255
        found[name] = float(np.median(linear_from_srgb(atlas[seen])))
    written = json.loads((tmp_path / "with" / "report.json").read_text())["albedo_level"]
    assert written["is_applied"] and written["coverage"] > 0.9 and "level" in reports["with"].seconds
    gain = float(np.median(written["gain"]))
    assert abs(np.log(gain)) > 0.2 and abs(np.log(found["with"] / found["without"] / gain)) < 0.15
    assert reports["without"].albedo_level == {} and reports["clipped"].albedo_level["is_applied"]
    assert any("sensor's limit" in note for note in reports["clipped"].notes)
    assert abs(np.log(found["clipped"] / found["with"])) < 0.15
    for path in (tmp_path / "with" / "views").iterdir():
        assert path.read_bytes() == (tmp_path / "without" / "views" / path.name).read_bytes()


@pytest.mark.parametrize("white", [np.inf, 0.6])
def test_share_of_clipped_pixels_is_exact(white: float) -> None:
    """The share counts pixels at the clipping limit."""
    traced = trace_capture(box_capture(white))
    colors = np.stack([view.color for view in photographed_box()])
    assert clipped_share(traced.views) == np.mean(colors.max(axis=-1) >= white)
