# SPDX-License-Identifier: MIT
"""Exports of a rendered room with two objects, checked by other tools' readers and by geometry."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from datagen.cli import app
from datagen.exports.flow import flow_between
from datagen.farm.collect import collect
from datagen.farm.local import LocalOptions, run_local
from datagen.formats.asset import Part
from datagen.formats.base import canonical_json
from datagen.formats.configuration import PlacedAsset
from datagen.formats.package import write_package
from datagen.formats.shard import ShardReader, View, write_shard
from datagen.foundation.errors import InputError
from datagen.library import Library
from tests.datagen.small_dataset import make_configuration, make_view_files
from tests.datagen.small_plan import plan_small
from tests.datagen.test_package import cube_asset, cube_files

TURN, SCALE = 0.5, 1.5


def _placed(name: str, asset: str, place: tuple[float, float, float], scale: float) -> PlacedAsset:
    c, s = scale * np.cos(TURN), scale * np.sin(TURN)
    x, y, z = place
    rows = ((c, -s, 0.0, x), (s, c, 0.0, y), (0.0, 0.0, scale, z), (0.0, 0.0, 0.0, 1.0))
    return PlacedAsset(name=name, asset=asset, world_from_asset=rows)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("exports")
    things = (
        _placed("cabinet-1", "cabinet", (1.8, 1.6, 0), 1.0),
        _placed("chair-1", "chair", (3.0, 2.2, 0), SCALE),
    )
    folder = plan_small(root / "dataset", root / "library", 1, 4, objects=things)
    summary = run_local(folder.root, LocalOptions(workers=1))
    assert len(summary.done) == 1
    collect(folder.root)
    return folder.root


@pytest.fixture(scope="module")
def views(dataset: Path) -> list[View]:
    return list(ShardReader(next((dataset / "shards").glob("*.tar"))))


def export(layout: str, dataset: Path, out: Path, *options: str) -> Path:
    result = CliRunner().invoke(app, ["export", layout, str(dataset), "--out", str(out), *options])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return out


def masks_of(view: View) -> dict[str, np.ndarray]:
    """Return the mask (H, W) of each visible object by name, from the instance ids."""
    ids = view.buffers["instance_id"][..., 0]
    named = {name: ids == int(key) for key, name in view.record.instances.items() if "/" not in name}
    return {name: mask for name, mask in named.items() if mask.any()}


def read_png(path: Path) -> np.ndarray:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None, path
    return pixels


def test_views_show_the_objects(views) -> None:
    """The other tests of this file need visible objects."""
    assert sum(len(masks_of(view)) for view in views) >= 4
    assert {name for view in views for name in masks_of(view)} == {"cabinet-1", "chair-1"}


def test_pycocotools_reads_boxes_and_masks(dataset: Path, views: list[View], tmp_path: Path) -> None:
    from pycocotools.coco import COCO

    out = export("coco", dataset, tmp_path / "coco")
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(out / "annotations" / "instances_train.json"))
    categories = {c["id"]: c["name"] for c in coco.loadCats(coco.getCatIds())}
    assert sorted(categories.values()) == ["cabinet", "chair"]
    assert len(coco.imgs) == len(views)
    for (number, image), view in zip(coco.imgs.items(), views, strict=True):
        assert read_png(out / "images" / "train" / image["file_name"]).shape == (48, 64, 3)
        expected = masks_of(view)
        entries = coco.loadAnns(coco.getAnnIds(imgIds=[number]))
        assert sorted(e["instance"] for e in entries) == sorted(expected)
        for entry in entries:
            mask = expected[entry["instance"]]
            np.testing.assert_array_equal(coco.annToMask(entry).astype(bool), mask)
            assert entry["area"] == mask.sum()
            x, y, width, height = entry["bbox"]
            assert mask[y : y + height, x : x + width].sum() == mask.sum()
            assert mask[y].any() and mask[:, x].any() and mask[y + height - 1].any()
            assert categories[entry["category_id"]] == entry["asset"]


@pytest.mark.parametrize("seed", range(3))
def test_run_lengths_equal_those_of_pycocotools(seed: int) -> None:
    from pycocotools import mask as reference

    from datagen.exports.coco import run_lengths

    rng = np.random.default_rng(seed)
    mask = cv2.blur(rng.random((173, 211)), (1 + 20 * seed, 9)) > 0.5  # with runs of many lengths
    for given in (mask, np.zeros_like(mask), np.ones_like(mask)):
        expected = reference.encode(np.asfortranarray(given.astype(np.uint8)))
        assert run_lengths(given)["counts"] == expected["counts"].decode()


def _seen_by(poses: dict[str, Any], camera: dict[str, Any], points_m: np.ndarray) -> np.ndarray:
    """Project an object's points to pixels (N, 2) by BOP's convention: pixel centres are integers."""
    rotation, place = np.reshape(poses["cam_R_m2c"], (3, 3)), np.array(poses["cam_t_m2c"])
    local = 1e3 * points_m @ rotation.T + place
    image = local @ np.reshape(camera["cam_K"], (3, 3)).T
    return image[:, :2] / image[:, 2:]


def test_bop_poses_project_models_onto_their_masks(dataset: Path, views: list[View], tmp_path: Path) -> None:
    """Unprojected pixels of a mask are inside the model's box, and the projected model encloses the mask."""
    import trimesh

    out = export("bop", dataset, tmp_path / "bop")
    scene = out / "train" / "000000"
    cameras, truth, infos = (
        json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt", "gt_info")
    )
    models = json.loads((out / "models" / "models_info.json").read_text())
    assert {m["asset"]: m["scale"][0] for m in models.values()} == {"cabinet": 1.0, "chair": SCALE}
    checked = 0
    for number, view in enumerate(views):
        camera, lens = cameras[str(number)], np.reshape(cameras[str(number)]["cam_K"], (3, 3))
        depth = read_png(scene / "depth" / f"{number:06d}.png") * camera["depth_scale"]
        assert len(truth[str(number)]) == len(masks_of(view))
        for entry, (pose, info) in enumerate(zip(truth[str(number)], infos[str(number)], strict=True)):
            mask = read_png(scene / "mask_visib" / f"{number:06d}_{entry:06d}.png") > 0
            assert info["px_count_visib"] == mask.sum()
            rows, columns = np.nonzero(mask)
            rays = np.linalg.inv(lens) @ np.stack([columns, rows, np.ones_like(rows)])
            local = (rays * depth[mask]).T - np.array(pose["cam_t_m2c"])
            inside = local @ np.reshape(pose["cam_R_m2c"], (3, 3))
            model = models[str(pose["obj_id"])]
            low = np.array([model[f"min_{axis}"] for axis in "xyz"])
            size = np.array([model[f"size_{axis}"] for axis in "xyz"])
            assert (inside > low - 3).all() and (inside < low + size + 3).all()  # mm
            mesh = trimesh.load(out / "models" / f"obj_{pose['obj_id']:06d}.ply")
            np.testing.assert_allclose(mesh.bounds, [low, low + size], atol=1e-2)
            pixels = _seen_by(pose, camera, np.asarray(mesh.vertices) / 1e3)
            if info["bbox_obj"] != [-1, -1, -1, -1]:
                assert columns.min() >= pixels[:, 0].min() - 0.6 and columns.max() <= pixels[:, 0].max() + 0.6
                assert rows.min() >= pixels[:, 1].min() - 0.6 and rows.max() <= pixels[:, 1].max() + 0.6
                checked += 1
    assert checked >= 2
    boxes = json.loads((scene / "boxes3d.json").read_text())["boxes"]
    chair = next(box for box in boxes if box["asset"] == "chair")
    assert np.arctan2(chair["rotation"][1][0], chair["rotation"][0][0]) == pytest.approx(TURN)
    assert chair["center_m"][2] == pytest.approx(chair["size_m"][2] / 2)  # it is on the floor


def test_bop_without_the_library_is_refused(dataset: Path, tmp_path: Path) -> None:
    from datagen.exports.bop import BopFiles
    from datagen.exports.rooms import Export, open_rooms

    with pytest.raises(InputError, match=r"name the folders of its assets with --library"):
        BopFiles(Export(open_rooms(dataset, None, ()), tmp_path))


def test_our_reader_of_transforms_recovers_the_cameras(
    dataset: Path, views: list[View], tmp_path: Path
) -> None:
    from datagen.foundation.budget import Budget
    from model.reconstruction.captures.transforms_json import read

    out = export("nerfstudio", dataset, tmp_path / "ns") / "small-00000"
    images = read(out / "transforms.json", out, Budget(out)).images
    for image, view in zip(images, views, strict=True):
        camera = view.record.camera.camera()
        np.testing.assert_allclose(image.camera.world_from_camera, camera.world_from_camera, atol=1e-6)
        assert (image.camera.fx_px, image.camera.cx_px) == (camera.fx_px, camera.cx_px)
    data = json.loads((out / "transforms.json").read_text())
    for frame, view in zip(data["frames"], views, strict=True):
        depth = read_png(out / frame["depth_file_path"]) * data["depth_unit_scale_factor"]
        np.testing.assert_allclose(depth, view.buffers["depth_z_m"][..., 0], atol=6e-4)


def test_points_of_the_cloud_are_on_visible_surfaces(
    dataset: Path, views: list[View], tmp_path: Path
) -> None:
    import trimesh

    out = export("nerfstudio", dataset, tmp_path / "ns") / "small-00000"
    cloud = trimesh.load(out / "points.ply")
    view = views[0]
    pixels, depth = view.record.camera.camera().project(np.asarray(cloud.vertices))
    inside = (depth > 0) & (pixels > 0).all(-1) & (pixels < [64, 48]).all(-1)
    column, row = np.floor(pixels[inside]).astype(int).T
    seen = view.buffers["depth_z_m"][row, column, 0]
    assert (np.abs(seen - depth[inside]) < 0.02 * seen).sum() > 0.9 * (view.buffers["depth_z_m"] > 0).sum()


def _warped(view: View, flow: np.ndarray, name: str) -> np.ndarray:
    """Warp a buffer (H, W, C) of the view by the flow (H, W, 2), with bilinear lookup."""
    height, width = flow.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    source = view.buffers[name].astype(np.float32)
    return cv2.remap(
        source, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def decode_flo(data: bytes) -> np.ndarray:
    """Decode a ``.flo`` file to flow (H, W, 2)."""
    assert data[:4] == b"PIEH"
    width, height = struct.unpack_from("<ii", data, 4)
    return np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2)


def _flow_faults(out: Path, views: list[View], gain: float = 1.0) -> tuple[float, float, int]:
    """Return median relative depth error, mean albedo error and pixel count of the flow times ``gain``."""
    by_name = {view.record.name: view for view in views}
    depths, colors = [], []
    for pair in json.loads((out / "pairs.json").read_text())["pairs"]:
        flow = decode_flo((out / pair["flow"]).read_bytes()) * np.float32(gain)
        seen = read_png(out / pair["visible"]) > 0
        a, b = by_name[pair["from"]], by_name[pair["to"]]
        rows, columns = np.nonzero(seen)
        ends = np.stack([columns, rows], -1) + 0.5 + flow[seen]
        camera_a, camera_b = a.record.camera.camera(), b.record.camera.camera()
        points = camera_a.unproject(np.stack([columns, rows], -1) + 0.5, a.buffers["depth_z_m"][seen][:, 0])
        expected = (points - camera_b.position_m) @ camera_b.forward
        column, row = np.clip(np.floor(ends).astype(int), 0, [63, 47]).T
        # depth is stored at pixel centres: extrapolate it in the tangent plane
        normal = b.buffers["normal_world"][row, column].astype(float)
        centre = camera_b.unproject(np.stack([column, row], -1) + 0.5, b.buffers["depth_z_m"][row, column, 0])
        rays = camera_b.unproject(ends, np.ones(len(ends))) - camera_b.position_m
        along = ((centre - camera_b.position_m) * normal).sum(-1) / (rays * normal).sum(-1)
        depths.append(np.abs(along - expected) / expected)
        difference = np.abs(
            _warped(b, flow, "diffuse_albedo") - a.buffers["diffuse_albedo"].astype(np.float32)
        )
        inner = cv2.erode(seen.astype(np.uint8), np.ones((3, 3))) > 0
        colors.append(difference[inner].ravel())
    return (
        float(np.median(np.concatenate(depths))),
        float(np.concatenate(colors).mean()),
        len(np.concatenate(depths)),
    )


def test_flow_maps_to_the_same_points_and_colours(dataset: Path, views: list[View], tmp_path: Path) -> None:
    out = export("flow", dataset, tmp_path / "flow", "--min-overlap", "0.05") / "small-00000"
    depth_error, color_error, count = _flow_faults(out, views)
    assert count > 2000
    assert depth_error < 1e-3
    assert color_error < 0.03
    # Injected fault: both errors detect flow that is 5 % too long.
    wrong_depth, wrong_color, _ = _flow_faults(out, views, gain=1.05)
    assert wrong_depth > 3 * depth_error
    assert wrong_color > 2 * color_error


def test_flow_of_a_view_to_itself_is_zero_and_everything_is_seen(views: list[View]) -> None:
    view = views[0]
    camera = view.record.camera.camera()
    flow, is_seen = flow_between(camera, view.buffers, camera, view.buffers)
    has_depth = view.buffers["depth_z_m"][..., 0] > 0
    assert np.abs(flow[has_depth]).max() < 1e-3
    assert (is_seen == has_depth).mean() > 0.99
    assert (flow[~has_depth] > 1e9).all()


def test_hypersim_folders_follow_the_convention(dataset: Path, views: list[View], tmp_path: Path) -> None:
    """Hypersim's matrices project positions to their pixels, and depth is the distance to the camera."""
    import h5py

    def read(path: Path) -> np.ndarray:
        with h5py.File(path, "r") as file:
            return np.array(file["dataset"])

    out = export("hypersim", dataset, tmp_path / "hs")
    with (out / "metadata_camera_parameters.csv").open() as file:
        (lens,) = csv.DictReader(file)
    projection = np.array([[float(lens[f"M_proj_{r}{c}"]) for c in range(4)] for r in range(4)])
    cam_from_uv = np.array([[float(lens[f"M_cam_from_uv_{r}{c}"]) for c in range(3)] for r in range(3)])
    detail = out / "small-00000" / "_detail" / "cam_00"
    places = read(detail / "camera_keyframe_positions.hdf5")
    turns = read(detail / "camera_keyframe_orientations.hdf5")
    u, v = np.meshgrid((np.arange(64) + 0.5) / 32 - 1, 1 - (np.arange(48) + 0.5) / 24)
    for number, view in enumerate(views):
        stem = out / "small-00000" / "images"
        geometry = stem / "scene_cam_00_geometry_hdf5" / f"frame.{number:04d}"
        position = read(geometry.with_name(geometry.name + ".position.hdf5")).astype(np.float64)
        has = np.isfinite(position[..., 0])
        assert (has == (view.buffers["depth_z_m"][..., 0] > 0)).all()
        local = (position[has] - places[number]) @ turns[number]
        clip = np.concatenate([local, np.ones((len(local), 1))], axis=-1) @ projection.T
        np.testing.assert_allclose(clip[:, :2] / clip[:, 3:], np.stack([u[has], v[has]], -1), atol=1e-4)
        ray = np.stack([u[has], v[has], np.ones(has.sum())], -1) @ cam_from_uv.T
        away = np.linalg.norm(local, axis=-1)
        np.testing.assert_allclose(
            local / away[:, None], ray / np.linalg.norm(ray, axis=-1)[:, None], atol=1e-4
        )
        depth = read(geometry.with_name(geometry.name + ".depth_meters.hdf5"))
        np.testing.assert_allclose(depth[has], away, rtol=1e-3)
        normal = read(geometry.with_name(geometry.name + ".normal_cam.hdf5")).astype(np.float32)[has]
        assert ((normal * local).sum(-1) <= 1e-2 * away).mean() > 0.99  # towards the camera
        color = read(stem / "scene_cam_00_final_hdf5" / f"frame.{number:04d}.color.hdf5")
        np.testing.assert_array_equal(color, view.buffers["beauty"])
        ids = read(geometry.with_name(geometry.name + ".semantic_instance.hdf5"))
        np.testing.assert_array_equal(np.where(ids < 0, 0, ids), view.buffers["instance_id"][..., 0])


def test_an_export_of_other_rooms_is_kept(tmp_path: Path) -> None:
    """Other rooms are not exported to the same folder, because models and categories would be renumbered."""
    from datagen.exports.rooms import claim_folder

    for _ in range(2):
        claim_folder(tmp_path, "bop", tmp_path / "rooms", {"split": "train"})
    with pytest.raises(InputError, match=r"an earlier export to bop of the same rooms; choose another --out"):
        claim_folder(tmp_path, "bop", tmp_path / "rooms", {"split": "test"})


def test_damaged_members_are_reported_by_name(tmp_path: Path) -> None:
    from datagen.exports.rooms import Room

    configuration, path = make_configuration(1), tmp_path / "rooms.tar"
    members = make_view_files(tmp_path, configuration)
    with path.open("wb") as stream:
        write_shard(stream, canonical_json(configuration), members)
    whole = path.read_bytes()
    path.write_bytes(whole.replace(members[0][1].read_bytes()[:4], b"junk"))
    with pytest.raises(InputError, match=r"rooms\.tar:small-00000/view-000: "):
        Room(path, "train").views[0].read("beauty")
    path.write_bytes(whole.replace(b'"exposure"', b'"exposure '))
    with pytest.raises(InputError, match=r"rooms\.tar:small-00000/view-000: .*expected valid JSON"):
        _ = Room(path, "train").views


def test_models_of_mirrored_parts_face_outwards(tmp_path: Path) -> None:
    import trimesh

    from datagen.exports.bop import BopFiles
    from datagen.exports.rooms import Export

    mirror = ((-1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
    part = Part(name="body", mesh="meshes/cube.ply", material="body", asset_from_part=mirror)
    write_package(tmp_path / "cube", cube_asset(parts=(part,)), cube_files())
    with Library([tmp_path]) as library:
        model = BopFiles(Export([], tmp_path, library)).mesh(("cube", (1.0, 1.0, 1.0)))
    assert trimesh.Trimesh(model.positions, model.faces).volume == pytest.approx(1.0)


def test_existing_folders_are_not_overwritten(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "mine"
    out.mkdir()
    (out / "thesis.txt").write_text("words")
    with pytest.raises(InputError, match=r"expected a new or empty folder, or an earlier export to coco"):
        export("coco", dataset, out)
    export("coco", dataset, tmp_path / "once")
    export("coco", dataset, tmp_path / "once")
    with pytest.raises(InputError, match=r"earlier export to flow"):
        export("flow", dataset, tmp_path / "once")
    with pytest.raises(InputError, match=r"--configuration = attic; expected one of small-00000"):
        export("coco", dataset, tmp_path / "two", "--configuration", "attic")
    with pytest.raises(InputError, match=r"--split = test; expected a split that has configurations"):
        export("coco", dataset, tmp_path / "two", "--split", "test")
