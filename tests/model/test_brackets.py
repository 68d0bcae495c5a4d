# SPDX-License-Identifier: MIT
"""Merging an exposure bracket recovers the photographed radiance."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datagen.foundation.color import srgb_from_linear
from datagen.foundation.images import encode_png
from model.reconstruction.captures.brackets import BracketSource
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.photographs import PhotographSource
from model.reconstruction.captures.read import read_capture
from tests.model.test_reconstruction_captures import SIZE, write_mesh

TIMES_S = (0.0025, 0.02, 0.16)
"""Exposure times three stops apart; 0.02 s has the scale 1, so the shortest clips at a radiance of 8."""
RADIANCE = np.geomspace(0.004, 12.0, SIZE[0] * SIZE[1]).reshape(SIZE[1], SIZE[0])


def write_bracket(
    folder: Path, times: tuple[float, ...] = TIMES_S, *, step_m: float = 0.0, has_exif: bool = True
) -> None:
    """Write JPEGs of the best quality, each camera ``step_m`` from the previous one."""
    folder.mkdir(exist_ok=True)
    write_mesh(folder)
    frames = []
    for index, time_s in enumerate(times):
        values = srgb_from_linear(np.clip(RADIANCE * time_s / 0.02, 0, 1))
        pixels = np.repeat(np.round(255 * values).astype(np.uint8)[..., None], 3, axis=2)
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: time_s, 0x829D: 4.0, 0x8827: 200})
        Image.fromarray(pixels).save(
            folder / f"{index}.jpg", quality=100, **({"exif": exif} if has_exif else {})
        )
        pose = np.eye(4)
        pose[0, 3] = step_m * index
        frames.append({"file_path": f"{index}.jpg", "transform_matrix": pose.tolist(), "fl_x": 50.0})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))


def test_bracket_is_one_view_of_the_true_radiance(tmp_path: Path) -> None:
    write_bracket(tmp_path)
    capture = read_capture(tmp_path)
    (view,) = capture.views
    assert "3 photographs are merged as 1 exposure brackets" in capture.notes
    image = view.read()
    assert image.clipped_mask is not None and image.limit == pytest.approx(8)
    is_beyond = RADIANCE > 8
    np.testing.assert_array_equal(image.clipped_mask[RADIANCE < 7.5], False)
    np.testing.assert_array_equal(image.clipped_mask[is_beyond], True)
    np.testing.assert_allclose(image.color[is_beyond], 8, rtol=0.01)
    is_known = RADIANCE < 7.5
    off = image.color[is_known] / RADIANCE[is_known][:, None] - 1
    assert np.sqrt((off**2).mean()) < 0.01 and np.abs(off).max() < 0.05  # limited by 8 bits
    assert abs(off.mean()) < 0.003


def test_order_changes_nothing(tmp_path: Path) -> None:
    first = None
    for number, times in enumerate(itertools.permutations(TIMES_S)):
        write_bracket(tmp_path / str(number), times)
        (view,) = read_capture(tmp_path / str(number)).views
        color = view.read().color
        first = color if first is None else first
        np.testing.assert_array_equal(color, first)


def test_weights_are_exposures(tmp_path: Path) -> None:
    """Values of 0.5 in the long and 0.6 in the short exposure yield (0.5 + 0.6 / 8) / (1 + 1 / 8)."""
    write_bracket(tmp_path)
    (view,) = read_capture(tmp_path).views
    sources = []
    for scale, value in ((8.0, 0.6), (1.0, 0.5)):
        path = tmp_path / f"{scale}-16.png"
        stored = np.round(65535 * srgb_from_linear(np.full((SIZE[1], SIZE[0], 3), value / scale)))
        path.write_bytes(encode_png(stored.astype(np.uint16)))
        sources.append(PhotographSource(path, view.camera, None, "srgb", scale))
    got = BracketSource(tuple(sources)).read(view.camera).color
    np.testing.assert_allclose(got, (0.5 + 0.6 / 8) / (1 + 1 / 8), rtol=1e-3)


@pytest.mark.parametrize(
    "write", [{"has_exif": False}, {"times": (0.02, 0.02, 0.02)}, {"step_m": 0.002}], ids=str
)
def test_other_views_are_not_merged(tmp_path: Path, write: dict) -> None:
    write_bracket(tmp_path, **write)
    capture = read_capture(tmp_path)
    assert len(capture.views) == 3
    assert any("share the pose of 0" in note for note in capture.notes) is ("step_m" not in write)


def test_common_exposures_are_not_merged(tmp_path: Path) -> None:
    write_bracket(tmp_path)
    assert len(read_capture(tmp_path, CaptureOptions(exposure="common")).views) == 3
