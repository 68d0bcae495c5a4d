# SPDX-License-Identifier: MIT
"""`materials infer` with materials from light, on the lit box."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from datagen.foundation.color import linear_from_srgb
from datagen.foundation.images import read_image
from datagen.foundation.progress import Progress
from model.checkpoint import CheckpointCard, save_checkpoint
from model.networks import MaterialNetwork, NetworkConfig
from model.reconstruction.infer import InferOptions, InferReport, infer
from model.reconstruction.infer_options import Materials
from model.reconstruction.predict.sources import CheckpointMaps
from tests.model.lit_box import ALBEDOS, LAMP_RADIANCE, box_capture

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def untrained(folder: Path, seed: int) -> CheckpointMaps:
    """Maps of an untrained network, which are nearly constant grey."""
    torch.manual_seed(seed)
    network = NetworkConfig(base_channels=4, global_channels=8)
    card = CheckpointCard(network=network, loss="none", phase="untrained", step=0)
    path = folder / f"random-{seed}.safetensors"
    save_checkpoint(path, card, MaterialNetwork(network))
    return CheckpointMaps(path)


def inferred(
    folder: Path,
    seed: int,
    materials: Materials,
    white: float = np.inf,
    tell: Progress = lambda stage, done, total: None,
) -> tuple[InferReport, NDArray[np.float64]]:
    """The report, and D (K, 3) of the atlas's seen texels."""
    options = InferOptions(atlas=128, materials=materials, is_checked=False, has_exr=False)
    out = folder / f"{materials}-{seed}-{white}"
    report = infer(box_capture(white), out, untrained(folder, seed), options, tell)
    atlas = read_image(out / "atlas" / "diffuse_albedo.png")[..., :3] / 255.0
    seen = read_image(out / "atlas" / "mask.png")[..., 0] == 255
    return report, linear_from_srgb(atlas[seen])


def walls_found(found: NDArray) -> NDArray[np.float64]:
    """Share of the texels within 20 % of the albedo of a wall. It is below 1 because an untrained network
    predicts a specular albedo that lowers D and that the photographs cannot exclude."""
    apart = np.abs(np.log(np.maximum(found, 1e-3)[:, None] / ALBEDOS[None])).max(axis=2).min(axis=1)
    return np.mean(apart < 0.2)


def test_atlas_has_the_walls_albedos_for_any_prediction(tmp_path: Path) -> None:
    steps: list[tuple[str, int, int]] = []
    report, found = inferred(tmp_path, 3, "both", tell=lambda *progress: steps.append(progress))
    assert walls_found(found) > 0.7
    finished = {stage for stage, done, total in steps if done == total}
    assert set(report.seconds) - finished == {"statistics", "write maps"}  # these are parts of predict
    assert {("light", 1, 11), ("lights", 0, 1), ("export", 1, 4), ("trace", 0, 1)} <= set(steps)
    written = json.loads((tmp_path / "both-3-inf" / "report.json").read_text())["light"]
    assert written["photographed_share"] > 0.95 and min(written["confidence"][:2]) > 0.95
    # Roughness is less certain: the untrained network predicts gloss that fits no worse than matte.
    assert 0.4 < written["confidence"][2] < min(written["confidence"][:2])
    assert written["num_surfels"] > 1000 and len(written["lights"]) == 1
    assert "light" in report.seconds and set(written["seconds"]) >= {"surfels", "irradiance", "solve", "maps"}
    _, other = inferred(tmp_path, 4, "both")
    assert np.median(np.abs(found - other)) < 0.02


def test_light_alone_needs_no_level(tmp_path: Path) -> None:
    report, found = inferred(tmp_path, 3, "light")
    assert walls_found(found) > 0.85
    assert report.light["confidence"] == (1.0, 1.0, 1.0)


def test_network_alone_ignores_light(tmp_path: Path) -> None:
    """Counterpart: untrained networks do not predict the walls' albedos."""
    report, found = inferred(tmp_path, 3, "network")
    assert report.light == {} and "light" not in report.seconds
    assert walls_found(found) < 0.5


def test_clipped_lamp_is_recovered_from_lit_surfaces(tmp_path: Path) -> None:
    """The lamp is 17 to 23 times as bright as the clipping limit, and part of the ceiling is clipped."""
    report, found = inferred(tmp_path, 3, "both", white=0.6)
    (source,) = report.radiometry["sources"][:1]
    np.testing.assert_allclose(source["radiance"], LAMP_RADIANCE, rtol=0.1)
    assert report.radiometry["clipped_share"] > 0.02 and source["spread"] < 0.2
    assert any("sensor's limit" in note for note in report.notes)
    assert walls_found(found) > 0.65 and min(report.light["confidence"][:2]) > 0.9
