# SPDX-License-Identifier: MIT
"""Relighting of reconstructed rooms: which lights are on, and separate columns for recovered light."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from datagen.formats.capture import GeometryPart
from datagen.formats.configuration import Configuration, configuration_of
from datagen.formats.lights import AreaLight, PointLight
from datagen.formats.package import open_package
from model.evaluation.opened_scene import INSERTED, MODIFIED, OWN, RECOVERED
from model.evaluation.rerendering import recovered_sceneries
from model.evaluation.results import MethodResult, SceneResult, SuiteResult
from model.evaluation.scenery import Scenery
from model.evaluation.suite import ModifiedLight
from model.evaluation.tables import tables_of
from model.reconstruction.export.asset import write_asset
from model.reconstruction.found_lights import FoundLamp, FoundLights
from tests.model.test_light_sky import PANEL, WINDOW, exported

TRUE = (3.0, 4.0, 5.0)
SUN = PointLight(name="sun", position_m=(1.0, 1.0, 2.0), intensity=(9.0, 9.0, 9.0))


@dataclass(frozen=True)
class Geometry:
    parts: tuple[GeometryPart, ...]


@dataclass(frozen=True)
class Seen:
    geometry: Geometry


@dataclass(frozen=True)
class Opened:
    """The fields of an opened scene that :func:`recovered_sceneries` reads."""

    sceneries: dict[str, Scenery]
    capture: Seen
    modified_gain: float


def lamp(slot: str, face: int, radiance: tuple[float, float, float], *, is_named: bool) -> FoundLamp:
    return FoundLamp(slot, np.array([face], np.int32), 1, radiance, (0.0, 0.0, 0.0), 1.0, is_named)


@pytest.fixture
def reconstruction(tmp_path: Path) -> Path:
    """A package with a lamp that is a named part of the geometry, an unnamed lamp, and a window."""
    lamps = (
        lamp("lamp-0", 0, (2.5, 3.5, 4.5), is_named=True),
        lamp("found-0", 1, (1.0, 1.0, 1.0), is_named=False),
    )
    lights = FoundLights(lamps, windows=(WINDOW,))
    write_asset(tmp_path / "asset", exported(tmp_path, lights), "room").close()
    (tmp_path / "report.json").write_text(json.dumps({"light": {"lights": lights.described()}}))
    return tmp_path / "asset"


def opened(asset: Path, gain: float) -> Opened:
    with open_package(asset) as package:
        true: Configuration = configuration_of(package)
    scenery = Scenery(true.model_copy(update={"lights": (SUN,)}), (asset,))
    parts = (GeometryPart("wall", 0, 5), GeometryPart("bulb", 5, 1, TRUE))
    return Opened({OWN: scenery, MODIFIED: scenery, INSERTED: scenery}, Seen(Geometry(parts)), gain)


@pytest.mark.parametrize("gain", [0.0, 0.5])
def test_lamps_of_the_scene_light_a_reconstruction(
    reconstruction: Path, gain: float, mitsuba_variant: str
) -> None:
    """Named lamps have the scene's radiance, times the gain under modified light, not the recovered one."""
    sceneries = recovered_sceneries(opened(reconstruction, gain), reconstruction)  # type: ignore[arg-type]
    assert list(sceneries) == [OWN, MODIFIED, INSERTED, RECOVERED]
    off = (0.0, 0.0, 0.0)
    for light, factor in ((OWN, 1.0), (MODIFIED, gain), (INSERTED, 1.0)):
        configuration = sceneries[light].configuration
        assert configuration.environment.emission == {
            "lamp-0": tuple(factor * c for c in TRUE),
            "found-0": off,
        }
        assert configuration.lights == (SUN,)


def test_lights_that_the_geometry_shows_are_lamps(reconstruction: Path, mitsuba_variant: str) -> None:
    """A visible light that is a lamp of the reconstruction is left out; an invisible one is kept."""
    panel = AreaLight(name="bulb", origin_m=(0, 0, 2), edge_u_m=(1, 0, 0), edge_v_m=(0, -1, 0), radiance=TRUE)
    hidden = panel.model_copy(update={"is_visible": False})
    scene = opened(reconstruction, 1.0)
    parts = (GeometryPart("wall", 0, 5), GeometryPart("lights/bulb", 5, 1, TRUE))
    own = scene.sceneries[OWN]
    configuration = own.configuration.model_copy(update={"lights": (SUN, panel, hidden)})
    sceneries = {OWN: replace(own, configuration=configuration)}
    shown = replace(scene, sceneries=sceneries, capture=Seen(Geometry(parts)))
    lit = recovered_sceneries(shown, reconstruction)[OWN].configuration  # type: ignore[arg-type]
    assert lit.lights == (SUN, hidden)
    assert lit.environment.emission["lamp-0"] == TRUE


def test_visible_lights_stay_when_switched_off(reconstruction: Path, mitsuba_variant: str) -> None:
    """At gain 0, a visible light remains as a black surface, which a lamp of the reconstruction replaces."""
    panel = AreaLight(name="bulb", origin_m=(0, 0, 2), edge_u_m=(1, 0, 0), edge_v_m=(0, -1, 0), radiance=TRUE)
    other = panel.model_copy(update={"name": "panel"})
    hidden = panel.model_copy(update={"is_visible": False})
    scene = opened(reconstruction, 0.0)
    own = scene.sceneries[OWN]
    configuration = own.configuration.model_copy(update={"lights": (SUN, panel, other, hidden)})
    off = replace(own, configuration=configuration).lit_by(ModifiedLight(), [SUN])
    black = {"radiance": (0.0, 0.0, 0.0)}
    assert off.configuration.lights == (
        panel.model_copy(update=black),
        other.model_copy(update=black),
        SUN,
    )
    parts = (GeometryPart("wall", 0, 5), GeometryPart("lights/bulb", 5, 1, TRUE))
    shown = replace(scene, sceneries={OWN: own, MODIFIED: off}, capture=Seen(Geometry(parts)))
    lit = recovered_sceneries(shown, reconstruction)[MODIFIED].configuration  # type: ignore[arg-type]
    assert lit.lights == (other.model_copy(update=black), SUN)


def test_recovered_lights_replace_those_of_the_scene(reconstruction: Path, mitsuba_variant: str) -> None:
    """Only the package's emission and window light the scene."""
    scene = opened(reconstruction, 0.0)
    relit = recovered_sceneries(scene, reconstruction)[RECOVERED].configuration  # type: ignore[arg-type]
    assert relit.environment.emission == {} and relit.environment.asset == "room"
    (window,) = relit.lights
    assert isinstance(window, AreaLight) and window.radiance == PANEL.radiance
    assert relit.cameras == scene.sceneries[OWN].configuration.cameras
    (reconstruction.parent / "report.json").write_text(json.dumps({"light": {}}))
    assert RECOVERED not in recovered_sceneries(scene, reconstruction)  # type: ignore[arg-type]


def test_recovered_light_has_separate_columns() -> None:
    figures = {"psnr_srgb_db": 21.5, "dssim": 0.125}
    own = {"input": {"psnr_srgb_db": 30.0, "dssim": 0.05}}
    method = MethodResult(
        scene="box", method="ours", kind="network", images={OWN: own, RECOVERED: {"novel": figures}}
    )
    scene = SceneResult(
        name="box", num_views=1, num_novel=1, resolution=(8, 8), judged_views=(), novel_views=(),
        exposures={}, figure_views={}, path_samples=1.0, renders={}, methods=(method,),
    )  # fmt: skip
    result = SuiteResult(suite="box", may_be_known=False, lpips_absence="", scenes=(scene,))
    (table,) = (table for table in tables_of(result) if table.name == "rerendering")
    (row,) = table.rows
    shown = dict(zip(table.columns, row, strict=True))
    assert shown["recovered light, novel views: PSNR sRGB (dB)"] == 21.5
    assert shown["recovered light, novel views: DSSIM = 1-SSIM"] == 0.125
    assert shown["recovered light, input views: PSNR sRGB (dB)"] is None
    assert shown["own light, input views: PSNR sRGB (dB)"] == 30.0
