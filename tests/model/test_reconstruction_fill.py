# SPDX-License-Identifier: MIT
"""Filling of unseen texels, size and images of an atlas, and the command."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import srgb_from_linear
from datagen.foundation.images import read_image
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import TracedGeometry, face_normals
from model.reconstruction.atlas.atlas import Atlas, empty_atlas
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.export.atlas_images import map_bytes, write_atlas_images
from model.reconstruction.merge import fill
from model.reconstruction.merge.fill import fill_unseen, nearest_labels, typical_values
from model.reconstruction.unwrap.charts import chart_of_faces
from model.reconstruction.unwrap.repacked import atlas_size, pixel_density
from oracles.textured_room import geometry_of, room_mesh

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
SIZE = 96


def seen_atlas(seen_faces: list[int], half_seen: list[int]) -> tuple[Mesh, Atlas]:
    """Mesh and atlas with the value k / 100 in quad k; ``half_seen`` triangles are seen in the left half."""
    mesh = room_mesh()
    atlas = empty_atlas(SIZE)
    atlas.face[...] = TexelSurface(mesh, face_normals(mesh), SIZE).faces(0, 0, SIZE, SIZE)
    column = np.arange(SIZE)[None, :] % 24
    seen = np.isin(atlas.face, seen_faces) | (np.isin(atlas.face, half_seen) & (column < 12))
    atlas.count[seen] = 2
    for array in atlas.maps.values():
        array[seen] = (atlas.face[seen] // 2 / 100)[:, None]
    return mesh, atlas


def nearest_index(source: np.ndarray) -> np.ndarray:
    labels, places = nearest_labels(source)
    return places[labels]


def test_every_texel_gets_a_value_from_its_surroundings() -> None:
    """Half-seen charts are filled from themselves; the unseen top of the block from its sides, not from a far
    wall."""
    seen = [f for f in range(24) if f // 2 not in (3, 11)]  # quad 3: a wall; quad 11: the block's top
    mesh, atlas = seen_atlas(seen, [6, 7])
    count, face = atlas.count.copy(), atlas.face.copy()
    known = {name: array[count > 0].copy() for name, array in atlas.maps.items()}
    told: list[tuple[int, int]] = []
    fill_unseen(atlas, mesh, lambda *progress: told.append(progress))
    assert told == sorted(told) and told[-1] == (400, 400) and len(told) > 4
    np.testing.assert_array_equal(atlas.count, count)
    np.testing.assert_array_equal(atlas.face, face)
    for name, array in atlas.maps.items():
        np.testing.assert_array_equal(array[count > 0], known[name])
    roughness = np.round(atlas.maps["roughness"][..., 0].astype(np.float32) * 100).astype(int)
    assert (roughness[face // 2 == 3] == 3).all()
    assert np.isin(roughness[np.isin(face, [22, 23])], [6, 7, 8, 9, 10]).all()
    gutter = face < 0
    assert (
        gutter.any()
        and (roughness[gutter] == roughness.ravel()[nearest_index(~gutter)[gutter]]).mean() > 0.99
    )
    assert (roughness[gutter] > 0).mean() > 0.8  # quad 0 is 0


def test_unseen_triangles_resemble_their_piece() -> None:
    """The unseen room has the value of its only seen wall, not of the block, which is nearer to the floor;
    with no seen wall it has the block's."""
    for seen, expected in (([10, 11, *range(12, 24)], [5]), (list(range(12, 24)), [6, 7, 8, 9, 10, 11])):
        mesh, atlas = seen_atlas(seen, [])
        fill_unseen(atlas, mesh)
        roughness = np.round(atlas.maps["roughness"][..., 0].astype(np.float32) * 100).astype(int)
        assert set(np.unique(roughness[(atlas.face >= 0) & (atlas.face < 12)])) <= set(expected)


def test_unseen_triangles_resemble_the_best_observed_neighbour() -> None:
    """Of four sides of the block, three are seen in one texel each: its top has the value of the fourth."""
    mesh, atlas = seen_atlas([f for f in range(24) if f // 2 != 11], [])
    for face in range(14, 22):
        texels = np.argwhere(atlas.face == face)
        atlas.count[tuple(texels[1:].T)] = 0
    fill_unseen(atlas, mesh)
    roughness = np.round(atlas.maps["roughness"][..., 0].astype(np.float32) * 100).astype(int)
    assert (roughness[np.isin(atlas.face, [22, 23])] == 6).all()


def test_filled_texels_fade_from_the_border_to_the_typical_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dark border of the observed part of a chart is not repeated across the rest of it."""
    monkeypatch.setattr(fill, "FADE_TEXELS", 2.0)
    mesh, atlas = seen_atlas([f for f in range(24) if f // 2 != 3], [6, 7])
    of_wall = np.isin(atlas.face, [6, 7])
    seen = of_wall & (atlas.count > 0)
    edge = int(np.nonzero(seen)[1].max())
    albedo = atlas.maps["diffuse_albedo"]
    albedo[seen] = 0.8
    border = seen.copy()
    border[:, :edge] = False
    albedo[border] = 0.2
    fill_unseen(atlas, mesh)
    row = int(np.median(np.nonzero(border)[0]))
    filled = albedo[row, edge + 1 :][of_wall[row, edge + 1 :], 0].astype(np.float64)
    typical = 0.2 + (filled[-1] - 0.2) / (1 - 1 / (1 + (len(filled) / 2.0) ** 2))
    assert 0.6 < typical < 0.8 and len(filled) > 6
    expected = typical - (typical - 0.2) / (1 + (np.arange(1, len(filled) + 1) / 2.0) ** 2)
    np.testing.assert_allclose(filled, expected, atol=0.02)


def test_typical_values_of_hardly_seen_charts_are_those_of_their_piece() -> None:
    """Charts 0 to 2 are one piece, 1 % of whose seen texels are in chart 1; of the other piece, charts 3 and
    4, one texel is seen."""
    charts, piece = np.array([0, 0, 0, 1, 2, 3, 4]), np.array([5, 5, 5, 5, 5, 9, 9])
    means = np.array([[0.8], [0.7], [0.1], [0.2], [0.75], [0.3], [0.0]])
    found = typical_values(charts, piece, means, np.array([600, 300, 90, 20, 990, 1, 0]))[:, 0]
    np.testing.assert_allclose(found[[0, 2]], [0.8, 0.75], atol=0.01)
    assert 0.65 < found[1] < 0.8
    assert found[3] == 0.3 and found[4] == 0.0


def test_an_atlas_in_files_is_filled_identically(tmp_path: Path) -> None:
    """An atlas in files is processed in bands whose memory is released."""
    mesh, atlas = seen_atlas([f for f in range(24) if f // 2 not in (3, 11)], [6, 7])
    filed = empty_atlas(SIZE, tmp_path)
    for name, array in atlas.maps.items():
        filed.maps[name][...] = array
    filed.count[...], filed.face[...] = atlas.count, atlas.face
    filed.release()
    fill_unseen(atlas, mesh)
    fill_unseen(filed, mesh)
    for name, array in atlas.maps.items():
        np.testing.assert_array_equal(array, filed.maps[name])
        assert array.any()


def test_an_unseen_atlas_stays_empty() -> None:
    mesh, atlas = seen_atlas([], [])
    fill_unseen(atlas, mesh)
    assert not any(array.any() for array in atlas.maps.values())


def test_nearest_index_against_brute_force() -> None:
    rng = np.random.default_rng(2)
    source = rng.random((30, 37)) < 0.02
    at = np.argwhere(source)
    index = nearest_index(source)
    rows, columns = np.divmod(index, 37)
    assert source[rows, columns].all()
    grid = np.stack(np.meshgrid(np.arange(30), np.arange(37), indexing="ij"), axis=-1)
    least = np.linalg.norm(grid[:, :, None] - at, axis=-1).min(axis=-1)
    got = np.hypot(grid[..., 0] - rows, grid[..., 1] - columns)
    assert (got <= least * 1.05 + 1e-9).all()  # OpenCV's 5 x 5 distances are 2 % off


def test_charts_are_the_quads() -> None:
    """Triangles share a chart if they share a position and its UV, also without sharing a vertex."""
    mesh = room_mesh()
    assert mesh.uv is not None
    corners = mesh.faces.ravel()
    soup = Mesh(mesh.positions[corners], np.arange(72, dtype=np.int32).reshape(-1, 3), None, mesh.uv[corners])
    for charts in (chart_of_faces(mesh), chart_of_faces(soup)):
        np.testing.assert_array_equal(charts[::2], charts[1::2])
        assert len(np.unique(charts)) == 12


def test_size_follows_the_density_of_pixels() -> None:
    """A wall seen frontally from 2 m with f = 200 px has pixels of 1 cm: 4 m of it need 400 texels."""
    quad = np.array([[-2, 2, -2], [2, 2, -2], [2, 2, 2], [-2, 2, 2]], np.float32)
    mesh = Mesh(quad, np.array([[0, 1, 2], [0, 2, 3]], np.int32), None, np.zeros((4, 2), np.float32))
    pose = look_at([0, 0, 0], [0, 1, 0])
    sizes = []
    for scale in (1, 2, 4):
        camera = Camera(
            20 * scale, 20 * scale, 200.0 * scale, 200.0 * scale, 10.0 * scale, 10.0 * scale, pose
        )
        view = TracedGeometry(geometry_of(mesh)).trace_view(camera)
        sizes.append(atlas_size(pixel_density([(camera, view)]).footprint_m, 4.0))
    assert sizes == [
        512,
        1024,
        1792,
    ]  # 400, 800, 1600 up to the next multiple of 256; corners are slightly coarser


def test_images_of_an_atlas_are_written(tmp_path: Path) -> None:
    _, atlas = seen_atlas(list(range(24)), [])
    rng = np.random.default_rng(0)
    for array in atlas.maps.values():
        array[...] = rng.random(array.shape)
    write_atlas_images(tmp_path, atlas)
    for name, array in atlas.maps.items():
        exr, png = read_image(tmp_path / f"{name}.exr"), read_image(tmp_path / f"{name}.png")
        np.testing.assert_array_equal(exr, array.astype(np.float32))
        values = array.astype(np.float32)
        expected = values if name == "roughness" else srgb_from_linear(values)
        assert np.abs(png / 255 - expected).max() <= 0.5 / 255 + 1e-6
    odd = np.array([[[np.nan], [-1.0], [2.0], [0.5]]], np.float16)
    assert map_bytes("roughness", odd).ravel().tolist() == [0, 0, 255, 128]


def test_command_refuses_bad_input(tmp_path: Path) -> None:
    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "model.cli", *words], capture_output=True, text=True, timeout=120
        )

    missing = run("infer", str(tmp_path), "--out", str(tmp_path / "o"))
    assert missing.returncode == 2 and "no known format" in missing.stderr
    wrong = run("infer", str(tmp_path), "--out", str(tmp_path / "o"), "--encoding", "rec2020")
    assert wrong.returncode == 2 and "gamma22" in wrong.stderr
    assert run("render", str(tmp_path), "--out", str(tmp_path / "o")).returncode == 2
