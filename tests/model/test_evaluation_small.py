# SPDX-License-Identifier: MIT
"""The small suite from photographs to tables: rendered, reconstructed, evaluated, not repeated."""

from __future__ import annotations

import csv
import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datagen.formats.recipe import RenderRecipe
from datagen.rendering.view_job import ViewJob
from model.checkpoint import DataRecord, bundled_checkpoint, read_card
from model.evaluation.evaluate import Evaluation, evaluate
from model.evaluation.noise import bootstrap_error
from model.evaluation.results import MethodResult
from model.evaluation.room import plan_scene
from model.evaluation.suite import MapsMethod, NetworkMethod, Suite, TruthMethod, read_suite
from model.evaluation.tables import tables_of
from model.evaluation.writing import is_written, write_results
from model.reconstruction.light.options import LightOptions
from model.reconstruction.predict.predictor import Predictor
from tests.conftest import REPOSITORY

SMALL = REPOSITORY / "scenes" / "suites" / "small.yaml"
FEW_RAYS = partial(
    LightOptions,
    irradiance_rays=36,
    second_irradiance_rays=128,
    estimate_rays=16,
    solve_rays=6,
    specular_rays=3,
)
"""Options of the light stage with few rays, whose noise does not change the order of the methods."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("evaluation-cache")


@pytest.fixture(scope="module")
def small(cache: Path) -> tuple[Suite, Evaluation]:
    suite = read_suite(SMALL).model_copy(update={"atlas": 512})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("model.reconstruction.light.map_stage.LightOptions", FEW_RAYS)
        return suite, evaluate(suite, cache)


def _methods(evaluation: Evaluation) -> dict[str, MethodResult]:
    return {method.method: method for method in evaluation.result.scenes[0].methods}


def _times(cache: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in cache.rglob("*") if path.is_file()}


def test_figures_are_in_a_plausible_order(small: tuple[Suite, Evaluation]) -> None:
    methods = _methods(small[1])
    oracle, ours, constant = (methods[name] for name in ("oracle", "ours", "constant"))
    for light in ("own", "modified"):
        for views in ("input", "novel"):
            psnr, dssim = (
                [m.images[light][views][key] for m in (oracle, ours, constant)]
                for key in ("psnr_srgb_db", "dssim")
            )
            assert psnr == sorted(psnr, reverse=True), (light, views, psnr)
            assert dssim == sorted(dssim), (light, views, dssim)
            assert psnr[0] > psnr[1] + 5  # the true maps are far better than any estimate
    # no photograph shows the lamp, but its radiance is estimated
    assert [name for name, m in methods.items() if "recovered" in m.images] == ["ours"]
    merged = [m.maps_merged["diffuse_albedo"] for m in (oracle, ours, constant)]
    assert merged == sorted(merged)
    assert set(oracle.maps_per_view.values()) == {0.0}
    for method in methods.values():
        assert method.covered_share == pytest.approx(1.0, abs=0.01)
        assert method.peak_memory_mb > 100 and method.seconds["merge"] > 0
        assert not any(method.seed_spread.values())  # without seed_views, nothing is rendered twice


def test_results_are_written_and_self_contained(small: tuple[Suite, Evaluation], tmp_path: Path) -> None:
    evaluation = small[1]
    write_results(evaluation.result, evaluation.truth, tmp_path)
    assert is_written(evaluation.result, tmp_path)
    with (tmp_path / "rerendering.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    shown = {row["method"]: float(row["own light, input views: PSNR sRGB (dB)"]) for row in rows}
    for name, method in _methods(evaluation).items():
        assert shown[name] == method.images["own"]["input"]["psnr_srgb_db"]
    with (tmp_path / "kinds.csv").open(newline="") as file:
        kinds = {(row["method"], row["surfaces"]): row for row in csv.DictReader(file)}
    metal = [float(kinds[name, "metal"]["S (RMSE)"]) for name in ("oracle", "constant")]
    assert metal[0] < 0.1 < 0.3 < metal[1]  # copper, while the constant method predicts a small S
    assert float(kinds["ours", "glossy"]["of all (%)"]) + float(kinds["ours", "matt"]["of all (%)"]) < 100
    with (tmp_path / "noise.csv").open(newline="") as file:
        noise = [row for row in csv.DictReader(file) if row["method"] == "ours"]
    own = [row["psnr_srgb_db"] for row in _methods(evaluation)["ours"].image_views["own"]["input"].values()]
    assert float(noise[0]["by views"]) == pytest.approx(bootstrap_error(own)) and len(noise) == 6
    with (tmp_path / "others.csv").open(newline="") as file:
        others = {row["method"]: row for row in csv.DictReader(file)}
    assert float(others["oracle"]["a' (dB)"]) > 25 > float(others["constant"]["a' (dB)"])
    assert others["paper: IRIS"]["kd where rough (dB)"] == "22.3"
    markdown = (tmp_path / "evaluation.md").read_text()
    for header in ("DSSIM = 1-SSIM", "PSNR, clipped sRGB, range 1 (dB)", "D merged (MSE, linear)"):
        assert header in markdown
    assert json.loads((tmp_path / "evaluation.json").read_text())["suite"] == "small"
    page = (tmp_path / "index.html").read_text()
    # with the colon: letters alone may occur in base64 images
    assert "http:" not in page and "https:" not in page and "<script src" not in page and "<link" not in page
    sliders, errors = 4 * 2 * 2, 5 * 3 + 1  # per method two pairs; per method and truth three maps; the scale
    pictures = 5 * 8 + 2  # of ours and the truth also for recovered light
    assert page.count("data:image/jpeg;base64,") == pictures + sliders + errors
    assert "±" in page and page.count('class="pair"') == 8
    assert page.count('<svg viewBox="0 0 430') == 3 and ">metal<" in page
    with Image.open(tmp_path / "figures" / "small-room-relighting.png") as image:
        assert image.width > 5 * 96 and image.height > 4 * 64


def test_finished_suite_is_not_repeated(small: tuple[Suite, Evaluation], cache: Path) -> None:
    suite, evaluation = small
    before = _times(cache / _scene_folder(cache) / "results")
    assert evaluate(suite, cache).result == evaluation.result
    assert _times(cache / _scene_folder(cache) / "results") == before


def test_stopped_suite_continues(small: tuple[Suite, Evaluation], cache: Path) -> None:
    """If a method's figures and one view are missing, only that view is rendered again, identically."""
    suite, evaluation = small
    constant = _methods(evaluation)["constant"]
    (result,) = Path(constant.folder).glob("result-*.json")
    result.unlink()
    lost = sorted(Path(constant.renders["own"]).glob("*.exr"))[0]
    content = lost.read_bytes()
    lost.unlink()
    before = _times(cache / _scene_folder(cache) / "results" / "renders")
    again = _methods(evaluate(suite, cache))["constant"]
    assert again.images == constant.images and again.maps_merged == constant.maps_merged
    assert lost.read_bytes() == content
    after = _times(cache / _scene_folder(cache) / "results" / "renders")
    assert {path for path in after if after[path] != before.get(path)} == {str(lost)}


def test_inserted_object_is_in_every_picture(small: tuple[Suite, Evaluation]) -> None:
    from datagen.foundation.exr import decode_view

    scene = small[1].result.scenes[0]
    name = scene.figure_views["input"]
    for method in _methods(small[1]).values():
        with_it, without = (
            decode_view(Path(method.renders[light]) / f"{name}.exr", ("depth_z_m",))["depth_z_m"]
            for light in ("inserted", "own")
        )
        nearer = (without.astype(np.float32) - with_it.astype(np.float32)) > 0.02
        assert nearer.mean() > 0.005, method.method


def test_maps_of_another_method_are_evaluated_like_ours(
    small: tuple[Suite, Evaluation], cache: Path, tmp_path: Path
) -> None:
    suite, _ = small
    plain = NetworkMethod(
        name="network",
        kind="network",
        checkpoint=str(bundled_checkpoint()),
        is_leveled=False,
        materials="network",
    )
    network = _methods(evaluate(suite.model_copy(update={"methods": (plain,)}), cache))["network"]
    target = tmp_path / "maps" / "small-room"
    shutil.copytree(Path(network.folder) / "views", target)
    other = MapsMethod(name="other", kind="maps", folder=tmp_path / "maps")
    judged = _methods(evaluate(suite.model_copy(update={"methods": (other,)}), cache))["other"]
    assert judged.maps_per_view == network.maps_per_view
    assert judged.maps_merged == pytest.approx(network.maps_merged, rel=1e-6)
    lost = sorted(target.iterdir())[0]
    lost.unlink()
    faulty = evaluate(suite.model_copy(update={"methods": (other,)}), cache)
    assert lost.stem in faulty.result.failures["small-room"] and not faulty.result.scenes


def test_cameras_and_seeds_reach_the_results(small: tuple[Suite, Evaluation], cache: Path) -> None:
    """Reconstructed texture differs between phone and rendered photographs. The truth is evaluated once and
    rendered separately from the photographs. A second seed yields the uncertainty of the figures."""
    suite, evaluation = small
    methods = tuple(method for method in suite.methods if method.kind == "texture")
    changes = {
        "methods": (*methods, TruthMethod(name="truth", kind="truth")),
        "camera": ("phone",),
        "truth": suite.render,
        "seed_views": 1,
    }
    (scene,) = evaluate(suite.model_copy(update=changes), cache).result.scenes
    assert [method.label for method in scene.methods] == ["texture", "truth", "texture (phone)"]
    plain, truth, phone = scene.methods
    assert plain.maps_merged == pytest.approx(_methods(evaluation)["texture"].maps_merged, rel=0.05)
    assert phone.maps_merged != pytest.approx(plain.maps_merged, rel=1e-3)
    assert phone.maps_per_view != pytest.approx(plain.maps_per_view, rel=1e-3)
    assert Path(phone.folder).name.startswith("texture-phone-")
    assert "own" in scene.renders
    assert truth.images["own"]["input"]["psnr_srgb_db"] > plain.images["own"]["input"]["psnr_srgb_db"] + 5
    assert 0 < truth.seed_spread["own"]["psnr_srgb_db"] < 5
    tables = tables_of(evaluation.result.model_copy(update={"scenes": (scene,)}))
    assert [row[:3] for table in tables if table.name == "cameras" for row in table.rows] == [
        ("small-room", "texture", "as rendered"),
        ("small-room", "texture", "phone"),
    ]


def test_methods_of_one_checkpoint_share_its_predictions(
    small: tuple[Suite, Evaluation], cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Methods of one checkpoint share its predictions even if only one of them uses materials from light."""
    suite, evaluation = small

    def refuse(*_: object) -> None:
        raise AssertionError("predicted twice")

    monkeypatch.setattr(Predictor, "predict", refuse)
    other = NetworkMethod(
        name="network", kind="network", checkpoint=str(bundled_checkpoint()), materials="network"
    )
    judged = _methods(evaluate(suite.model_copy(update={"methods": (other,)}), cache))["network"]
    ours = _methods(evaluation)["ours"]
    assert judged.maps_per_view == ours.maps_per_view
    views = [Path(method.folder) / "views" / "view-003.exr" for method in (judged, ours)]
    assert views[0].samefile(views[1])


def test_estimates_need_fewer_samples_than_the_truth(
    small: tuple[Suite, Evaluation], cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rendering of poor estimates stops at noise of a small share of their error; PSNR is within 0.3 dB."""
    suite, _ = small
    passes: list[int] = []
    add_pass = ViewJob.add_pass

    def counted(job: ViewJob, counts: Any) -> None:
        passes.append(job.index)
        add_pass(job, counts)

    monkeypatch.setattr(ViewJob, "add_pass", counted)
    constant = tuple(method for method in suite.methods if method.kind == "constant")
    render = RenderRecipe(max_rel_mse=2e-4, max_path_samples=64, auxiliary_samples=16)
    changes = {"methods": constant, "render": render, "truth": render, "input_views": 2, "novel_views": 1}
    evaluate(suite.model_copy(update={**changes, "noise_share": 0.5}), cache)  # renders the truth
    figures, needed = [], []
    for share in (None, 0.05):
        passes.clear()
        changed = suite.model_copy(update={**changes, "noise_share": share})
        (scene,) = evaluate(changed, cache).result.scenes
        figures.append(scene.methods[0].images)
        needed.append(len(passes))
    assert needed[1] <= needed[0] / 2 and needed[1] >= 7  # views of both lights and of the inserted object
    for light in ("own", "modified"):
        for views in ("input", "novel"):
            full, early = (images[light][views]["psnr_srgb_db"] for images in figures)
            assert early == pytest.approx(full, abs=0.3), (light, views)


def test_a_failed_scene_does_not_stop_the_others(
    small: tuple[Suite, Evaluation], cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scene that a checkpoint was trained on and one that cannot be imported are reported before anything
    is rendered; the third is evaluated."""
    suite, evaluation = small
    whole = suite.scenes[0]
    shutil.copytree(Path(whole.source).parent, tmp_path / "kitchen")
    room = tmp_path / "kitchen" / "room.xml"
    room.write_text(room.read_text().replace('value="0.62 0.60 0.54"', 'value="0.6 0.6 0.5"'))
    known = whole.model_copy(update={"name": "kitchen", "source": room})
    broken = whole.model_copy(update={"name": "broken", "source": tmp_path / "absent.xml"})
    inserted = dict.fromkeys(("kitchen", "broken", whole.name), suite.inserted[whole.name])
    three = suite.model_copy(update={"scenes": (known, broken, whole), "inserted": inserted})
    sha = plan_scene(known, tmp_path / "other").asset_sha256["kitchen"]
    record = DataRecord(name="data", index_sha256="0", num_views=10, assets={"other-name": sha})
    card = read_card(bundled_checkpoint()).model_copy(update={"data": (record,)})
    monkeypatch.setattr("model.evaluation.evaluate.read_card", lambda _: card)
    stages: list[str] = []
    found = evaluate(three, cache, lambda stage, done, total: stages.append(stage)).result
    assert "trained on other-name" in found.failures["kitchen"]
    assert "absent.xml" in found.failures["broken"]
    (scene,) = found.scenes
    assert scene.name == "small-room"
    for mine, before in zip(scene.methods, evaluation.result.scenes[0].methods, strict=True):
        assert (mine.images, mine.maps_merged) == (before.images, before.maps_merged)
    assert stages[:3] == ["kitchen: plan", "broken: plan", "small-room: plan"]
    assert not any("kitchen" in stage for stage in stages[3:])
    write_results(found, evaluation.truth, tmp_path / "out")
    text = (tmp_path / "out" / "evaluation.md").read_text()
    assert "kitchen: no figures" in text and "| small-room | ours |" in text
    shutil.rmtree(next(cache.glob("kitchen-*")))


def _scene_folder(cache: Path) -> str:
    (folder,) = (path.name for path in cache.glob("small-room-*"))
    return folder
