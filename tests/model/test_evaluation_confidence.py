# SPDX-License-Identifier: MIT
"""Confidence of the atlas in the evaluated views, and its chart."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import encode_ply
from model.evaluation.charts import confidence_svg, standalone
from model.evaluation.rerendering import merged_confidence
from model.evaluation.results import MethodResult, SuiteResult
from tests.model.suite_results import suite_of

SIZE = 64


def wall() -> Mesh:
    """A square of 2 m in the plane x = 3, whose u increases towards -y and v towards +z."""
    corners = np.array([[3, 1, -1], [3, -1, -1], [3, -1, 1], [3, 1, 1]], np.float32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    normals = np.tile(np.array([[-1, 0, 0]], np.float32), (4, 1))
    return Mesh(corners, np.array([[0, 2, 1], [0, 3, 2]], np.int32), normals, uv)


def camera() -> Camera:
    """A camera of 3 x 2 pixels at the origin that faces the wall; its outer columns miss it."""
    return Camera(3, 2, 0.9, 1.5, 1.5, 1.0, look_at([0, 0, 0], [3, 0, 0], [0, 0, 1]))


def test_confidence_is_that_of_the_texel_at_each_pixel(tmp_path: Path) -> None:
    """D's confidence increases downwards in the image file, S's to the right; R's is 0.4."""
    (tmp_path / "atlas").mkdir()
    ramp = np.linspace(0, 255, SIZE)
    atlas = np.stack([*np.meshgrid(ramp, ramp, indexing="ij"), np.full((SIZE, SIZE), 102)], axis=2)
    Image.fromarray(np.round(atlas).astype(np.uint8)).save(tmp_path / "atlas" / "confidence.png")
    (tmp_path / "asset").mkdir()
    (tmp_path / "asset" / "surface.ply").write_bytes(encode_ply(wall()))
    found = merged_confidence(tmp_path, {"view": camera()})["view"]
    assert found.shape == (2, 3, 3)
    assert not found[:, [0, 2]].any()
    height = 3 * 0.5 / 1.5  # of the upper pixel's centre on the wall, in metres above its middle
    np.testing.assert_allclose(found[0, 1], [0.5 - height / 2, 0.5, 0.4], atol=0.01)
    np.testing.assert_allclose(found[1, 1], [0.5 + height / 2, 0.5, 0.4], atol=0.01)


def test_an_atlas_without_confidence_has_none(tmp_path: Path) -> None:
    assert merged_confidence(tmp_path, {"view": camera()}) == {}


def result(calibration: dict[str, list[float]]) -> SuiteResult:
    method = MethodResult(scene="hall", method="ours", kind="network", calibration=calibration)
    return suite_of(method)


def test_chart_shows_the_errors_of_the_quarters() -> None:
    """The first panel spans x = 34 to 324; there, errors of 0.005 to 1 span y = 188 to 48."""
    chart = standalone(confidence_svg(result({name: [0.5, 1.0, 0.1, 0.05, 0.01] for name in MATERIAL_MAPS})))
    root = ElementTree.fromstring(chart)
    circles = [(float(c.get("cx", 0)), float(c.get("cy", 0))) for c in root.findall(".//{*}circle")][1:5]
    assert [x for x, _ in circles] == pytest.approx([34 + 290 * (k + 0.5) / 4 for k in range(4)], abs=0.06)
    decades = np.log10(1 / 5e-3)
    expected = [48 + 140 * -np.log10(rmse) / decades for rmse in (1.0, 0.1, 0.05, 0.01)]
    assert [y for _, y in circles] == pytest.approx(expected, abs=0.06)
    assert confidence_svg(result({})) == ""
