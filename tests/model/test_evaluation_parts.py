# SPDX-License-Identifier: MIT
"""Suites, degraded meshes, figures of merit, lights and tables of the evaluation."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.formats.base import write_bytes_atomically
from datagen.formats.capture import Capture, CaptureGeometry, CaptureView, ColorImage, GeometryPart
from datagen.formats.lights import AreaLight
from datagen.foundation.bundled import bundled_library
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.errors import InputError
from datagen.foundation.exr import encode_view
from datagen.foundation.meshes.mesh import Mesh, joined
from model.evaluation.baselines import maps_files
from model.evaluation.charts import overview_svg, standalone
from model.evaluation.evaluate import judge
from model.evaluation.lpips import Lpips
from model.evaluation.mesh_errors import GeometryError, with_errors
from model.evaluation.metrics import common_exposure, image_figures, means, psnr_db, shown, ssim
from model.evaluation.opened_scene import OpenedScene
from model.evaluation.pictures import small
from model.evaluation.rendering import JudgedView
from model.evaluation.results import MethodResult, SceneResult, SuiteResult
from model.evaluation.room import TestScene
from model.evaluation.scenery import added_lights, level_place
from model.evaluation.suite import ModifiedLight, describe_suite, read_suite
from model.evaluation.tables import tables_of
from model.evaluation.writing import is_written, write_results
from tests.conftest import REPOSITORY
from tests.datagen.small_library import box

SMALL = REPOSITORY / "scenes" / "suites" / "small.yaml"
ROOM = bundled_library() / "environments" / "study"


# ---- suites


def test_all_faults_of_a_suite_are_reported_at_once(tmp_path: Path) -> None:
    text = SMALL.read_text().replace("small_room/room.xml", "nowhere/room.xml")
    text = text.replace("methods:", "methods:\n  - {name: li, kind: maps, folder: no-maps}")
    path = tmp_path / "suite.yaml"
    path.write_text(text + "inserted: {small-room: {package: no-thing}}\n")
    with pytest.raises(InputError) as caught:
        read_suite(path, tmp_path / "none.safetensors")
    assert {problem.field for problem in caught.value.problems} == {
        "scenes[0].source",
        "methods[0].folder",
        "inserted.small-room.package",
        "",
    }


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("kind: texture", "kind: textur", "methods"),
        ("atlas: 1024", "atlas: 5", "atlas"),
        ("{name: oracle, kind: oracle}", "{name: ours, kind: oracle}", "its own name"),
        ("input_views: 4", "input_views: 4\nviews: 3", "no such key"),
        ("input_views: 4", "input_views: 4\nmodified_light: {kitchen: {own_gain: 1}}", "kitchen"),
        ("kind: texture", "kind: truth, geometry: {noise_m: 0.1}", "no geometry"),
        ("resolution: [96, 64]", "resolution: [96, 15]", "16"),  # LPIPS needs 16 pixels, SSIM 11
        ("views: 12\n", "views: 12\n    may_know_shapes: true\n", "recipe"),
        ("views: 12\n", "views: 12\n    imports: [.]\n", "recipe"),
        ("room/room.xml", "room.yaml\n    unit_m: 2", "a Mitsuba file"),
        ("small_room/room.xml", f"{ROOM}\n    unit_m: 2", "a Mitsuba file"),
    ],
)
def test_bad_suites_are_refused(tmp_path: Path, old: str, new: str, expected: str) -> None:
    text = SMALL.read_text()
    assert old in text
    (tmp_path / "suite.yaml").write_text(text.replace(old, new))
    with pytest.raises(InputError, match=expected):
        read_suite(tmp_path / "suite.yaml")


def test_absent_ablation_is_announced(tmp_path: Path) -> None:
    text = SMALL.read_text().replace("kind: texture", "kind: network, checkpoint: none.safetensors")
    text = text.replace("small_room/", f"{SMALL.parent}/small_room/")
    (tmp_path / "suite.yaml").write_text(text)
    assert "missing: left out" in describe_suite(read_suite(tmp_path / "suite.yaml"))


def test_paper_suite_is_sound() -> None:
    scenes = (REPOSITORY / ".." / "shared" / "data" / "scenes").resolve()
    if not scenes.is_dir():
        pytest.skip(f"real test scenes not found at {scenes}, where the suite names them")
    suite = read_suite(SMALL.parent / "paper.yaml")
    assert [(s.name, s.views, s.resolution) for s in suite.scenes] == [
        ("veach-ajar", 160, (640, 384)),
        ("dining-room", 105, (640, 384)),
    ]
    assert not suite.may_be_known
    assert not read_suite(SMALL.parent / "reduced.yaml").may_be_known


def test_a_scene_has_its_own_quality_of_judged_views() -> None:
    suite = read_suite(SMALL)
    scene = suite.scenes[0]
    noisy = TestScene.model_validate({**scene.model_dump(), "judged": {"path_samples": 64}})
    assert suite.judging(scene) == suite
    assert suite.judging(noisy).truth == suite.judging(noisy).render == noisy.judged
    assert suite.judging(noisy).methods == suite.methods


# ---- meshes


@pytest.fixture
def geometry() -> CaptureGeometry:
    """A room of 4 x 3 x 2.5 m and a lamp."""
    meshes = [
        Mesh(np.asarray(b.vertices, np.float32), np.asarray(b.faces, np.int32))
        for b in (box((0, 0, 0), (4, 3, 2.5)), box((1.8, 1.3, 2.3), (2.2, 1.7, 2.4)))
    ]
    parts = (GeometryPart("room", 0, 12), GeometryPart("lamp", 12, 12, (1.0, 1.0, 1.0)))
    return CaptureGeometry(joined(meshes), parts)


def test_noise_has_its_size_and_keeps_lamps(geometry: CaptureGeometry) -> None:
    worse = with_errors(geometry, GeometryError(edge_m=0.2, noise_m=0.01))
    room = worse.mesh.faces[: worse.parts[0].num_faces]
    points = worse.mesh.positions[np.unique(room)].astype(np.float64)
    low, high = np.zeros(3), np.array([4, 3, 2.5])
    # only noise normal to the nearest wall moves a point off the box
    off = np.minimum(np.abs(points - low), np.abs(points - high)).min(axis=1)
    assert len(points) > 1000
    assert np.sqrt((off**2).mean()) == pytest.approx(0.01, rel=0.1)
    lamp = worse.parts[1]
    faces = worse.mesh.faces[lamp.first_face : lamp.first_face + lamp.num_faces]
    expected = geometry.mesh.triangles()[12:]
    np.testing.assert_array_equal(worse.mesh.positions[faces].astype(np.float64), expected)


def test_decimation_and_holes_remove_their_shares(geometry: CaptureGeometry) -> None:
    fine = with_errors(geometry, GeometryError(edge_m=0.1))
    coarse = with_errors(geometry, GeometryError(edge_m=0.1, noise_m=0.002, keep_share=0.25))
    assert coarse.parts[0].num_faces / fine.parts[0].num_faces == pytest.approx(0.25, abs=0.02)
    holed = with_errors(geometry, GeometryError(edge_m=0.1, hole_share=0.1, hole_radius_m=0.2))
    lost = 1 - holed.mesh.areas().sum() / fine.mesh.areas().sum()
    assert 0.09 < lost < 0.12
    assert holed.parts[1].num_faces == 12
    again = with_errors(geometry, GeometryError(edge_m=0.1, hole_share=0.1, hole_radius_m=0.2))
    np.testing.assert_array_equal(holed.mesh.faces, again.mesh.faces)


# ---- figures of merit


def _slow_ssim(a: NDArray, b: NDArray) -> float:
    """SSIM of Wang et al. 2004, pixel by pixel, where the window fits."""
    x = np.arange(-5, 6)
    window = np.exp(-(x[:, None] ** 2 + x[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for c in range(3):
        for i in range(5, a.shape[0] - 5):
            for j in range(5, a.shape[1] - 5):
                p, q = (image[i - 5 : i + 6, j - 5 : j + 6, c] for image in (a, b))
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * p * p).sum() - mp**2, (window * q * q).sum() - mq**2
                cov = (window * p * q).sum() - mp * mq
                top = (2 * mp * mq + 0.01**2) * (2 * cov + 0.03**2)
                values.append(top / ((mp**2 + mq**2 + 0.01**2) * (vp + vq + 0.03**2)))
    return float(np.mean(values))


def test_figures_follow_their_formulas() -> None:
    random = np.random.default_rng(3)
    a = random.random((18, 21, 3))
    b = np.clip(a + 0.1 * random.standard_normal(a.shape), 0, 1)
    assert psnr_db(a, a - 0.1) == pytest.approx(20.0)
    assert ssim(a, b) == pytest.approx(_slow_ssim(a, b), abs=1e-9)
    assert ssim(a, a) == pytest.approx(1.0) and psnr_db(a, a) == 99.0
    assert shown(np.array([0.0, 0.25, 9.0]), 2.0) == pytest.approx([0.0, 0.7354, 1.0], abs=1e-3)


def _view(value: float, mask: NDArray | None = None, color: float = 0.5) -> JudgedView:
    maps = {
        name: np.full((4, 5, channels), value, np.float32)
        for name, channels in (("diffuse_albedo", 3), ("specular_albedo", 3), ("roughness", 1))
    }
    surface = np.ones((4, 5), bool) if mask is None else mask
    return JudgedView(np.full((4, 5, 3), color, np.float32), maps, surface, np.zeros((4, 5), bool))


def test_exposure_is_common_and_set_by_surfaces() -> None:
    dark = np.zeros((4, 5), bool)
    dark[1:] = True
    view = _view(0.5, dark, 0.3)
    view.color[0] = 1e6  # a lamp
    assert common_exposure([view, _view(0.5, None, 0.3)]) == pytest.approx(3.0, rel=1e-4)


def test_a_gain_compensates_dimming() -> None:
    random = np.random.default_rng(5)
    color = random.uniform(0.1, 0.4, (16, 20, 3)).astype(np.float32)
    maps, mask = _view(0.5).maps, np.ones((16, 20), bool)
    truth = {"a": JudgedView(color, maps, mask, ~mask), "b": JudgedView(color[::-1], maps, mask, ~mask)}
    dim = {name: JudgedView(0.25 * view.color, maps, mask, ~mask) for name, view in truth.items()}
    lpips = Lpips()
    lpips.absence = "not asked for"
    figures = means(image_figures(dim, truth, 1.0, lpips))
    assert figures["gain"] == pytest.approx(4.0, rel=1e-5)
    assert figures["psnr_gain_db"] == pytest.approx(99.0)
    assert figures["dssim_gain"] == pytest.approx(0.0, abs=1e-9)
    assert figures["psnr_srgb_db"] is not None and figures["psnr_srgb_db"] < 20
    assert figures["lpips_vgg"] is None


# ---- scenery


def _camera() -> Camera:
    return Camera(
        96, 64, 60.0, 60.0, 48.0, 32.0, look_at(np.array([2.0, 0.3, 1.6]), np.array([2.0, 2.5, 0.3]))
    )


def test_inserted_objects_are_on_level_ground_in_view() -> None:
    camera = _camera()
    rays = camera.ray_directions()
    t = np.where(rays[..., 2] < -1e-3, -camera.position_m[2] / np.minimum(rays[..., 2], -1e-3), 0.0)
    depth = (t * (rays @ camera.forward))[..., None]
    normal = np.where(depth > 0, np.array([0.0, 0.0, 1.0]), 0.0)
    place = level_place(camera, depth, normal, 0.8)
    assert place is not None and abs(place.position_m[2]) < 1e-6
    foot, top = (camera.camera_from_world @ np.array([*place.position_m[:2], z, 1.0]) for z in (0.0, 0.8))
    rows = [60.0 * p[1] / p[2] + 32.0 for p in (foot, top)]
    assert 0 < rows[1] < rows[0] < 64 and rows[0] - rows[1] == pytest.approx(0.35 * 64, rel=0.35)
    assert level_place(camera, depth, np.zeros_like(normal), 0.3) is None


def test_ceiling_light_is_below_the_ceiling_and_emits_downwards(geometry: CaptureGeometry) -> None:
    (light,) = added_lights(ModifiedLight(), geometry, [_camera()])
    assert isinstance(light, AreaLight) and not light.is_visible
    assert light.origin_m[2] == pytest.approx(2.4) and light.origin_m[0] == pytest.approx(1.7)
    assert np.cross(light.edge_u_m, light.edge_v_m)[2] < 0


# ---- maps of other methods


class _NoImage:
    def read(self, camera: Camera) -> ColorImage:
        raise AssertionError("not needed")

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        return {}


def test_all_faults_of_given_maps_are_reported_at_once(geometry: CaptureGeometry, tmp_path: Path) -> None:
    views = tuple(CaptureView(f"view-{k:03d}", _camera(), _NoImage()) for k in range(5))
    capture = Capture("room", views, geometry)

    def write(name: str, size: tuple[int, int], value: float) -> None:
        maps = {n: np.full((*size, c), 0.5, np.float32) for n, c in (("diffuse_albedo", 3), ("roughness", 1))}
        maps["specular_albedo"] = np.full((*size, 3), value, np.float32)
        write_bytes_atomically(tmp_path / f"{name}.exr", encode_view(maps))

    write("view-000", (64, 96), 0.04)
    write("view-001", (32, 48), 0.04)
    write("view-002", (64, 96), 1.5)
    (tmp_path / "view-003.exr").write_bytes(b"no image")
    with pytest.raises(InputError) as caught:
        maps_files(tmp_path, capture)
    messages = "\n".join(str(problem) for problem in caught.value.problems)
    assert "view-000" not in messages
    for expected in ("view-001.exr", "48 x 32", "view-002.exr", "1.5", "view-003.exr", "view-004"):
        assert expected in messages


# ---- cached results


def test_a_moved_cache_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results name folders in the new place; a method whose renderings were removed is measured again."""
    suite, measured = read_suite(SMALL), []

    def measure(*arguments: object) -> dict[str, object]:
        rendering = arguments[1].root / "renders" / "key"  # type: ignore[attr-defined]
        rendering.mkdir(parents=True)
        measured.append(rendering)
        return {"renders": {"own": str(rendering)}}

    def found_in(root: Path) -> MethodResult:
        scene = OpenedScene(suite.scenes[0], None, root, None, ("view-000",), (), {})  # type: ignore[arg-type]
        return judge(suite, scene, suite.methods[2], None, lpips, lambda *_: None)

    monkeypatch.setattr("model.evaluation.evaluate.measure", measure)
    lpips = Lpips(tmp_path, layers=[])
    first = found_in(tmp_path / "old")
    (tmp_path / "old").rename(tmp_path / "new")
    moved = found_in(tmp_path / "new")
    folders = {"own": str(tmp_path / "new" / "renders" / "key")}
    assert moved == first.model_copy(
        update={"folder": first.folder.replace("/old/", "/new/"), "renders": folders}
    )
    assert len(measured) == 1
    Path(folders["own"]).rmdir()
    found_in(tmp_path / "new")
    assert len(measured) == 2


# ---- tables


def _result() -> SuiteResult:
    maps = {"diffuse_albedo": 0.02, "specular_albedo": 0.01, "roughness": 0.05}
    figures = {"psnr_srgb_db": 20.0, "psnr_linear_db": 18.0, "ssim": 0.75, "dssim": 0.25, "lpips_vgg": None}
    method = MethodResult(
        scene="veach-ajar",
        method="ours",
        kind="network",
        geometry="noise 10 mm",
        maps_per_view=maps,
        maps_merged=maps,
        images={"own": {"input": figures, "novel": figures}},
        covered_share=1.0,
        seen_share=0.5,
        seconds={"merge": 3.0, "lights": 2.0, "render and compare": 60.0},
    )
    absent = MethodResult(scene="veach-ajar", method="no-rp", kind="network", skipped="no checkpoint at x")
    scene = SceneResult(
        name="veach-ajar",
        num_views=16,
        num_novel=1,
        resolution=(5, 4),
        judged_views=("view-000",),
        novel_views=("path-000",),
        exposures={"own": 1.0},
        figure_views={"input": "view-000"},
        path_samples=8,
        renders={},
        methods=(method, absent),
    )
    return SuiteResult(suite="s", may_be_known=True, lpips_absence="no weights", scenes=(scene,))


def test_tables_contain_the_papers_figures(tmp_path: Path) -> None:
    tables = {table.name: table for table in tables_of(_result())}
    maps, summary, images, cost = (tables[name] for name in ("maps", "rerendering", "images", "cost"))
    rows = {row[1]: row for row in maps.rows}
    assert rows["paper: Ours"][5:8] == (0.022135, 0.016522, 0.055563)
    assert rows["paper: Ours Im."][2:5] == (0.030718, 0.049969, 0.064362)
    assert rows["ours (noise 10 mm)"][2:8] == (0.02, 0.01, 0.05) * 2
    assert {row[1]: row[2:4] for row in summary.rows}["paper: Texture"] == (18.70, 0.30)
    assert "no weights" in images.caption and images.rows[0][8] is None
    totals = {row[1]: row[-4] for row in cost.rows}
    assert totals == pytest.approx({"ours (noise 10 mm)": 5.0, "paper: Ours": 60 * 20.85})
    write_results(_result(), {"veach-ajar": {"view-000": _view(0.5)}}, tmp_path)
    text = (tmp_path / "evaluation.md").read_text()
    assert "left out, no checkpoint at x" in text and "may have been trained" in text


def test_files_of_an_earlier_result_are_replaced(tmp_path: Path) -> None:
    scenes = {"veach-ajar": {"view-000": _view(0.5)}}
    result = _result()
    scene = result.scenes[0]
    taken = scene.methods[0].model_copy(update={"camera": "phone"})
    with_cameras = scene.model_copy(update={"methods": (*scene.methods, taken)})
    write_results(result.model_copy(update={"scenes": (with_cameras,)}), scenes, tmp_path)
    assert (tmp_path / "cameras.csv").is_file()
    own = [tmp_path / "notes.csv", tmp_path / "figures" / "plan.png"]
    for path in own:
        path.write_text("mine")
    write_results(result, scenes, tmp_path)
    assert not (tmp_path / "cameras.csv").exists() and all(path.read_text() == "mine" for path in own)
    assert is_written(result, tmp_path)
    (tmp_path / "index.html").unlink()
    assert not is_written(result, tmp_path)


def test_an_unknown_error_is_an_empty_cell(tmp_path: Path) -> None:
    result = _result()
    method = (
        result.scenes[0]
        .methods[0]
        .model_copy(update={"image_views": {"own": {"novel": {"path-000": {"psnr_srgb_db": 20.0}}}}})
    )
    scene = result.scenes[0].model_copy(update={"methods": (method,)})
    (noise,) = (t for t in tables_of(result.model_copy(update={"scenes": (scene,)})) if t.name == "noise")
    assert noise.texts()[0][4:] == ["20.00", "", "0.00", ""]
    assert noise.csv().splitlines()[1].endswith("novel,20.0,,0.0,")


def test_a_long_view_keeps_a_row_in_pictures() -> None:
    assert small(np.zeros((16, 16384, 3))).shape == (1, 320, 3)


def test_chart_has_a_block_for_each_camera() -> None:
    """A method has one colour for all cameras; the truth, without camera faults, is in the first block."""
    result = _result()
    (scene,) = result.scenes[:1]
    method = scene.methods[0]
    truth = method.model_copy(update={"method": "truth", "kind": "truth"})
    labels = [method.label, truth.label]
    methods = (method, truth, method.model_copy(update={"camera": "phone"}))
    scene = scene.model_copy(update={"methods": methods})
    assert [(c, len(s.methods)) for c, s in scene.by_camera()] == [("", 2), ("phone", 1)]
    root = ElementTree.fromstring(standalone(overview_svg(result.model_copy(update={"scenes": (scene,)}))))
    texts = [text.text for text in root.findall(".//{*}text")]
    assert texts.count(scene.name) == 2 and "phone" in texts
    assert [t for t in texts if t in labels] == labels
    marks = [(float(c.get("cy", 0)), c.get("stroke")) for c in root.findall(".//{*}circle")][2:]
    height = {color: {y for y, c in marks if c == color} for _, color in marks}
    assert [len(y) for y in height.values()] == [2, 1]


def test_chart_of_methods_has_their_figures() -> None:
    """Panels begin at x = 104, 288, 472 (maps, 1e-4 to 1) and 656 (10 to 45 dB), and are 148 wide."""
    views = {"path-000": {"psnr_srgb_db": 27.5}, "path-001": {"psnr_srgb_db": 27.5}}
    result = _result()
    method = result.scenes[0].methods[0].model_copy(update={"image_views": {"own": {"novel": views}}})
    scene = result.scenes[0].model_copy(update={"methods": (method,)})
    root = ElementTree.fromstring(standalone(overview_svg(result.model_copy(update={"scenes": (scene,)}))))
    circles = [(float(c.get("cx", 0)), c.get("fill")) for c in root.findall(".//{*}circle")][1:]
    at = [104 + 148 * (np.log10(0.02) + 4) / 4, 288 + 148 * 0.5, 472 + 148 * (np.log10(0.05) + 4) / 4, 730]
    assert [x for x, _ in circles] == pytest.approx(at, abs=0.06)
    assert [fill == "none" for _, fill in circles] == [False, False, False, True]
