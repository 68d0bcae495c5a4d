# SPDX-License-Identifier: MIT
"""Sceneries of a reconstruction under the lights of the scene and under the recovered lights."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from datagen.formats.asset import EnvironmentAsset
from datagen.formats.capture import GeometryPart
from datagen.formats.package import open_package
from datagen.formats.standalone import configuration_of
from datagen.rendering.capture_geometry import light_of_part
from model.evaluation.opened_scene import MODIFIED, OWN, RECOVERED, OpenedScene
from model.evaluation.scenery import Scenery, recovered_scenery

Emission = dict[str, tuple[float, float, float]]


def recovered_sceneries(scene: OpenedScene, asset: Path) -> dict[str, Scenery]:
    """Sceneries of the package ``asset``: one for each light of the scene, one for recovered lights."""
    parts, sceneries = scene.capture.geometry.parts, {}
    lamps = {name for part in parts if (name := light_of_part(part.name)) is not None}
    for light, truth in scene.sceneries.items():
        gain = scene.modified_gain if light == MODIFIED else 1.0
        sceneries[light] = recovered_scenery(truth, asset, own_emission(asset, parts, gain), lamps)
    report = json.loads((asset.parent / "report.json").read_bytes())
    if report["light"].get("lights"):
        sceneries[RECOVERED] = relit_scenery(scene.sceneries[OWN], asset)
    return sceneries


def own_emission(asset: Path, parts: Iterable[GeometryPart], gain: float) -> Emission:
    """RGB radiance by emissive slot of the package ``asset`` that reproduces the scene's lamps.

    Slot ``lamp-N`` (``export.slots``) gets the radiance of the N-th emissive part times ``gain``; all other
    slots get 0.
    """
    emitted = [part.emission for part in parts if part.emission is not None]
    lamps = {f"lamp-{number}": radiance for number, radiance in enumerate(emitted)}
    room, found = open_package(asset).asset, {}
    assert isinstance(room, EnvironmentAsset)
    for slot, material in room.materials.items():
        if material.emission is not None:
            red, green, blue = (gain * channel for channel in lamps.get(slot, (0.0, 0.0, 0.0)))
            found[slot] = (red, green, blue)
    return found


def relit_scenery(truth: Scenery, asset: Path) -> Scenery:
    """Scenery of the package ``asset`` under only its own lights, with the cameras of ``truth``."""
    lights = configuration_of(asset, open_package(asset).sha256).lights
    scenery = recovered_scenery(truth, asset, {})
    return Scenery(scenery.configuration.model_copy(update={"lights": lights}), scenery.library)
