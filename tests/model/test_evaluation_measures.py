# SPDX-License-Identifier: MIT
"""Map errors by kind of surface and up to scale, published measures, noise of figures, and cached LPIPS."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from trimesh.creation import box

from datagen.formats.base import canonical_json
from datagen.formats.capture import CaptureGeometry, CaptureView, ColorImage, GeometryPart
from datagen.formats.lights import DirectionalLight
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.errors import InputError
from datagen.foundation.meshes.mesh import Mesh, joined
from model.evaluation import commands
from model.evaluation.compare import comparison, read_other
from model.evaluation.evaluate import Evaluation
from model.evaluation.lpips import Lpips
from model.evaluation.map_measures import MapMeasures, level_figures, measures_of_others
from model.evaluation.noise import bootstrap_error, difference, seed_spread
from model.evaluation.rendering import JudgedView
from model.evaluation.results import MethodResult, SuiteResult
from model.evaluation.surface_kinds import SurfaceFinder, ViewSurfaces
from model.training.perceptual import LpipsVgg, lpips_vgg
from model.training.weights import Convolution
from tests.model.suite_results import suite_of

SHAPE = (4, 6)
D, S, R = "diffuse_albedo", "specular_albedo", "roughness"


def _maps(diffuse: float = 0.5, specular: float = 0.04, roughness: float = 1.0) -> dict[str, NDArray]:
    return {
        D: np.full((*SHAPE, 3), diffuse, np.float32),
        S: np.full((*SHAPE, 3), specular, np.float32),
        R: np.full((*SHAPE, 1), roughness, np.float32),
    }


def _view(maps: dict[str, NDArray], mask: NDArray | None = None, lit: NDArray | None = None) -> JudgedView:
    mask = np.ones(SHAPE, bool) if mask is None else mask
    return JudgedView(
        np.ones((*SHAPE, 3), np.float32), maps, mask, np.zeros(SHAPE, bool) if lit is None else lit
    )


def _nothing(region: NDArray | None = None) -> ViewSurfaces:
    return ViewSurfaces({}, np.zeros(SHAPE, np.int32) if region is None else region)


def test_errors_cover_the_common_surface() -> None:
    mask = np.zeros(SHAPE, bool)
    mask[:2] = True
    truth = _view(_maps(), mask)
    wrong = _maps(0.7, 0.24, 0.8)
    wrong[R][2:] = 99.0  # off the surface
    has_surface = np.ones(SHAPE, bool)
    has_surface[0] = False
    wrong[D][0] = 99.0  # a hole in the method's mesh
    measures = MapMeasures()
    measures.add("a", wrong, truth, _nothing(), rendered=_view(wrong, has_surface))
    expected = {D: 0.04, S: 0.04, R: 0.04}
    assert measures.mse() == pytest.approx(expected, rel=1e-5)
    assert measures.covered_share == 0.5
    assert measures.views["a"] == pytest.approx({**expected, "pixels": 6}, rel=1e-5)
    assert measures.figures()[f"{D}_psnr_db"] == pytest.approx(13.979, abs=1e-3)


def test_kinds_are_separated() -> None:
    """Errors at metal, white glossy and matt pixels are attributed to these kinds of surface."""
    truth = _maps()
    truth[S][:, :2], truth[D][:, :2] = 0.9, 0.0  # metal
    truth[D][:, 2:4], truth[R][:, 2:4] = 0.8, 0.2  # white and glossy
    view = _view(truth)
    estimate = {name: values.copy() for name, values in truth.items()}
    estimate[S][:, :2] = 0.4
    estimate[D][:, 2:4] = 0.5
    finder = SurfaceFinder(*_room())
    surfaces = finder.find(_capture_view(), view)
    measures = MapMeasures()
    measures.add("a", estimate, view, surfaces)
    kinds = measures.by_kind()
    assert kinds["metal"] == pytest.approx({"share": 1 / 3, D: 0, S: 0.25, R: 0}, abs=1e-6)
    assert kinds["white"][D] == kinds["glossy"][D] == pytest.approx(0.09, rel=1e-5)
    assert kinds["matt"] == pytest.approx({"share": 1 / 3, D: 0, S: 0, R: 0}, abs=1e-9)
    assert "seldom seen" not in kinds or kinds["seldom seen"]["share"] > 0


def _room() -> tuple[CaptureGeometry, list[DirectionalLight]]:
    """A table of 2 m with a cube of 10 cm, under an oblique sun."""
    table = box((2.0, 2.0, 0.1))
    cube = box((0.1, 0.1, 0.1))
    cube.apply_translation((0, 0, 0.1))
    meshes = [Mesh(np.asarray(b.vertices, np.float32), np.asarray(b.faces, np.int32)) for b in (table, cube)]
    geometry = CaptureGeometry(joined(meshes), (GeometryPart("table", 0, 12), GeometryPart("cube", 12, 12)))
    direction = (-1 / np.sqrt(2), 0.0, -1 / np.sqrt(2))
    return geometry, [DirectionalLight(name="sun", direction=direction, irradiance=(1, 1, 1))]


class _Counts:
    def __init__(self, count: NDArray):
        self.count = count

    def read(self, camera: Camera) -> ColorImage:
        raise AssertionError("not needed")

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        assert names == ("observation_count",)
        return {"observation_count": self.count}


def _capture_view(width: int = SHAPE[1], height: int = SHAPE[0], focal: float = 8.0) -> CaptureView:
    pose = look_at(np.array([0.0, 0.01, 1.5]), np.array([0.0, 0.0, 0.1]))
    camera = Camera(width, height, focal, focal, width / 2, height / 2, pose)
    count = np.full((height, width, 1), 9.0)
    count[0] = 3.0
    return CaptureView("view", camera, _Counts(count))


def test_small_things_shadows_and_rare_views_are_found() -> None:
    size = 60
    view = _capture_view(size, size, 100.0)
    maps = {name: np.broadcast_to(v[0, 0], (size, size, v.shape[2])) for name, v in _maps().items()}
    everywhere = np.ones((size, size), bool)
    truth = JudgedView(np.ones((size, size, 3), np.float32), maps, everywhere, ~everywhere)
    surfaces = SurfaceFinder(*_room()).find(view, truth)
    middle = size // 2
    assert surfaces.kinds["small"][middle, middle] and not surfaces.kinds["small"][5, 5]
    assert set(np.unique(surfaces.region)) == {0, 1}
    np.testing.assert_array_equal(surfaces.kinds["small"], surfaces.region == 1)
    np.testing.assert_array_equal(surfaces.kinds["seldom seen"].any(axis=1), np.arange(size) == 0)
    sunlit = surfaces.kinds["sunlit"]
    assert sunlit[middle, middle] and 0.005 < (~sunlit).mean() < 0.03  # except for the cube's shadow
    shadow = np.argwhere(~sunlit).mean(axis=0)
    beyond = view.camera.camera_from_world @ np.array([-0.1, 0.0, 0.05, 1.0])  # away from the sun
    column = 100.0 * beyond[0] / beyond[2] + size / 2
    assert shadow[1] == pytest.approx(column, abs=3)


def test_level_and_pattern_are_separated() -> None:
    random = np.random.default_rng(3)
    truth = random.uniform(0.2, 0.8, (600, 3))
    region = np.repeat([0, 1], 300)
    found = level_figures(0.5 * truth, truth, region)
    assert found["diffuse_gain"] == pytest.approx(2)
    assert found["diffuse_mse_gain"] == pytest.approx(0, abs=1e-12)
    assert found["level_error"] == pytest.approx(np.log(2))
    two = truth * np.where(region == 0, 0.5, 1.5)[:, None]  # correct patterns at two wrong levels
    found = level_figures(two, truth, region)
    assert found["diffuse_mse_gain"] > 0.01
    assert found["diffuse_mse_region_gain"] == pytest.approx(0, abs=1e-12)
    flat = np.broadcast_to(truth.mean(axis=0), truth.shape)  # correct level, no pattern
    found = level_figures(flat, truth, region)
    assert found["level_error"] < 0.05 < 2 * found["diffuse_mse_region_gain"]


def test_published_measures_follow_their_code() -> None:
    """Closed form for one view: kd is compared where the true R is 1; off the surface both images are 0."""
    truth = _maps(0.6, 0.0)
    truth[R][:, 3:] = 0.5
    lit = np.zeros(SHAPE, bool)
    lit[0] = True
    view = _view(truth, ~lit, lit)
    estimate = _maps(0.4, 0.0, 0.1)
    found = measures_of_others(estimate, view)
    error = (153 / 255 - 102 / 255) ** 2  # 0.6 and 0.4 in whole steps of 1 / 255
    assert found["kd_db"] == pytest.approx(-10 * np.log10(error * (3 * 3) / 24), abs=1e-3)
    assert found["a_prime_db"] == pytest.approx(-10 * np.log10(error * (3 * 6) / 24), abs=1e-3)
    rough = ((1 - 51 / 255) ** 2 * 9 + (127 / 255 - 51 / 255) ** 2 * 9) / 24  # 0.1 is clamped to 0.2
    assert found["roughness_db"] == pytest.approx(-10 * np.log10(rough), abs=1e-3)
    assert "emission_iou" not in found
    half = lit.copy()
    half[0, :3] = False
    with_light = measures_of_others(estimate, view, _view(estimate, ~half, half))
    assert with_light["emission_iou"] == pytest.approx(0.5)
    assert with_light["emission_log_l2"] == pytest.approx(np.log(2) ** 2 * 3 / 24)


def test_informative_confidence_scores_higher() -> None:
    random = np.random.default_rng(7)
    truth = _view(_maps())
    error = random.uniform(0, 0.4, (*SHAPE, 1)).astype(np.float32)
    estimate = {D: truth.maps[D] - error, S: truth.maps[S] + error, R: truth.maps[R] - error}
    sure = np.repeat(1 - error, 3, axis=2)
    sure[..., 1] = random.permutation(sure[..., 1].ravel()).reshape(SHAPE)
    measures = MapMeasures()
    measures.add("a", estimate, truth, _nothing(), confidence=sure)
    found = measures.calibration()
    assert found[D][0] == pytest.approx(1) and abs(found[S][0]) < 0.6
    assert found[D][1] > found[D][2] > found[D][3] > found[D][4]
    constant = MapMeasures()
    constant.add("a", estimate, truth, _nothing(), confidence=np.ones_like(sure))
    assert constant.calibration()[D][0] == 0
    without = MapMeasures()
    without.add("a", estimate, truth, _nothing())
    assert without.calibration() == {}


# ---- noise


def test_the_bootstrap_has_the_size_of_the_noise() -> None:
    """The RMS of 300 bootstrap errors of 12 views is the standard error of their mean within 6 %."""
    random = np.random.default_rng(11)
    draws = random.normal(20, 3, (300, 12))
    errors = np.array([bootstrap_error(row) for row in draws])
    assert np.sqrt((errors**2).mean()) == pytest.approx(3 / np.sqrt(12), rel=0.06)
    assert np.isnan(bootstrap_error([1.0]))


def test_significant_differences_are_detected() -> None:
    random = np.random.default_rng(13)
    hard = random.normal(20, 5, 12)  # views differ more than methods
    other = {f"view-{k:03d}": float(v) for k, v in enumerate(hard)}
    better = {name: value + 0.5 + random.normal(0, 0.1) for name, value in other.items()}
    found = difference(other, better)
    assert found is not None and not found.is_insignificant
    assert found.this - found.other == pytest.approx(0.5, abs=0.1) and found.error < 0.1
    noisy = difference(other, better, (1.0, 1.0))
    assert noisy is not None and noisy.is_insignificant  # renderer noise of 1 dB per view hides it
    same = difference(other, {name: value + random.normal(0, 0.5) for name, value in other.items()})
    assert same is not None and same.is_insignificant
    assert difference(other, {"view-000": 1.0}) is None


def test_a_second_seed_gives_the_spread() -> None:
    random = np.random.default_rng(17)
    pairs = [
        ({"psnr": float(a), "lpips": None}, {"psnr": float(b), "lpips": None})
        for a, b in random.normal(0, 2, (4000, 2))
    ]
    assert seed_spread(pairs) == {"psnr": pytest.approx(2, rel=0.05)}


# ---- LPIPS


def _random_layers() -> list[Convolution]:
    """Convolutions of VGG16 with random weights."""
    generator = torch.Generator().manual_seed(23)
    channels = (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
    return [
        Convolution(
            torch.randn(b, a, 3, 3, generator=generator) * (2 / (9 * a)) ** 0.5,
            0.1 * torch.randn(b, generator=generator),
        )
        for a, b in pairwise(channels)
    ]


def test_features_of_the_truth_are_computed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    layers = _random_layers()
    random = np.random.default_rng(19)
    truth, *images = random.random((3, 48, 64, 3))
    kept, plain = Lpips(tmp_path, layers), Lpips(None, layers)
    calls: list[int] = []
    whole = LpipsVgg.features

    def counted(network: LpipsVgg, image: torch.Tensor) -> list[torch.Tensor]:
        calls.append(1)
        return whole(network, image)

    with monkeypatch.context() as patch:
        patch.setattr(LpipsVgg, "features", counted)
        distances = [kept(image, truth) for image in images]
    assert len(calls) == 3 and len(list(tmp_path.iterdir())) == 1
    assert distances == pytest.approx([plain(image, truth) for image in images], abs=1e-4)
    tensors = [torch.from_numpy(x.transpose(2, 0, 1)).float()[None] * 2 - 1 for x in (images[0], truth)]
    assert plain(images[0], truth) == pytest.approx(float(lpips_vgg(layers, *tensors)), rel=1e-5)


# ---- two runs


def _run(psnr: dict[str, float], mse: dict[str, float], spread: float = 0.0) -> SuiteResult:
    method = MethodResult(
        scene="room",
        method="ours",
        kind="network",
        map_views={"merged": {v: {D: m, S: m, R: m, "pixels": 100.0} for v, m in mse.items()}},
        image_views={"own": {"input": {v: {"psnr_srgb_db": p, "lpips_vgg": None} for v, p in psnr.items()}}},
        seed_spread={"own": {"psnr_srgb_db": spread}},
    )
    return suite_of(method, tuple(psnr))


def test_two_runs_are_compared_beyond_noise(tmp_path: Path) -> None:
    views = [f"view-{k}" for k in range(6)]
    other = _run({v: 20.0 + k for k, v in enumerate(views)}, {v: 0.05 for v in views})
    better = _run(
        {v: 21.0 + k + 0.05 * (-1) ** k for k, v in enumerate(views)},
        {v: 0.05 + 0.01 * (-1) ** k for k, v in enumerate(views)},
    )
    rows = {row[2]: row for row in comparison(better, other).rows}
    psnr = rows["own light, input views: PSNR (dB)"]
    assert psnr[3:6] == pytest.approx((22.5, 23.5, 1.0)) and psnr[7] == "better"
    assert rows["D merged (MSE)"][7] == "none"
    noisy = {row[2]: row for row in comparison(_run({v: 21.0 for v in views}, {}, 3.0), other).rows}
    assert noisy["own light, input views: PSNR (dB)"][7] == "none"
    worse = {row[2]: row for row in comparison(other, better).rows}
    assert worse["own light, input views: PSNR (dB)"][7] == "worse"
    (tmp_path / "evaluation.json").write_bytes(canonical_json(other))
    assert read_other(tmp_path) == other == read_other(tmp_path / "evaluation.json")
    with pytest.raises(InputError, match="no such file"):
        read_other(tmp_path / "nothing")
    with pytest.raises(InputError, match="same views"):
        comparison(better, other.model_copy(update={"scenes": ()}))


def test_failed_scenes_are_named_before_a_comparison_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    other = _run({"view-0": 20.0}, {})
    (tmp_path / "evaluation.json").write_bytes(canonical_json(other))
    failed = other.model_copy(update={"scenes": (), "failures": {"room": "no lamp"}})
    monkeypatch.setattr("model.evaluation.evaluate.evaluate", lambda *_: Evaluation(failed, {}))
    with pytest.raises(InputError, match="same views"):
        commands.evaluate(Path("small"), tmp_path / "out", compare=tmp_path, quiet=True)
    assert "scene room has no figures:\nno lamp" in capsys.readouterr().err
