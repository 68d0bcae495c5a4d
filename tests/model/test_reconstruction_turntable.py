# SPDX-License-Identifier: MIT
"""Turntable animations of an asset, with lamps, and under a sky that does not reach it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

from datagen.formats.lights import PointLight
from datagen.formats.package import open_package, write_package
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import linear_from_srgb, photographic_exposure
from datagen.foundation.errors import InputError
from datagen.foundation.images import read_image, shown_bytes
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.predict.sources import TRUTH
from model.reconstruction.render.relight import Lamp, RelightOptions, render_asset, write_renders
from model.reconstruction.render.turntable import TurntableOptions, way_cameras, write_turntable
from oracles.textured_room import room_cameras, room_capture
from tests.model.test_reconstruction_robustness import small_files

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
LAMP = PointLight(name="lamp", position_m=(2.1, 1.4, 2.2), intensity=(5.0, 5.0, 4.0))
QUICK = RelightOptions(samples=2)


@pytest.fixture(scope="module")
def asset(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> Path:
    """A closed room with a lamp."""
    out = tmp_path_factory.mktemp("asset") / "out"
    capture = replace(room_capture(6, (48, 36)), lights=(LAMP,))
    infer(capture, out, TRUTH, InferOptions(atlas=64, has_exr=False, is_checked=False))
    return out / "asset"


def angles_about(cameras: list[Camera], center: NDArray) -> NDArray:
    """Unwrapped azimuths of the camera positions about ``center``, in turns."""
    away = np.array([c.position_m for c in cameras])[:, :2] - center
    return np.unwrap(np.arctan2(away[:, 1], away[:, 0])) / (2 * np.pi)


def test_orbit_is_one_turn_within_the_cameras() -> None:
    """Uniform steps end one short of a whole turn; views face inwards if the cameras do, else outwards."""
    cameras = room_cameras(8)
    made = way_cameras(cameras, TurntableOptions(frames=24))
    eyes = np.array([c.position_m for c in cameras])
    found = np.array([c.position_m for c in made])
    assert (found.min(axis=0) >= eyes.min(axis=0) - 1e-9).all()
    assert (found.max(axis=0) <= eyes.max(axis=0) + 1e-9).all()
    turns = angles_about(made, found[:, :2].mean(axis=0))
    assert turns[-1] - turns[0] == pytest.approx(23 / 24, abs=0.02)
    inward = [((found.mean(axis=0) - c.position_m) * c.forward)[:2].sum() > 0 for c in made]
    assert all(inward)
    around = [
        replace(c, world_from_camera=look_at(c.position_m, 2 * c.position_m - [2, 1.5, 1.7])) for c in cameras
    ]
    outward = way_cameras(around, TurntableOptions(frames=24))
    assert all(((found.mean(axis=0) - c.position_m) * c.forward)[:2].sum() < 0 for c in outward)
    (alone,) = {
        tuple(np.round(c.position_m[2], 6) for c in way_cameras(cameras[:1], TurntableOptions(frames=4)))
    }
    assert len(set(alone)) == 1  # one camera: a small level circle


def test_path_visits_the_cameras_and_is_closed() -> None:
    cameras = room_cameras(6)
    made = way_cameras(cameras, TurntableOptions(way="cameras", frames=24, max_width_px=40))
    for k, camera in enumerate(cameras):
        np.testing.assert_allclose(made[4 * k].position_m, camera.position_m, atol=1e-9)
        np.testing.assert_allclose(made[4 * k].forward, camera.forward, atol=1e-9)
    steps = np.linalg.norm(np.diff([c.position_m for c in [*made, made[0]]], axis=0), axis=1)
    assert steps.max() < 3 * np.median(steps)  # no jump, not even at the seam
    assert {(c.width_px, c.height_px) for c in made} == {(40, 30)}
    odd = way_cameras(cameras, TurntableOptions(frames=2, max_width_px=43))
    assert odd[0].width_px == 42  # even, and at most 43


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_files_contain_the_frames(asset: Path, tmp_path: Path, suffix: str) -> None:
    """All frames exist, in order, and match renderings from their cameras."""
    out = tmp_path / "new" / f"room{suffix}"
    steps: list[tuple[int, int]] = []
    options = TurntableOptions(frames=4, frames_per_second=10, max_width_px=48, render=QUICK)
    cameras = write_turntable(asset, out, options, lambda stage, done, total: steps.append((done, total)))
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    frames = read_frames(out)
    assert len(frames) == 4 and frames[0].shape == (36, 48, 3)
    rendered = [i.color for i in render_asset(asset, replace(QUICK, cameras=tuple(cameras)))]
    exposure = photographic_exposure(rendered[0])
    same = [[correlation(f, shown_bytes(r, exposure)) for r in rendered] for f in frames]
    assert (np.argmax(same, axis=1) == np.arange(4)).all() and np.min(np.diag(same)) > 0.95, same


def test_a_colon_in_a_relative_name_is_no_protocol(
    asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    options = TurntableOptions(frames=2, frames_per_second=10, max_width_px=16, render=QUICK)
    write_turntable(asset, Path("room:1.mp4"), options)
    assert len(read_frames(tmp_path / "room:1.mp4")) == 2


def read_frames(path: Path) -> list[NDArray]:
    if path.suffix == ".gif":
        with Image.open(path) as image:
            assert image.info["duration"] == 100 and image.info["loop"] == 0
            found = []
            for k in range(image.n_frames):
                image.seek(k)
                found.append(np.asarray(image.convert("RGB")))
            return found
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    found = []
    while (read := video.read())[0]:
        found.append(read[1][..., ::-1])
    return found


def correlation(a: NDArray, b: NDArray) -> float:
    """Correlation of slightly blurred images, because a GIF's colours are dithered."""
    x, y = (cv2.GaussianBlur(np.ascontiguousarray(i, np.float32), (0, 0), 1.0).ravel() for i in (a, b))
    return float(np.corrcoef(x, y)[0, 1])


def test_lamps_replace_the_lights(asset: Path) -> None:
    """Twice the intensity gives twice the light; two lamps give the sum."""

    def mean(*lamps: Lamp) -> float:
        options = RelightOptions(samples=64, views=("view_00",), denoise=False, lamps=lamps)
        return float(next(iter(render_asset(asset, options))).color.mean())

    a, b = Lamp((1.0, 0.6, 2.0), (1.0, 1.0, 1.0)), Lamp((3.0, 2.4, 2.0), (1.0, 1.0, 1.0))
    assert mean(replace(a, intensity=(2.0, 2.0, 2.0))) == pytest.approx(2 * mean(a), rel=1e-4)
    assert mean(a, b) == pytest.approx(mean(a) + mean(b), rel=0.05)


def brightness(path: Path) -> float:
    return float(read_image(path)[..., :3].mean())


def test_a_closed_room_under_a_sky_keeps_its_lights(asset: Path, tmp_path: Path) -> None:
    warnings: list[str] = []
    sky = RelightOptions(samples=4, views=("view_00",), sky=(1.0, 1.0, 1.0))
    write_renders(asset, tmp_path / "sky", sky, warnings.append)
    (warning,) = warnings
    assert warning == "no light from the sky reaches view_00: the room is closed; its own lights are used"
    write_renders(asset, tmp_path / "own", replace(sky, sky=None), warnings.append)
    write_renders(asset, tmp_path / "lamp", replace(sky, lamps=(Lamp((2.0, 1.5, 2.0)),)), warnings.append)
    assert len(warnings) == 1
    own, under_sky = (brightness(tmp_path / name / "view_00.exr") for name in ("own", "sky"))
    assert under_sky == pytest.approx(own, rel=0.01) and own > 0.01


def test_a_grey_sky_is_one_and_a_faulty_one_is_named(asset: Path, tmp_path: Path) -> None:
    """An image of one channel is a valid sky; the message about an invalid image names the given file."""
    sky, warnings = tmp_path / "sky.exr", list[str]()
    for value in (1.0, np.nan):
        pixels = np.full((8, 16), value, np.float32)
        with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": pixels}) as file:
            file.write(str(sky))
        options = replace(QUICK, views=("view_00",), sky=sky)
        if np.isnan(value):
            with pytest.raises(InputError, match=f"{sky}: NaN, Inf or negative values"):
                write_renders(asset, tmp_path / "renders", options)
        else:
            write_renders(asset, tmp_path / "renders", options, warnings.append)
    assert len(warnings) == 1 and "no light from the sky" in warnings[0]


@pytest.mark.parametrize("sky", [None, (1.0, 1.0, 1.0)])
def test_a_room_without_light_gets_a_lamp(
    asset: Path, sky: tuple[float, float, float] | None, tmp_path: Path
) -> None:
    with open_package(asset) as package:
        files = {name: package.read_bytes(name) for name in package.names() if name != "asset.json"}
        dark = package.asset.model_copy(update={"lights": ()})
        write_package(tmp_path / "dark", dark, files)
    warnings: list[str] = []
    options = RelightOptions(samples=4, views=("view_00",), sky=sky)
    write_renders(tmp_path / "dark", tmp_path / "renders", options, warnings.append)
    assert brightness(tmp_path / "renders" / "view_00.exr") > 0.01
    assert len(warnings) == 1 and "a lamp in the middle of its cameras is used" in warnings[0]


def test_zips_are_closed_and_descriptions_accepted(
    asset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unpacked files of a zip are removed; a package may be given by the path of its ``asset.json``."""
    with open_package(asset) as package:
        files = {name: package.read_bytes(name) for name in package.names()}
        write_package(tmp_path / "room.zip", package.asset, files).close()
    (tmp_path / "unpacked").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "unpacked"))
    options = replace(QUICK, views=("view_00",))
    (zipped,) = render_asset(tmp_path / "room.zip", options)
    assert not list((tmp_path / "unpacked").iterdir())
    (described,) = render_asset(asset / "asset.json", options)
    np.testing.assert_array_equal(zipped.color, described.color)


def test_a_full_disk_is_named_and_leaves_no_part_of_an_image(asset: Path, tmp_path: Path) -> None:
    options = replace(QUICK, views=("view_00",))
    with small_files(2000), pytest.raises(OSError, match="File too large") as caught:
        write_renders(asset, tmp_path, options)
    assert caught.value.filename == str(tmp_path / "view_00.exr")
    assert not list(tmp_path.iterdir())


def test_lamp_colour_and_exposure_compensation_are_applied(asset: Path, tmp_path: Path) -> None:
    """One stop less halves the light in the PNG but not in the EXR; the intensity's colour tints both."""
    from model.cli import app

    words = [
        "render",
        str(asset),
        "--lamp",
        "2,1.5,2,4,2,1",
        "--samples",
        "4",
        "--view",
        "view_00",
        "--quiet",
    ]
    for name, stops in (("plain", "0"), ("darker", "-1")):
        done = CliRunner().invoke(app, [*words, "--stops", stops, "--out", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
    assert (tmp_path / "plain/view_00.exr").read_bytes() == (tmp_path / "darker/view_00.exr").read_bytes()
    plain, darker = (
        linear_from_srgb(read_image(tmp_path / name / "view_00.png")[..., :3].astype(np.float64) / 255)
        for name in ("plain", "darker")
    )
    unclipped = plain.max(axis=-1) < 0.99
    assert darker[unclipped].mean() == pytest.approx(plain[unclipped].mean() / 2, rel=0.02)
    linear = read_image(tmp_path / "plain/view_00.exr")[..., :3]
    assert linear[..., 0].mean() > 1.3 * linear[..., 1].mean() > 1.3 * linear[..., 2].mean()


def test_command_and_wrong_input(asset: Path, tmp_path: Path) -> None:
    from model.cli import app

    out = tmp_path / "room.gif"
    words = [
        "render",
        str(asset),
        "--out",
        str(out),
        "--frames",
        "2",
        "--max-width",
        "32",
        "--samples",
        "1",
    ]
    done = CliRunner().invoke(app, [*words, "--lamp", "2,1.5,2", "--way", "cameras", "--quiet"])
    assert done.exit_code == 0 and out.is_file(), done.output
    dark = CliRunner().invoke(app, [*words, "--sky", "1,1,1", "--quiet"])
    assert dark.exit_code == 0 and "no light from the sky reaches frame-000" in dark.output
    for extra, text in ((["--lamp", "1,2"], "expected 3 or 4 or 6 finite"), (["--way", "up"], "not one of"),
                        (["--lamp", "1,2,3,0"], "above 0"),
                        (["--lamp", "1,2,3,1,-1,1"], "above 0")):  # fmt: skip
        refused = CliRunner().invoke(app, [*words, *extra])
        assert refused.exit_code == 2 and text in refused.output, refused.output
    with pytest.raises(InputError, match=r"expected a file \.gif or \.mp4"):
        write_turntable(asset, tmp_path / "room.avi")
    with pytest.raises(InputError, match="frames = 1"):
        TurntableOptions(frames=1)
    with pytest.raises(InputError, match=r"frames per second = 0\.001; expected 0\.01 to 100"):
        TurntableOptions(frames_per_second=0.001)  # a delay that GIF cannot store
