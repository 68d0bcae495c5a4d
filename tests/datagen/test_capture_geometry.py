# SPDX-License-Identifier: MIT
"""Lights with a visible surface become emissive parts of a capture's geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.formats.lights import AreaLight, Light, PointLight, SphereLight
from datagen.library import Library
from datagen.rendering.capture_geometry import (
    configuration_geometry,
    lamp_mesh,
    light_of_part,
    without_lamps,
)
from tests.datagen.small_plan import plan_small

PANEL = AreaLight(
    name="panel",
    origin_m=(1.0, 2.0, 3.0),
    edge_u_m=(0.5, 0.0, 0.0),
    edge_v_m=(0.0, -0.4, 0.0),
    radiance=(9.0, 8.0, 7.0),
)
BULB = SphereLight(name="bulb", position_m=(-1.0, 0.5, 2.0), radius_m=0.1, radiance=(4.0, 5.0, 6.0))
HIDDEN = PANEL.model_copy(update={"name": "hidden", "is_visible": False})
DARK = PANEL.model_copy(update={"name": "dark", "radiance": (0.0, 0.0, 0.0)})
POINT = PointLight(name="point", position_m=(0.0, 0.0, 1.0), intensity=(1.0, 1.0, 1.0))


def test_visible_lights_are_emissive_parts(tmp_path: Path) -> None:
    """Parts of lights follow those of the placed assets, in order, with the radiance of the lights."""
    folder = plan_small(tmp_path / "dataset", tmp_path / "library")
    configuration = folder.read_configuration(folder.read_plan().units[0])
    library = Library([tmp_path / "library"])
    lights: tuple[Light, ...] = (POINT, PANEL, HIDDEN, DARK, BULB)
    plain, _ = configuration_geometry(configuration.model_copy(update={"lights": ()}), library)
    lit, _ = configuration_geometry(configuration.model_copy(update={"lights": lights}), library)
    assert lit.parts[:-2] == plain.parts
    panel, bulb = lit.parts[-2:]
    assert (panel.name, panel.emission, panel.num_faces) == ("lights/panel", PANEL.radiance, 2)
    assert (bulb.name, bulb.emission) == ("lights/bulb", BULB.radiance)
    assert panel.first_face == len(plain.mesh.faces)
    assert bulb.first_face + bulb.num_faces == len(lit.mesh.faces)
    np.testing.assert_array_equal(lit.mesh.faces[: len(plain.mesh.faces)], plain.mesh.faces)
    corners = lit.mesh.positions[lit.mesh.faces[panel.first_face : bulb.first_face]].reshape(-1, 3)
    np.testing.assert_allclose(corners.min(axis=0), (1.0, 1.6, 3.0), atol=1e-6)
    np.testing.assert_allclose(corners.max(axis=0), (1.5, 2.0, 3.0), atol=1e-6)


def test_surfaces_of_lights_emit_outwards_and_have_their_area() -> None:
    panel, bulb = lamp_mesh(PANEL), lamp_mesh(BULB)
    first, second, third = np.moveaxis(panel.triangles(), 1, 0)
    assert (np.cross(second - first, third - first)[:, 2] < 0).all()  # normals are along u x v
    assert bulb.areas().sum() == pytest.approx(4 * np.pi * BULB.radius_m**2, rel=1e-5)
    first, second, third = np.moveaxis(bulb.triangles(), 1, 0)
    outwards = first - np.array(BULB.position_m)
    assert (np.einsum("ij,ij->i", np.cross(second - first, third - first), outwards) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(outwards, axis=1), BULB.radius_m, rtol=0.01)


def test_other_lights_remain_lights() -> None:
    assert without_lamps((POINT, PANEL, HIDDEN, DARK, BULB)) == (POINT, HIDDEN, DARK)
    assert light_of_part("lights/panel") == "panel" and light_of_part("room/panel") is None
