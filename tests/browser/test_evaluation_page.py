# SPDX-License-Identifier: MIT
"""The page of an evaluation in a real browser, with its slider between truth and estimate."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datagen.foundation.exr import encode_view
from model.evaluation.page import LARGEST_ERROR, NOTHING, best_and_worst, error_picture, page_html
from model.evaluation.rendering import BUFFERS, JudgedView
from model.evaluation.results import MethodResult, SceneResult, SuiteResult
from tests.browser.driver import open_browser

SIZE = (30, 48)
VIEWS = {"view-000": 20.0, "view-001": 14.0, "view-002": 17.0}


def _result(folder: Path) -> SuiteResult:
    """Result of one method that predicts 0.3 everywhere, on three views."""
    channels = dict.fromkeys(BUFFERS, 3) | {"roughness": 1, "surface_mask": 1, "depth_z_m": 1}
    for name in VIEWS:
        buffers = {b: np.full((*SIZE, channels[b]), 0.3, np.float32) for b in BUFFERS}
        buffers["surface_mask"] = np.ones((*SIZE, 1), np.float32)
        (folder / f"{name}.exr").write_bytes(encode_view(buffers))
    maps = dict.fromkeys(("diffuse_albedo", "specular_albedo", "roughness"), 0.04)
    method = MethodResult(
        scene="room",
        method="ours",
        kind="network",
        maps_merged=maps,
        by_kind={"merged": {"all": {"share": 1.0, **maps}, "metal": {"share": 0.1, **maps}}},
        image_views={"own": {"input": {name: {"psnr_srgb_db": value} for name, value in VIEWS.items()}}},
        renders={"own": str(folder)},
    )
    scene = SceneResult(
        name="room",
        num_views=3,
        num_novel=0,
        resolution=SIZE,
        judged_views=tuple(VIEWS),
        novel_views=(),
        exposures={"own": 1.0},
        figure_views={"input": "view-000"},
        path_samples=1,
        renders={},
        methods=(method,),
    )
    return SuiteResult(suite="s", may_be_known=True, lpips_absence="", scenes=(scene,))


def _truth() -> dict[str, JudgedView]:
    maps = {n: np.full((*SIZE, c), 0.5, np.float32) for n, c in (("diffuse_albedo", 3), ("roughness", 1))}
    maps["specular_albedo"] = maps["diffuse_albedo"]
    mask = np.ones(SIZE, bool)
    return dict.fromkeys(VIEWS, JudgedView(np.full((*SIZE, 3), 0.8, np.float32), maps, mask, ~mask))


def _page(tmp_path: Path) -> Path:
    path = tmp_path / "index.html"
    path.write_text(page_html(_result(tmp_path), ["a note"], [], {"room": []}, {"room": _truth()}))
    return path


def test_best_and_worst_views_are_shown(tmp_path: Path) -> None:
    (method,) = _result(tmp_path).scenes[0].methods
    assert best_and_worst(method) == [("best", "view-000", 20.0), ("worst", "view-001", 14.0)]
    page = _page(tmp_path).read_text()
    assert "best view (view-000): 20.0 dB" in page and "worst view (view-001): 14.0 dB" in page
    assert "17.0 ± " in page and "<b>0.0400</b>" in page


def test_a_camera_has_a_section_of_its_own(tmp_path: Path) -> None:
    result = _result(tmp_path)
    (scene,) = result.scenes
    (method,) = scene.methods
    worse = {name: 2 * error for name, error in method.maps_merged.items()}
    phone = method.model_copy(update={"camera": "phone", "maps_merged": worse})
    both = result.model_copy(update={"scenes": (scene.model_copy(update={"methods": (method, phone)}),)})
    page = page_html(both, [], [], {"room": []}, {"room": _truth()})
    assert '<a href="#room-phone">room, phone</a>' in page and '<section id="room-phone">' in page
    assert "<b>0.0400</b>" in page and "<b>0.0800</b>" in page


def test_errors_have_one_scale() -> None:
    errors = np.array([[0.0, 0.1, LARGEST_ERROR, 7.0, np.nan]])
    shown = error_picture(errors)[0]
    np.testing.assert_array_equal(shown[2], shown[3])
    np.testing.assert_array_equal(shown[4], NOTHING)
    assert (np.diff(shown[:3].sum(axis=1)) > 0).all()


def test_the_line_is_moved(tmp_path: Path) -> None:
    page = _page(tmp_path)
    with open_browser(tmp_path / "profile", 1200, 900) as driver:
        driver.get(page.as_uri())
        width = "return document.querySelector('.pair').getBoundingClientRect().width"
        clip = "return getComputedStyle(document.querySelector('.pair .over')).clipPath"
        assert driver.execute_script(width) > 100
        assert driver.execute_script("return document.querySelectorAll('.pair').length") == 2
        before = driver.execute_script(clip)
        driver.execute_script(
            "const range = document.querySelector('.pair input'); range.value = 20;"
            "range.dispatchEvent(new Event('input'))"
        )
        after = driver.execute_script(clip)
        assert before != after and "80%" in after.replace("calc(100% - 20%)", "80%")
        assert not [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
        images = "return [...document.images].every(image => image.complete && image.naturalWidth > 0)"
        assert driver.execute_script(images)
