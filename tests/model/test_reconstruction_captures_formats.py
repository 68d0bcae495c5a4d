# SPDX-License-Identifier: MIT
"""Conventions of other software: points project to the pixels of its documented model, within 0.01 px.

Each oracle follows the software's formulas in float64, independent of the readers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.formats.asset import AssetCamera, EnvironmentAsset, Part, Provenance, SlotMaterial
from datagen.formats.capture import CaptureView
from datagen.formats.package import write_package
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import encode_ply
from model.reconstruction.captures.frames import AXES, estimated_unit, estimated_up, level_rotation, z_up_from
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.photographs import PhotographSource, lens_pixels
from model.reconstruction.captures.read import read_capture
from tests.datagen.small_library import box, with_uv

SIZE = (600, 400)
TOLERANCE_PX = 0.01
OPTIONS = CaptureOptions(up="z", unit_m=1.0)
Oracle = Callable[[np.ndarray], np.ndarray]


def points() -> np.ndarray:
    """World points that are visible to all cameras of this file."""
    return np.random.default_rng(5).uniform([-0.8, -0.8, 0], [0.8, 0.8, 1.2], (60, 3))


def poses() -> list[tuple[np.ndarray, np.ndarray]]:
    """Three poses (camera_from_world rotation, centre): y down, z forward, rolled."""
    found = []
    for k in range(3):
        center = np.array([3 * np.cos(1.9 * k), 3 * np.sin(1.9 * k), 1 + 0.4 * k])
        forward = (np.array([0, 0.1, 0.5]) - center) / np.linalg.norm(np.array([0, 0.1, 0.5]) - center)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        level = np.stack([right, np.cross(forward, right), forward])
        found.append((Rotation.from_euler("z", 0.2 * k - 0.1).as_matrix() @ level, center))
    return found


def write_images(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(encode_png(np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)))


def write_mesh(folder: Path) -> None:
    (folder / "room.ply").write_bytes(encode_ply(with_uv(box([-1, -1, 0], [1, 1, 1]))))


def pixels_of(view: CaptureView, world: np.ndarray) -> np.ndarray:
    """Pixels of world points in the capture's photograph, distortion included."""
    source = view.source
    assert isinstance(source, PhotographSource)
    lens = source.calibrated
    local = (world - lens.position_m) @ lens.world_from_camera[:3, :3]
    assert (local[:, 2] > 0).all()
    return lens_pixels(lens, source.distortion, local[:, :2] / local[:, 2:])


def check(views: tuple[CaptureView, ...], oracles: Mapping[str, Oracle]) -> None:
    assert sorted(view.name for view in views) == sorted(oracles)
    for view in views:
        expected = oracles[view.name](points())
        inside = ((expected > 0) & (expected < SIZE)).all(axis=1)
        assert inside.mean() > 0.8
        np.testing.assert_allclose(pixels_of(view, points()), expected, atol=TOLERANCE_PX)


def wiki_brown(xy: np.ndarray, k: tuple[float, ...], t1: float, t2: float) -> np.ndarray:
    """Brown's model as in RealityCapture and Metashape: t1 (p1) multiplies r^2 + 2 x^2."""
    x, y = xy.T
    r = np.sqrt(x**2 + y**2)
    radial = 1 + sum(value * r ** (2 * power) for power, value in enumerate(k, start=1))
    return np.stack(
        [
            x * radial + t1 * (r**2 + 2 * x**2) + 2 * t2 * x * y,
            y * radial + t2 * (r**2 + 2 * y**2) + 2 * t1 * x * y,
        ],
        axis=1,
    )


K, T = (-0.11, 0.05, -0.02, 0.01), (0.004, -0.007)


def csv_oracle(center: np.ndarray, angles: tuple[float, float, float]) -> Oracle:
    """Projection with heading clockwise from north, then pitch up from straight down about the camera's right
    axis, then roll about its top axis."""
    axes = np.eye(3)  # rows: right = east, top = north, back = up
    for axis, angle in ((2, -angles[0]), (0, angles[1]), (1, angles[2])):
        axes = Rotation.from_rotvec(np.radians(angle) * axes[axis]).apply(axes)

    def project(world: np.ndarray) -> np.ndarray:
        x, top, back = ((world - center) @ axes.T).T
        bent = wiki_brown(np.stack([x / -back, -top / -back], axis=1), K, *T)
        scale = max(SIZE)
        return bent * 24.0 / 36.0 * scale + np.array(SIZE) / 2 + np.array([0.012, -0.02]) * scale

    return project


def angles_of(rotation: np.ndarray) -> tuple[float, float, float]:
    """Angles (heading, pitch, roll) at which :func:`csv_oracle` looks along the third row of ``rotation``."""
    axes = rotation * np.array([[1.0], [-1.0], [-1.0]])  # rows: right, top, back
    a, b, c = Rotation.from_matrix(axes.T).as_euler("ZXY", degrees=True)
    return -a, b, c


def test_realitycapture_csv(tmp_path: Path) -> None:
    names = [f"IMG_{k}.png" for k in range(3)]
    write_images(tmp_path / "images", names)
    write_mesh(tmp_path)
    lines = ["#cameras 3", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    oracles = {}
    for name, (rotation, center) in zip(names, poses(), strict=True):
        angles = angles_of(rotation)
        lines.append(",".join(map(str, (name, *center, *angles, 24.0, 0.012, -0.02, *K, *T))))
        oracles[name.lower()[:-4]] = csv_oracle(center, angles)
    (tmp_path / "cameras.csv").write_text("\n".join(lines) + "\n")
    check(read_capture(tmp_path / "cameras.csv", OPTIONS).views, oracles)
    check(read_capture(tmp_path, OPTIONS).views, oracles)


@pytest.mark.parametrize(
    ("angles", "forward", "top"),
    [((0, 0, 0), (0, 0, -1), (0, 1, 0)), ((0, 90, 0), (0, 1, 0), (0, 0, 1)),
     ((90, 90, 0), (1, 0, 0), (0, 0, 1)), ((0, 0, 90), (-1, 0, 0), (0, 1, 0))],
)  # fmt: skip
def test_realitycapture_compass_angles(angles: tuple, forward: tuple, top: tuple) -> None:
    from model.reconstruction.captures.realitycapture import rotation_of_angles

    rotation = rotation_of_angles(*map(float, angles))
    np.testing.assert_allclose(rotation[:, 2], forward, atol=1e-12)
    np.testing.assert_allclose(-rotation[:, 1], top, atol=1e-12)


@pytest.mark.parametrize("as_attributes", [False, True])
def test_realitycapture_xmp(tmp_path: Path, as_attributes: bool) -> None:
    """Values are elements or attributes; x = R (X - position); offsets are in units of the longer side."""
    write_images(tmp_path, [f"a{k}.png" for k in range(3)])
    write_mesh(tmp_path)
    oracles: dict[str, Oracle] = {}
    for k, (rotation, center) in enumerate(poses()):
        items = {
            "Rotation": " ".join(map(repr, map(float, rotation.ravel()))),
            "DistortionCoeficients": " ".join(map(str, (*K, *T))),
        }
        attributes = {"FocalLength35mm": 26.0, "Skew": 0, "AspectRatio": 1.01, "PrincipalPointU": 0.01,
                      "PrincipalPointV": -0.015, "DistortionModel": "brown4t2"}  # fmt: skip
        elements = f"<xcr:Position>{' '.join(map(str, map(float, center)))}</xcr:Position>"
        if as_attributes:
            attributes.update(items)
        else:
            elements += "".join(f"<xcr:{key}>{value}</xcr:{key}>" for key, value in items.items())
        inside = " ".join(f'xcr:{key}="{value}"' for key, value in attributes.items())
        (tmp_path / f"a{k}.xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax'
            '-ns#"><rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" '
            f"{inside}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta>"
        )

        def project(
            world: np.ndarray, rotation: np.ndarray = rotation, center: np.ndarray = center
        ) -> np.ndarray:
            local = world @ rotation.T - rotation @ center
            bent = wiki_brown(local[:, :2] / local[:, 2:], K, *T)
            focal = 26.0 / 36.0 * 600 * np.array([1, 1.01])
            return bent * focal + [300 + 0.01 * 600, 200 - 0.015 * 600]

        oracles[f"a{k}"] = project
    check(read_capture(tmp_path, OPTIONS).views, oracles)


METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="2"><sensor id="4" label="unknown" type="{kind}"><resolution width="600" height="400"/>
<calibration type="{kind}" class="initial"><resolution width="600" height="400"/><f>1</f></calibration>
<calibration type="{kind}" class="adjusted"><resolution width="600" height="400"/><f>420</f><cx>7.5</cx>
<cy>-11.25</cy>{lens}</calibration></sensor></sensors>
<cameras next_id="4" next_group_id="0">{cameras}
<camera id="9" sensor_id="4" label="unaligned"/></cameras>
<reference>{reference}</reference>
<transform><rotation locked="false">{rotation}</rotation><translation>0.5 -0.25 2</translation>
<scale>1.75</scale></transform></chunk></document>"""
LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'


def write_metashape(
    folder: Path, kind: str, lens: str, reference: str = LOCAL
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Write a Metashape file; return the rotation and centre of chunk_from_camera of each camera."""
    turn = Rotation.from_euler("xyz", [0.3, -0.4, 1.1]).as_matrix()
    cameras, stored = "", []
    for k, (rotation, center) in enumerate(poses()):  # the chunk's frame differs from the world
        matrix = np.eye(4)
        matrix[:3, :3] = turn.T @ rotation.T
        matrix[:3, 3] = turn.T @ (center - [0.5, -0.25, 2]) / 1.75
        stored.append((matrix[:3, :3], matrix[:3, 3]))
        numbers = " ".join(repr(float(v)) for v in matrix.ravel())
        label = f"b{k}" + (".PNG" if k == 1 else "")
        cameras += f'<camera id="{k}" sensor_id="4" label="{label}"><transform>{numbers}</transform></camera>'
    note = " ".join(repr(float(v)) for v in turn.ravel())
    text = METASHAPE.format(kind=kind, lens=lens, cameras=cameras, rotation=note, reference=reference)
    (folder / "cameras.xml").write_text(text)
    write_images(folder / "images", [f"b{k}.png" for k in range(3)])
    write_mesh(folder)
    return stored


@pytest.mark.parametrize("kind", ["frame", "equidistant_fisheye"])
def test_metashape(tmp_path: Path, kind: str) -> None:
    """Points go world -> chunk (undo scale, rotation, translation) -> camera, then the manual's formulas."""
    turn = Rotation.from_euler("xyz", [0.3, -0.4, 1.1]).as_matrix()
    is_frame = kind == "frame"
    lens = "".join(f"<k{k}>{v}</k{k}>" for k, v in enumerate(K, start=1))
    lens += "<p1>0.004</p1><p2>-0.007</p2><b1>3.5</b1><b2>0.01</b2>" if is_frame else ""
    stored = write_metashape(tmp_path, kind, lens)
    oracles: dict[str, Oracle] = {}
    for k, (rotation, center) in enumerate(stored):

        def project(
            world: np.ndarray, rotation: np.ndarray = rotation, center: np.ndarray = center
        ) -> np.ndarray:
            chunk = ((world - [0.5, -0.25, 2]) @ turn) / 1.75
            local = (chunk - center) @ rotation
            xy = local[:, :2] / local[:, 2:]
            if not is_frame:
                r = np.linalg.norm(xy, axis=1, keepdims=True)
                xy = wiki_brown(xy * np.arctan(r) / r, K, 0, 0)
                return np.array([300 + 7.5, 200 - 11.25]) + 420 * xy
            bent = wiki_brown(xy, K, *T)
            u = 300 + 7.5 + bent[:, 0] * 420 + bent[:, 0] * 3.5 + bent[:, 1] * 0.01
            return np.stack([u, 200 - 11.25 + bent[:, 1] * 420], axis=1)

        oracles[f"b{k}"] = project
    capture = read_capture(tmp_path / "cameras.xml", OPTIONS)
    check(capture.views, oracles)
    assert any("1 cameras are not aligned" in note for note in capture.notes)


def test_metashape_faults(tmp_path: Path) -> None:
    write_metashape(tmp_path, "frame", "<b2>6</b2>")
    with pytest.raises(InputError, match=r"sensor 4\.b2 = 6"):
        read_capture(tmp_path / "cameras.xml", OPTIONS)
    write_metashape(tmp_path, "spherical", "")
    with pytest.raises(InputError, match="spherical; expected frame"):
        read_capture(tmp_path, OPTIONS)
    write_metashape(tmp_path, "frame", "", 'GEOGCS["WGS 84",DATUM["World Geodetic System 1984"]]')
    with pytest.raises(InputError, match="expected Local Coordinates"):
        read_capture(tmp_path, OPTIONS)


@pytest.mark.parametrize("lens", ["pinhole", "pinhole_radial_k3", "pinhole_brown_t2", "fisheye"])
def test_openmvg(tmp_path: Path, lens: str) -> None:
    """x = R (X - C); by OpenMVG's headers: k1 k2 k3, then t2 multiplies r^2 + 2 x^2."""
    data = {"width": 600, "height": 400, "focal_length": 430.0, "principal_point": [290.0, 210.0]}
    extra = {"pinhole": {}, "pinhole_radial_k3": {"disto_k3": K[:3]}, "fisheye": {"fisheye": K},
             "pinhole_brown_t2": {"value0": data, "disto_t2": [*K[:3], *T]}}[lens]  # fmt: skip
    data = extra if "value0" in extra else {**data, **extra}
    views, extrinsics, oracles = [], [], {}
    for k, (rotation, center) in enumerate(poses()):
        view = {"local_path": "", "filename": f"c{k}.png", "width": 600, "height": 400, "id_view": k,
                "id_intrinsic": 3, "id_pose": 10 + k}  # fmt: skip
        views.append({"key": k, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"data": view}}})
        extrinsics.append(
            {"key": 10 + k, "value": {"rotation": rotation.tolist(), "center": center.tolist()}}
        )

        def project(
            world: np.ndarray, rotation: np.ndarray = rotation, center: np.ndarray = center
        ) -> np.ndarray:
            local = (world - center) @ rotation.T
            x = local[:, 0] / local[:, 2]
            y = local[:, 1] / local[:, 2]
            r = np.hypot(x, y)
            a = np.arctan(r)
            if lens == "fisheye":
                scale = (a + K[0] * a**3 + K[1] * a**5 + K[2] * a**7 + K[3] * a**9) / r
                x, y = x * scale, y * scale
            elif lens != "pinhole":
                t1, t2 = T if lens == "pinhole_brown_t2" else (0, 0)
                bent = K[0] * r**2 + K[1] * r**4 + K[2] * r**6
                dx = x * bent + t2 * (r**2 + 2 * x**2) + 2 * t1 * x * y
                dy = y * bent + t1 * (r**2 + 2 * y**2) + 2 * t2 * x * y
                x, y = x + dx, y + dy
            return np.stack([430 * x + 290, 430 * y + 210], axis=1)

        oracles[f"c{k}"] = project
    views.append({"key": 7, "value": {"ptr_wrapper": {"data": {"filename": "x.png", "id_pose": 99}}}})
    intrinsics = [{"key": 3, "value": {"polymorphic_name": lens, "ptr_wrapper": {"data": data}}}]
    content = {"sfm_data_version": "0.3", "root_path": r"/home/else/images", "views": views,
               "intrinsics": intrinsics, "extrinsics": extrinsics}  # fmt: skip
    (tmp_path / "sfm_data.json").write_text(json.dumps(content))
    write_images(tmp_path / "images", [f"c{k}.png" for k in range(3)])
    write_mesh(tmp_path)
    capture = read_capture(tmp_path, OPTIONS)
    check(capture.views, oracles)
    assert any("1 views have no pose" in note for note in capture.notes)
    intrinsics[0]["value"]["ptr_wrapper"]["data"] = {
        **data,
        "value0": {**data.get("value0", data), "width": 0},
    }
    (tmp_path / "sfm_data.json").write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        read_capture(tmp_path, OPTIONS)
    assert len(caught.value.problems) == 1, "the lens of three views is at fault once"
    assert "intrinsics 3" in str(caught.value)


def test_bundler(tmp_path: Path) -> None:
    """By Bundler's manual, P = R X + t, p = -P / P.z, pixel = f r(p) p from the image's centre, y upwards."""
    text, oracles = "# Bundle file v0.3\n4 0\n", {}
    for k, (rotation, center) in enumerate(poses()):
        up = np.diag([1.0, -1, -1]) @ rotation
        t = -up @ center
        rows = "\n".join(" ".join(map(repr, map(float, row))) for row in (*up, t))
        text += f"410.5 -0.1 0.02\n{rows}\n"

        def project(world: np.ndarray, up: np.ndarray = up, t: np.ndarray = t) -> np.ndarray:
            q = world @ up.T + t
            p = -q[:, :2] / q[:, 2:]
            s = (p**2).sum(axis=1, keepdims=True)
            out = 410.5 * (1 - 0.1 * s + 0.02 * s**2) * p
            return np.stack([300 + out[:, 0], 200 - out[:, 1]], axis=1)

        oracles[f"images-d-{k}"] = project
    (tmp_path / "bundle.out").write_text(text + "0 0 0\n" * 5)
    endings = (" 0 410.5", "", " 0 4e2", "")  # COLMAP writes names alone
    lines = [f"./images/d {k}.png{ending}\n" for k, ending in enumerate(endings)]
    (tmp_path / "list.txt").write_text("".join(lines))
    write_images(tmp_path / "images", [f"d {k}.png" for k in range(3)])
    write_mesh(tmp_path)
    check(read_capture(tmp_path, OPTIONS).views, oracles)


def test_environment_package_with_photographs(tmp_path: Path) -> None:
    """Packages of the Blender add-on provide cameras and meshes; photographs are matched by name."""
    mesh = with_uv(box([-1, -1, 0], [1, 1, 1]))
    cameras, oracles = [], {}
    for k, (rotation, center) in enumerate(poses()):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.T, center
        rows = tuple(tuple(float(v) for v in row) for row in matrix)
        cameras.append(AssetCamera(name=f"Camera.{k}", width_px=600, height_px=400, fx_px=500, fy_px=510,
                                   cx_px=290, cy_px=205, asset_from_camera=rows))  # fmt: skip

        def project(
            world: np.ndarray, rotation: np.ndarray = rotation, center: np.ndarray = center
        ) -> np.ndarray:
            local = (world - center) @ rotation.T
            return local[:, :2] / local[:, 2:] * [500, 510] + [290, 205]

        oracles[f"camera-{k}"] = project
    asset = EnvironmentAsset(
        id="room", title="Room", provenance=Provenance(license="CC0-1.0"), cameras=tuple(cameras),
        materials={"wall": SlotMaterial(), "lamp": SlotMaterial(emission=(3.0, 3.0, 3.0))},
        parts=(Part(name="walls", mesh="meshes/w.ply", material="wall"),
               Part(name="lamp", mesh="meshes/w.ply", material="lamp")),
    )  # fmt: skip
    write_package(tmp_path / "room", asset, {"meshes/w.ply": encode_ply(mesh)})
    write_images(tmp_path / "photographs", ["Camera.0.png", "camera.1.png"])
    capture = read_capture(tmp_path / "room")
    del oracles["camera-2"]
    check(capture.views, oracles)
    assert any("no photographs for 1 cameras: Camera.2" in note for note in capture.notes)
    assert capture.geometry.emitter_mask().sum() == 12 and len(capture.geometry.mesh.faces) == 24
    with pytest.raises(InputError, match=r"named after the cameras, such as Camera\.0"):
        read_capture(tmp_path / "room", CaptureOptions(images=tmp_path / "room"))


def test_faults_of_realitycapture_are_collected(tmp_path: Path) -> None:
    write_images(tmp_path, ["a.png"])
    write_mesh(tmp_path)
    head = "#name,x,y,alt,heading,pitch,roll,f\n"
    (tmp_path / "c.csv").write_text(head + "a.png,0,0,1,0,90,nan,20\nb.png,0,0,1,0,90,0,20\n")
    with pytest.raises(InputError) as caught:
        read_capture(tmp_path, OPTIONS)
    assert "row 1 (a.png) roll" in str(caught.value) and "b.png = not found" in str(caught.value)
    (tmp_path / "c.csv").write_text(head + '"a.png,0,0,1,0,90,0,20\n' + "a" * 140_000)
    with pytest.raises(InputError, match="one row per camera"):
        read_capture(tmp_path, OPTIONS)
    (tmp_path / "c.csv").write_text(head + "a.png,0,0,1,0,90,0,20\n")
    assert read_capture(tmp_path, OPTIONS).views[0].camera.fx_px == pytest.approx(600 * 20 / 36)


def test_up_is_estimated_from_the_cameras() -> None:
    from datagen.foundation.cameras import Camera

    for up in AXES:
        assert np.linalg.det(z_up_from(up)) == pytest.approx(1)
        turned = z_up_from(up).T  # rotates z to this axis
        cameras = []
        for rotation, center in poses():
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = turned @ rotation.T, turned @ center
            cameras.append(Camera(*SIZE, 500, 500, 300, 200, matrix))
        found, note = estimated_up(cameras)
        assert found == up and f"up: {up}" in note
    tilted = Rotation.from_euler("x", 45, degrees=True).as_matrix()
    oblique = [
        Camera(*SIZE, 500, 500, 300, 200, np.block([[tilted @ r.T, np.zeros((3, 1))], [0, 0, 0, 1]]))
        for r, _ in poses()
    ]
    assert estimated_up(oblique)[0] == "z" and "set it with --up" in estimated_up(oblique)[1]


def test_a_tilted_world_is_levelled_with_the_cameras() -> None:
    """Cameras that look down by 10 to 35 degrees in a randomly rotated world: for cameras facing one half of
    the room the mean up axis is wrong; for a single heading it is the best estimate."""
    from datagen.foundation.cameras import Camera, look_at

    def camera(heading_deg: float, down_deg: float) -> Camera:
        heading, down = np.radians([heading_deg, down_deg])
        way = [np.cos(heading) * np.cos(down), np.sin(heading) * np.cos(down), -np.sin(down)]
        world = np.eye(4)
        world[:3, :3] = turned
        return Camera(*SIZE, 500, 500, 300, 200, world @ look_at(np.zeros(3), np.array(way)))

    def rolled(camera: Camera) -> Camera:
        return replace(camera, world_from_camera=camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0]))

    turned = Rotation.random(random_state=3).as_matrix()
    ring = [camera(heading, 10 + heading / 8) for heading in range(0, 200, 20)]
    up = level_rotation(ring) @ turned
    np.testing.assert_allclose(up[2], [0, 0, 1], atol=1e-6)
    assert np.linalg.det(up) == pytest.approx(1)
    mean = np.mean([-c.world_from_camera[:3, 1] for c in ring], axis=0)
    assert (turned.T @ mean / np.linalg.norm(mean))[2] < np.cos(np.radians(10))
    ahead = level_rotation([camera(heading, 20) for heading in (-3, 0, 3)]) @ turned
    assert ahead[2, 2] == pytest.approx(np.cos(np.radians(20)), abs=1e-3)
    for downward in ([camera(heading, 89) for heading in (0, 90, 180, 270)], [*ring[:1], rolled(ring[0])]):
        with pytest.raises(InputError, match="name the axis with --up"):
            level_rotation(downward)


@pytest.mark.parametrize(
    ("size", "unit"), [(7.0, 1.0), (95.0, 1.0), (650.0, 0.01), (6500.0, 0.001), (0.2, 1.0)]
)
def test_unit_is_estimated_from_the_mesh(size: float, unit: float) -> None:
    found, note = estimated_unit(size)
    assert found == unit and "--unit" in note
    assert ("small for a room" in note) == (size < 1)


@pytest.mark.parametrize("has_uv", [True, False])
@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".gltf"])
def test_meshes(tmp_path: Path, suffix: str, has_uv: bool) -> None:
    """Every file format gives the same triangles and, where present, the same UVs, v upwards."""
    import trimesh

    mesh = with_uv(box([-1, -2, 0], [1, 1, 1]))
    assert mesh.uv is not None
    mesh = Mesh(mesh.positions, mesh.faces, None, np.abs(mesh.uv) * 0.3 if has_uv else None)
    path = tmp_path / f"room{suffix}"
    if suffix == ".ply":
        path.write_bytes(encode_ply(mesh))
    else:
        visual = trimesh.visual.TextureVisuals(uv=mesh.uv) if has_uv else None
        trimesh.Trimesh(mesh.positions, mesh.faces, visual=visual, process=False).export(path)
    write_images(tmp_path, ["a.png"])
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 500.0}]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    read = read_capture(tmp_path, CaptureOptions(up="z", unit_m=1.0, mesh=path)).geometry.mesh
    np.testing.assert_allclose(read.positions[read.faces], mesh.positions[mesh.faces], atol=1e-6)
    assert (read.uv is not None) == has_uv
    if has_uv:
        assert read.uv is not None and mesh.uv is not None
        np.testing.assert_allclose(read.uv[read.faces], mesh.uv[mesh.faces], atol=1e-6)


@pytest.mark.parametrize("unit_m", [0.0, -1.0, 1e-300, 1e300, math.inf, math.nan])
def test_impossible_units_are_refused(tmp_path: Path, unit_m: float) -> None:
    write_images(tmp_path, ["a.png"])
    write_mesh(tmp_path)
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 500.0}]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(InputError, match="metres per unit"):
        read_capture(tmp_path, CaptureOptions(up="z", unit_m=unit_m))
    assert read_capture(tmp_path, CaptureOptions(up="z", unit_m=1e-3)).views
