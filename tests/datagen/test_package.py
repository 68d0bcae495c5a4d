# SPDX-License-Identifier: MIT
"""Packages as containers, and the full check of their meshes, images and descriptions."""

from __future__ import annotations

import json
import os
import stat
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from datagen.assembly.daylight import environment_radiance
from datagen.asset_check import check_package
from datagen.formats.asset import (
    EnvironmentAsset,
    Material,
    MaterialAsset,
    ObjectAsset,
    Part,
    Provenance,
    SlotMaterial,
    Texture,
)
from datagen.formats.lights import AreaLight, EnvironmentLight
from datagen.formats.package import Package, is_package, open_package, write_package
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.mesh import (
    Mesh,
    flat_shaded,
    inspect_mesh,
    lying_normals,
    vertex_normals,
    with_sound_normals,
)
from datagen.foundation.meshes.ply import decode_ply, encode_ply
from datagen.library import Library

CC0 = Provenance(license="CC0-1.0")


def cube_mesh(with_uv: bool = True) -> Mesh:
    corners = np.array(
        [[x, y, z] for z in (0.0, 1.0) for y in (-0.5, 0.5) for x in (-0.5, 0.5)], dtype=np.float32
    )
    faces = [
        [0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
        [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5],
    ]  # fmt: skip
    uv = corners[:, :2] + 0.5 if with_uv else None
    mesh = Mesh(corners, np.array(faces, dtype=np.int32), None, uv)
    return Mesh(mesh.positions, mesh.faces, vertex_normals(mesh), uv)


def cube_asset(texture: str = "", **changes: object) -> ObjectAsset:
    albedo = Texture(texture=texture, encoding="srgb") if texture else (0.2, 0.3, 0.4)
    fields: dict = {
        "id": "cube",
        "title": "Cube",
        "provenance": CC0,
        "category": "box",
        "materials": {"body": SlotMaterial(diffuse_albedo=albedo)},
        "parts": (Part(name="body", mesh="meshes/cube.ply", material="body"),),
        "minimum_m": (-0.5, -0.5, 0.0),
        "maximum_m": (0.5, 0.5, 1.0),
    }
    return ObjectAsset(**{**fields, **changes})


def checker(side: int = 8) -> bytes:
    grid = (np.indices((side, side)).sum(axis=0) % 2 * 255).astype(np.uint8)
    return encode_png(np.repeat(grid[..., None], 3, axis=2))


def cube_files(with_uv: bool = True) -> dict[str, bytes | Path]:
    return {"meshes/cube.ply": encode_ply(cube_mesh(with_uv)), "textures/c.png": checker()}


def make(path: Path, **changes: object) -> Package:
    return write_package(path, cube_asset("textures/c.png", **changes), cube_files())


def faults(package: Package) -> str:
    return "\n".join(map(str, check_package(package).errors))


def test_folder_and_zip_hold_the_same_content(tmp_path: Path) -> None:
    folder, archive = make(tmp_path / "cube"), make(tmp_path / "cube.zip")
    with archive:
        assert folder.sha256 == archive.sha256
        assert folder.asset == archive.asset
        assert archive.local_file("textures/c.png").read_bytes() == checker()
        unpacked = archive.local_file("textures/c.png")
        assert check_package(archive).errors == check_package(folder).errors == ()
    assert not unpacked.exists()


def test_zip_bytes_depend_on_content_alone(tmp_path: Path) -> None:
    make(tmp_path / "a.zip").close()
    (tmp_path / "other").mkdir()
    files = dict(reversed(cube_files().items()))
    source = tmp_path / "mesh.ply"
    source.write_bytes(bytes(files["meshes/cube.ply"]))  # type: ignore[arg-type]
    os.utime(source, (1, 1))
    files["meshes/cube.ply"] = source
    write_package(tmp_path / "other" / "b.zip", cube_asset("textures/c.png"), files).close()
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "other" / "b.zip").read_bytes()


def test_hash_depends_on_content_but_not_on_layout(tmp_path: Path) -> None:
    package = make(tmp_path / "cube")
    before = package.sha256
    description = tmp_path / "cube" / "asset.json"
    description.write_text(json.dumps(json.loads(description.read_text())))
    assert open_package(tmp_path / "cube").sha256 == before
    (tmp_path / "cube" / "notes.txt").write_text("not part of the asset")
    assert open_package(tmp_path / "cube").sha256 == before
    (tmp_path / "cube" / "textures" / "c.png").write_bytes(checker(16))
    assert open_package(tmp_path / "cube").sha256 != before


def test_zip_with_one_folder_inside(tmp_path: Path) -> None:
    make(tmp_path / "cube")
    with zipfile.ZipFile(tmp_path / "wrapped.zip", "w") as archive:
        for file in (tmp_path / "cube").rglob("*"):
            if file.is_file():
                archive.write(file, f"cube/{file.relative_to(tmp_path / 'cube')}")
    with open_package(tmp_path / "wrapped.zip") as package:
        assert package.sha256 == open_package(tmp_path / "cube").sha256


def test_existing_target_is_kept_by_default(tmp_path: Path) -> None:
    make(tmp_path / "cube")
    with pytest.raises(InputError, match="exists already"):
        make(tmp_path / "cube")
    write_package(tmp_path / "cube", cube_asset(title="New"), cube_files(), overwrite=True)
    assert open_package(tmp_path / "cube").asset.title == "New"
    assert [p.name for p in tmp_path.iterdir()] == ["cube"]


def test_failed_write_keeps_the_old_package(tmp_path: Path) -> None:
    make(tmp_path / "cube")

    def refuse(package: Package) -> None:
        raise InputError(*check_package(package).errors)

    bad = cube_asset("textures/c.png", maximum_m=(9.0, 9.0, 9.0))
    with pytest.raises(InputError, match=r"cube/asset.json: maximum_m") as caught:
        write_package(tmp_path / "cube", bad, cube_files(), overwrite=True, validate=refuse)
    assert "partial" not in str(caught.value)
    missing = {**cube_files(), "textures/c.png": tmp_path / "gone.png"}
    with pytest.raises(InputError, match=r"gone.png"):
        write_package(tmp_path / "second", cube_asset("textures/c.png"), missing)
    assert [p.name for p in tmp_path.iterdir()] == ["cube"]
    assert open_package(tmp_path / "cube").asset.maximum_m == (0.5, 0.5, 1.0)  # type: ignore[union-attr]


def test_writer_names_every_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        write_package(tmp_path / "cube", cube_asset("textures/c.png"), {})
    assert "parts[0].mesh" in str(caught.value)
    assert "materials.body.diffuse_albedo.texture" in str(caught.value)


def test_all_problems_of_a_folder_are_reported(tmp_path: Path) -> None:
    make(tmp_path / "cube")
    (tmp_path / "cube" / "meshes" / "cube.ply").unlink()
    (tmp_path / "cube" / "textures" / "c.png").unlink()
    (tmp_path / "cube" / "textures" / "c.png").symlink_to("/etc/hostname")
    with pytest.raises(InputError) as caught:
        open_package(tmp_path / "cube")
    assert "no such file" in str(caught.value)
    assert "symbolic link" in str(caught.value)
    assert len(caught.value.problems) == 2


def test_linked_folder_inside_a_package_is_refused(tmp_path: Path) -> None:
    make(tmp_path / "cube")
    (tmp_path / "cube" / "textures").rename(tmp_path / "elsewhere")
    (tmp_path / "cube" / "textures").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="symbolic link"):
        open_package(tmp_path / "cube")


def test_fifo_in_a_package_is_refused(tmp_path: Path) -> None:
    make(tmp_path / "cube")
    (tmp_path / "cube" / "meshes" / "cube.ply").unlink()
    os.mkfifo(tmp_path / "cube" / "meshes" / "cube.ply")
    with pytest.raises(InputError, match="not a regular file"):
        open_package(tmp_path / "cube")


@pytest.mark.parametrize("name", ["../x.ply", "/etc/passwd", "a/../../b.ply", "C:/x.ply", "..\\x.ply"])
def test_escaping_paths_in_the_description_are_refused(tmp_path: Path, name: str) -> None:
    make(tmp_path / "cube")
    description = tmp_path / "cube" / "asset.json"
    data = json.loads(description.read_text())
    data["parts"][0]["mesh"] = name
    description.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"parts\[0\].mesh.*relative path inside the folder"):
        open_package(tmp_path / "cube")


def hostile_zip(path: Path, member: zipfile.ZipInfo | str, data: bytes = b"x") -> Path:
    make(path).close()
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(member, data)
    return path


def special(kind: int) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo("meshes/special")
    info.external_attr = (kind | 0o777) << 16
    return info


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", "a/../../evil", "c:evil", "a//b"])
def test_zip_members_that_leave_the_package_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="points outside the archive"):
        open_package(hostile_zip(tmp_path / "z.zip", name))


def test_zip_links_devices_duplicates_and_bombs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="symbolic link"):
        open_package(hostile_zip(tmp_path / "a.zip", special(stat.S_IFLNK), b"/etc/passwd"))
    with pytest.raises(InputError, match="device"):
        open_package(hostile_zip(tmp_path / "b.zip", special(stat.S_IFCHR)))
    with pytest.warns(UserWarning), pytest.raises(InputError, match="occurs twice"):
        open_package(hostile_zip(tmp_path / "c.zip", "textures/c.png"))
    with pytest.raises(InputError, match="unpacked members: bytes"):
        open_package(hostile_zip(tmp_path / "d.zip", "bomb", bytes(80 << 20)))


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    make(tmp_path / "cube.zip").close()
    data = (tmp_path / "cube.zip").read_bytes()
    (tmp_path / "cut.zip").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"cut\.zip"):
        open_package(tmp_path / "cut.zip")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(InputError, match=r"no single asset\.json"):
        open_package(tmp_path / "other.zip")
    with pytest.raises(InputError, match="no such file or folder"):
        open_package(tmp_path / "absent")
    assert not is_package(tmp_path / "other.zip")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "asset.json").write_text('{"kind": "chair"}')
    with pytest.raises(InputError, match="'chair'; expected one of material, object, environment"):
        open_package(tmp_path / "broken")


def test_schema_problems_have_readable_fields(tmp_path: Path) -> None:
    make(tmp_path / "cube")
    description = tmp_path / "cube" / "asset.json"
    data = json.loads(description.read_text())
    data["materials"]["body"]["roughness"] = 1.4
    data["materials"]["body"]["colour"] = "red"
    description.write_text(json.dumps(data))
    with pytest.raises(InputError) as caught:
        open_package(tmp_path / "cube")
    text = str(caught.value)
    assert "materials.body.roughness" in text
    assert "materials.body.colour" in text


def test_textures_without_uvs_are_refused(tmp_path: Path) -> None:
    package = write_package(tmp_path / "cube", cube_asset("textures/c.png"), cube_files(with_uv=False))
    assert "without UVs; expected u and v, which its textures need" in faults(package)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)), "no triangles"),
        (Mesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32)), "zero area only"),
        (
            Mesh(
                np.array([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]], np.int32)
            ),
            "NaN or infinite",
        ),
        (Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 7]], np.int32)), "bad indices"),
    ],
)
def test_unusable_meshes_are_refused(tmp_path: Path, mesh: Mesh, message: str) -> None:
    package = write_package(tmp_path / "cube", cube_asset(), {"meshes/cube.ply": encode_ply(mesh)})
    assert message in faults(package)


def test_non_manifold_meshes_give_warnings(tmp_path: Path) -> None:
    cube = cube_mesh()
    fin = np.concatenate([cube.faces, [[0, 1, 7]]]).astype(np.int32)
    mesh = Mesh(cube.positions, fin, cube.normals, cube.uv)
    package = write_package(tmp_path / "cube", cube_asset(), {"meshes/cube.ply": encode_ply(mesh)})
    report = check_package(package)
    assert not report.errors
    assert "non-manifold" in "\n".join(map(str, report.warnings))


def test_a_sound_cube_has_no_faults_even_with_split_vertices() -> None:
    for mesh in (cube_mesh(), flat_shaded(cube_mesh())):
        found = inspect_mesh(mesh)
        assert (found.non_manifold_edges, found.inconsistent_edges, found.boundary_edges) == (0, 0, 0)
    flipped = cube_mesh().faces.copy()
    flipped[0] = flipped[0][::-1]
    assert inspect_mesh(Mesh(cube_mesh().positions, flipped)).inconsistent_edges == 3


def test_bad_images_are_refused(tmp_path: Path) -> None:
    import OpenEXR

    pixels = np.full((4, 4, 3), 0.5, np.float32)
    pixels[1, 2, 0] = np.nan
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"RGB": pixels}).write(str(tmp_path / "nan.exr"))
    material = Material(
        diffuse_albedo=Texture(texture="nan.exr", encoding="linear"),
        roughness=Texture(texture="cut.png", encoding="linear", channel="r"),
        opacity=Texture(texture="rgb.png", encoding="linear", channel="a"),
    )
    asset = MaterialAsset(id="m", title="M", provenance=CC0, material=material)
    files = {"nan.exr": tmp_path / "nan.exr", "cut.png": checker()[:60], "rgb.png": checker()}
    text = faults(write_package(tmp_path / "m", asset, files))
    assert "material.diffuse_albedo = 'nan.exr': 1 NaN" in text
    assert "material.roughness = 'cut.png'" in text
    assert "material.opacity.channel = 'a'" in text


def test_zero_area_light_is_refused(tmp_path: Path) -> None:
    light = AreaLight(
        name="lamp", origin_m=(0, 0, 2), edge_u_m=(1, 0, 0), edge_v_m=(2, 0, 0), radiance=(1, 1, 1)
    )
    asset = EnvironmentAsset(
        id="room",
        title="Room",
        provenance=CC0,
        materials={"body": SlotMaterial()},
        parts=(Part(name="body", mesh="cube.ply", material="body"),),
        lights=(light,),
    )
    package = write_package(tmp_path / "room", asset, {"cube.ply": encode_ply(cube_mesh())})
    assert "lights[0] (lamp)" in faults(package)
    assert "area above zero" in faults(package)


def test_environment_light_of_8_bits_is_refused(tmp_path: Path) -> None:
    light = EnvironmentLight(name="sky", image="textures/c.png")
    package = write_package(tmp_path / "cube", cube_asset(lights=(light,)), cube_files())
    assert "lights[0] (sky).image = 'textures/c.png': not an EXR file" in faults(package)
    with Library([tmp_path]) as library, pytest.raises(InputError, match="expected a linear EXR image"):
        environment_radiance(light.model_copy(update={"asset": "cube"}), library)


def test_flattened_part_is_refused(tmp_path: Path) -> None:
    flat = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 0), (0, 0, 0, 1))
    part = Part(name="body", mesh="meshes/cube.ply", material="body", asset_from_part=flat)
    package = write_package(tmp_path / "cube", cube_asset(parts=(part,)), cube_files())
    assert "parts[0] (body).asset_from_part = a singular matrix" in faults(package)


def test_object_off_the_ground_is_refused(tmp_path: Path) -> None:
    mesh = cube_mesh()
    raised = Mesh(mesh.positions + np.float32([0, 0, 0.2]), mesh.faces, mesh.normals, mesh.uv)
    asset = cube_asset(minimum_m=(-0.5, -0.5, 0.2), maximum_m=(0.5, 0.5, 1.2))
    package = write_package(tmp_path / "cube", asset, {"meshes/cube.ply": encode_ply(raised)})
    assert "rests on the plane z = 0" in faults(package)


def test_ply_round_trip_and_foreign_layouts() -> None:
    mesh = cube_mesh()
    again = decode_ply(encode_ply(mesh), "cube.ply")
    for name in ("positions", "normals", "uv", "faces"):
        np.testing.assert_array_equal(getattr(again, name), getattr(mesh, name))
    ascii_ply = (
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "property float s\nproperty float t\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
        "0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n0 1 0 0 1\n4 0 1 2 3\n"
    )
    quad = decode_ply(ascii_ply.encode(), "quad.ply")
    assert quad.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert quad.uv is not None
    spaced = ascii_ply.replace("\n4 0", "\n\n4 0").replace(
        "element vertex", "comment end_header\nelement vertex"
    )
    assert decode_ply(spaced.encode(), "spaced.ply").faces.tolist() == quad.faces.tolist()
    with pytest.raises(InputError, match="ends early"):
        decode_ply(encode_ply(mesh)[:-5], "cut.ply")
    with pytest.raises(InputError, match="no PLY header"):
        decode_ply(b"solid stl", "x.ply")
    with pytest.raises(InputError, match="0 to"):
        decode_ply(encode_ply(mesh).replace(b"vertex 8", b"vertex 999999999999"), "huge.ply")


def test_normals_that_cancel_or_are_missing_follow_a_surface() -> None:
    """Where normals of opposite triangles cancel, an arbitrary replacement could be in their plane."""
    positions = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1]], np.float32)
    mesh = Mesh(positions, np.array([[0, 1, 2], [2, 1, 0]], np.int32))
    normals = vertex_normals(mesh)
    np.testing.assert_allclose(np.abs(normals[:3]), [[1, 0, 0]] * 3, atol=1e-6)
    given = np.array([[0, 0, 0], [np.nan, 0, 0], [0.6, 0.8, 0], [0, 1, 0]], np.float32)
    mended, num_changed = with_sound_normals(Mesh(positions, mesh.faces[:1], given))
    assert num_changed == 2
    assert mended.normals is not None
    np.testing.assert_allclose(
        mended.normals[mended.faces[0]], [[1, 0, 0], [1, 0, 0], [0.6, 0.8, 0]], atol=1e-6
    )


def test_normals_in_the_plane_of_their_surface_are_repaired_with_a_warning(tmp_path: Path) -> None:
    cube = cube_mesh()
    assert cube.normals is not None
    normals = cube.normals.copy()
    normals[0] = [1, 0, 0]
    bad = Mesh(cube.positions, cube.faces, normals, cube.uv)
    num_lying = int(lying_normals(bad).sum())
    assert num_lying > 0
    package = write_package(tmp_path / "cube", cube_asset(), {"meshes/cube.ply": encode_ply(bad)})
    assert f"{num_lying} normals" in "\n".join(map(str, check_package(package).warnings))
    mended, num_changed = with_sound_normals(bad)
    assert num_changed == num_lying
    assert not lying_normals(mended).any()
    np.testing.assert_allclose(mended.areas(), bad.areas())


def test_opening_reads_only_descriptions(tmp_path: Path) -> None:
    parts = tuple(Part(name=f"p{k}", mesh="meshes/cube.ply", material="body") for k in range(800))
    write_package(tmp_path / "cube", cube_asset(parts=parts), cube_files())
    (tmp_path / "cube" / "meshes" / "cube.ply").write_bytes(b"ply not really")
    start = time.process_time()  # elapsed time would depend on the machine's load
    open_package(tmp_path / "cube")
    assert time.process_time() - start < 1.0
