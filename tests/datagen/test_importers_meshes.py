# SPDX-License-Identifier: MIT
"""OBJ, PLY, STL and Blender's formats: sizes, colours, units, and paths."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from typer.testing import CliRunner

from datagen.cli import app
from datagen.formats.asset import ObjectAsset, Texture
from datagen.formats.package import open_package
from datagen.foundation.budget import Limits
from datagen.foundation.errors import InputError
from datagen.foundation.meshes.obj import corner_indices
from datagen.foundation.meshes.ply import decode_ply
from datagen.importers.command import ImportWords
from datagen.importers.common import ImportedAsset, ImportOptions
from datagen.importers.dispatch import import_asset
from datagen.importers.watch import group_sentences, summary_lines

SIZE = (1.6, 0.5, 0.8)  # extents of a sofa in metres, Z up
OPTIONS = ImportOptions(license="CC0-1.0")


def box(scale: float = 1.0) -> trimesh.Trimesh:
    return trimesh.creation.box(extents=np.array(SIZE) * scale)


def asset_of(record: ImportedAsset) -> ObjectAsset:
    with open_package(record.path) as package:
        assert isinstance(package.asset, ObjectAsset)
        return package.asset


def size_of(record: ImportedAsset) -> np.ndarray:
    asset = asset_of(record)
    return np.array(asset.maximum_m) - np.array(asset.minimum_m)


def write_obj(folder: Path, texture: str = "") -> Path:
    """Write an OBJ box with Y up, half oak (with ``texture``, if given) and half steel; return its path."""
    mesh = box()
    points = np.asarray(mesh.vertices)[:, [0, 2, 1]] * [1, 1, -1]  # Z up to Y up
    lines = ["mtllib sofa.mtl", *(f"v {x} {y} {z}" for x, y, z in points)]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1"]
    for k, face in enumerate(np.asarray(mesh.faces) + 1):
        lines += [f"usemtl {'oak' if k < 6 else 'steel'}"] if k in (0, 6) else []
        lines.append("f " + " ".join(f"{v}/{t}" for v, t in zip(face, (1, 2, 3), strict=True)))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sofa.obj").write_text("\n".join(lines) + "\n")
    oak = "newmtl oak\nKd 0.5 0.3 0.1\nNs 90\n" + (f"map_Kd {texture}\n" if texture else "")
    (folder / "sofa.mtl").write_text(oak + "newmtl steel\nKd 0 0 0\nKs 0.56 0.57 0.58\nNs 640\nillum 3\n")
    return folder / "sofa.obj"


def test_obj_keeps_size_materials_and_triangles(tmp_path: Path) -> None:
    (record,) = import_asset(write_obj(tmp_path), tmp_path / "library", OPTIONS)
    np.testing.assert_allclose(size_of(record), SIZE, atol=1e-5)
    asset = asset_of(record)
    oak, steel = asset.materials["oak"], asset.materials["steel"]
    np.testing.assert_allclose(oak.diffuse_albedo, (0.5, 0.3, 0.1), atol=1e-6)
    assert oak.roughness == pytest.approx(1 - np.sqrt(0.09)) and oak.classes[0] == "wood"
    np.testing.assert_allclose(steel.specular_albedo, (0.56, 0.57, 0.58), atol=1e-6)
    assert max(steel.diffuse_albedo) == 0 and steel.roughness == pytest.approx(0.2)
    with open_package(record.path) as package:
        meshes = [decode_ply(package.read_bytes(part.mesh), part.mesh) for part in asset.parts]
    assert sum(len(mesh.faces) for mesh in meshes) == 12
    for mesh in meshes:  # winding survives the change of axes, so normals point outwards
        corners = mesh.triangles()
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert ((corners.mean(1) - [0, 0, SIZE[2] / 2]) * normal).sum(1).min() > 0


def test_corners_of_different_kinds_are_distinguished() -> None:
    """One corner lacks a UV and another has a normal, so there are as many indices as for uniform corners."""
    corners = [b"%d/%d" % (k + 1, 300 - k) for k in range(300)]
    corners[1], corners[2] = b"2", b"3/298/7"
    found = corner_indices(corners, (300, 300, 9))
    np.testing.assert_array_equal(found[:, 0], np.arange(300))
    assert found[1].tolist() == [1, -1, -1] and found[2].tolist() == [2, 297, 6]
    assert (found[3:, 2] == -1).all() and found[299].tolist() == [299, 0, -1]


def test_obj_textures_are_copied(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (8, 8, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "oak.png")
    (record,) = import_asset(write_obj(tmp_path, "oak.png"), tmp_path / "library", OPTIONS)
    albedo = asset_of(record).materials["oak"].diffuse_albedo
    assert isinstance(albedo, Texture) and albedo.encoding == "srgb"
    stored = np.array(Image.open(record.path / albedo.texture).convert("RGB"))
    np.testing.assert_array_equal(stored, pixels)


def test_names_in_an_obj_stay_in_its_folder(tmp_path: Path) -> None:
    outside = tmp_path / "elsewhere"
    outside.mkdir()
    Image.new("RGB", (8, 8), (9, 9, 9)).save(outside / "oak.png")
    path = write_obj(tmp_path / "sofa", "../elsewhere/oak.png")
    with pytest.raises(InputError, match=r"sofa.obj: oak: map_Kd = .*outside the folder"):
        import_asset(path, tmp_path / "library", OPTIONS)
    allowed = ImportOptions(license="CC0-1.0", allowed=(outside,))
    assert import_asset(path, tmp_path / "library", allowed)


def test_missing_files_of_an_obj_are_refused_or_reported(tmp_path: Path) -> None:
    path = write_obj(tmp_path, "gone.png")
    with pytest.raises(InputError, match=r"gone.png' \(no such file\); expected a PNG or JPEG"):
        import_asset(path, tmp_path / "library", OPTIONS)
    path.with_suffix(".mtl").unlink()
    with pytest.raises(InputError, match=r"mtllib = 'sofa.mtl' \(no such file\)"):
        import_asset(path, tmp_path / "library", OPTIONS)
    (record,) = import_asset(path, tmp_path / "library", ImportOptions(license="CC0-1.0", missing="replace"))
    assert any("missing materials" in sentence for sentence in record.approximations)


@pytest.mark.parametrize("suffix", [".stl", ".ply"])
@pytest.mark.parametrize(("scale", "unit"), [(1.0, ""), (100.0, "centimetres"), (1000.0, "millimetres")])
def test_units_are_guessed_and_reported(tmp_path: Path, suffix: str, scale: float, unit: str) -> None:
    box(scale).export(tmp_path / f"sofa{suffix}")
    (record,) = import_asset(tmp_path / f"sofa{suffix}", tmp_path / "library", OPTIONS)
    np.testing.assert_allclose(size_of(record), SIZE, rtol=1e-5)
    sentences = [note for note in record.notes if "taken as" in note]
    assert [unit in note for note in sentences] == ([True] if unit else [])


def test_a_given_unit_is_used(tmp_path: Path) -> None:
    box(100).export(tmp_path / "sofa.stl")
    given = ImportOptions(license="CC0-1.0", unit_scale=0.02)
    (record,) = import_asset(tmp_path / "sofa.stl", tmp_path / "library", given)
    np.testing.assert_allclose(size_of(record), 2 * np.array(SIZE), rtol=1e-5)


def test_stl_as_text_and_round_shapes_are_imported(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    (tmp_path / "ball.stl").write_text(trimesh.exchange.stl.export_stl_ascii(ball))
    (record,) = import_asset(tmp_path / "ball.stl", tmp_path / "library", OPTIONS)
    with open_package(record.path) as package:
        mesh = decode_ply(package.read_bytes(asset_of(record).parts[0].mesh), "ball")
    radial = (mesh.positions - [0, 0, 0.1]) / 0.1
    assert mesh.normals is not None
    assert (radial * mesh.normals).sum(1).min() > 0.99  # smooth, not faceted
    assert len(mesh.positions) == len(ball.vertices)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("cut.stl", bytes(80) + b"\x09\0\0\0" + bytes(99), "without facets; the header states 9 triangles"),
        ("odd.stl", b"solid x\nvertex 1 2 x\n", "could not convert"),
        ("nan.stl", b"solid x\n" + b"vertex nan 0 0\n" * 3, "NaN or infinite"),
        ("points.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
         b"property float z\nend_header\n0 0 0\n", "points without faces"),
        ("broken.obj", b"v 0 0 0\nf 1 2 3\n", "a face refers to entry 3 of 1"),
        ("none.obj", b"v 0 0 0\n", "no faces"),
    ],
)  # fmt: skip
def test_damaged_files_are_refused(tmp_path: Path, name: str, data: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError) as caught:
        import_asset(tmp_path / name, tmp_path / "library", OPTIONS)
    assert message in str(caught.value) and name in str(caught.value)


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj"])
def test_readers_spend_the_budget(tmp_path: Path, suffix: str) -> None:
    """A fan of 4,000 triangles around one vertex exceeds the limit of pairs, whose number is quadratic."""
    ring = [(np.cos(a), np.sin(a), 0.1 * (k % 2)) for k, a in enumerate(np.linspace(0, 6.28, 4000))]
    faces = [(0, k, k + 1) for k in range(1, len(ring))]
    fan = trimesh.Trimesh([(0, 0, 0), *ring], faces, process=False)
    path = tmp_path / f"fan{suffix}"
    fan.export(path)
    if suffix == ".obj":
        path.write_text("s 1\n" + path.read_text())
    with pytest.raises(InputError, match=r"(pairs|triangles) = \d+ or more"):
        import_asset(path, tmp_path / "library", ImportOptions(license="CC0-1.0", limits=Limits(pairs=1000)))


def test_ascii_faces_with_numbers_around_the_list(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 4\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "element face 2\nproperty uchar flags\nproperty list uchar int vertex_indices\n"
    body = "property float area\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n7 4 0 1 2 3 0.5\n7 3 1 2 3 0.5\n"
    mesh = decode_ply((head + body).encode(), "a.ply")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 2, 3]]


# --- through Blender --------------------------------------------------------------------------------------

_MAKE = """
import sys, bpy
from pathlib import Path
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_cube_add(size=1)
thing = bpy.context.object
thing.name, thing.dimensions = "sofa", (1.6, 0.5, 0.8)
bpy.ops.object.transform_apply(scale=True)
paint = bpy.data.materials.new("red_fabric")
paint.use_nodes = True
node = paint.node_tree.nodes["Principled BSDF"]
node.inputs["Base Color"].default_value = (0.6, 0.1, 0.05, 1)
node.inputs["Roughness"].default_value = 0.7
thing.data.materials.append(paint)
out = Path(sys.argv[1])
bpy.ops.export_scene.fbx(filepath=str(out / "sofa.fbx"))
bpy.ops.wm.usd_export(filepath=str(out / "sofa.usdc"))
bpy.ops.wm.save_as_mainfile(filepath=str(out / "sofa.blend"))
bpy.ops.export_scene.gltf(filepath=str(out / "sofa.glb"), export_draco_mesh_compression_enable=True)
import os
os._exit(0)
"""


@pytest.fixture(scope="module")
def from_blender(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("bpy is not installed")
    folder = tmp_path_factory.mktemp("blender")
    subprocess.run([sys.executable, "-c", _MAKE, str(folder)], check=True, capture_output=True)
    return folder


@pytest.mark.bpy
@pytest.mark.parametrize("suffix", [".fbx", ".usdc", ".blend", ".glb"])
def test_files_that_blender_reads_are_imported(from_blender: Path, tmp_path: Path, suffix: str) -> None:
    path = from_blender / f"sofa{suffix}"
    if suffix == ".glb":
        assert b"KHR_draco_mesh_compression" in path.read_bytes()
    (record,) = import_asset(path, tmp_path / "library", OPTIONS)
    np.testing.assert_allclose(size_of(record), SIZE, rtol=2e-3)  # Draco rounds to 14 bits
    (material,) = asset_of(record).materials.values()
    np.testing.assert_allclose(material.diffuse_albedo, (0.6, 0.1, 0.05), atol=0.01)
    assert material.roughness == pytest.approx(0.7, abs=0.1)


@pytest.mark.bpy
def test_files_that_blender_cannot_read_are_refused(from_blender: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.fbx").write_bytes(b"Kaydara FBX Binary  \0\x1a\0" + bytes(200))
    with pytest.raises(InputError, match=r"broken.fbx: Blender: .*; expected a file that it can read"):
        import_asset(tmp_path / "broken.fbx", tmp_path / "library", OPTIONS)


def test_without_blender_a_remedy_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name, package=None: None)
    (tmp_path / "sofa.fbx").write_bytes(b"x")
    with pytest.raises(InputError, match=r"pip install 'scene-materials\[blender\]' .* or export glTF"):
        import_asset(tmp_path / "sofa.fbx", tmp_path / "library", OPTIONS)


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "extensions": {
            "KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}}}]}]}, "Blender's module"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 36, "extensions": {
            "EXT_meshopt_compression": {"buffer": 0, "byteLength": 36}}}]},
         r"gltfpack -noq -i IN\.glb -o OUT\.glb"),
        ({"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
          "textures": [{"extensions": {"KHR_texture_basisu": {"source": 0}}}],
          "images": [{"uri": "x.ktx2"}]}, r"ktx extract IN\.ktx2 OUT\.png"),
    ],
)  # fmt: skip
def test_compressed_gltf_names_a_converter(
    tmp_path: Path, change: dict, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name, package=None: None)
    (tmp_path / "data.bin").write_bytes(np.eye(3, dtype="<f4").tobytes())
    (tmp_path / "x.ktx2").write_bytes(b"\xabKTX 20\xbb\r\n\x1a\n")
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}], "materials": [{}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}], "buffers": [{"uri": "data.bin", "byteLength": 36}],
        **change,
    }  # fmt: skip
    (tmp_path / "thing.gltf").write_text(json.dumps(document))
    with pytest.raises(InputError, match=remedy):
        import_asset(tmp_path / "thing.gltf", tmp_path / "library", OPTIONS)


# --- output of an import ----------------------------------------------------------------------------------


def test_similar_sentences_are_merged() -> None:
    sentences = [f"part_{k}: roughness 0.{k} is the mean of its image" for k in range(30)]
    sentences += ["lamp: morph targets left out", "no colon here", "no colon here"]
    grouped = group_sentences(sentences)
    assert (
        grouped[0]
        == "part_0, part_1, part_2 and 27 more: roughness 0.0 is the mean of its image (figures differ)"
    )
    assert grouped[1:] == ["no colon here", "lamp: morph targets left out"]


def test_a_report_is_short_and_names_the_full_one(tmp_path: Path) -> None:
    kinds = ["alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta"]
    sentences = tuple(f"part: {kind} left out" for kind in kinds)
    record = ImportedAsset(
        "sofa", "object", tmp_path / "sofa", "0", "CC0-1.0", sentences, (), "1.60 × 0.50 × 0.80 m"
    )
    lines = summary_lines(record)
    assert lines[0].startswith("object sofa (CC0-1.0): 1.60 × 0.50 × 0.80 m; ")
    assert len(lines) == 8 and "2 more kinds, all of them in" in lines[-1]
    assert lines[-1].endswith("import.json")


def test_warnings_beyond_the_report_are_found_by_the_check(tmp_path: Path) -> None:
    book = "".join(f"v {x} {y} {z}\n" for x, y, z in [(0, 0, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0), (-1, 0, 0)])
    (tmp_path / "book.obj").write_text(book + "f 1 2 3\nf 1 2 4\nf 1 2 5\n")
    (record,) = import_asset(tmp_path / "book.obj", tmp_path / "library", OPTIONS)
    (warning,) = (note for note in record.notes if "non-manifold" in note)
    assert warning not in json.loads((record.path / "import.json").read_text())["notes"]
    many = replace(record, notes=tuple(f"book: {'x' * k}" for k in range(9)))
    (line,) = (line for line in summary_lines(many) if "more kinds" in line)
    assert line.endswith(f"import.json or, if warnings, `datagen library {record.path} --check`")
    result = CliRunner().invoke(app, ["library", str(record.path), "--check"])
    assert "1 non-manifold edges" in result.output


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (ImportWords(classes=("velvety",)), "--class"),
        (ImportWords(asset_id=7), "--id"),  # type: ignore[arg-type]
        (ImportWords(allowed=(7,)), "--allow"),  # type: ignore[arg-type]
        (ImportWords(tile_size_m=-1), "--tile-size"),
        (ImportWords(kind="thing"), "--kind"),
    ],
)
def test_faulty_options_are_named_as_on_the_command_line(words: ImportWords, option: str) -> None:
    with pytest.raises(InputError) as caught:
        words.parse()
    assert [problem.field for problem in caught.value.problems] == [option]


def test_the_command_prints_size_and_contents(tmp_path: Path) -> None:
    box(1000).export(tmp_path / "sofa.stl")
    arguments = ["import", str(tmp_path / "sofa.stl"), "--library", str(tmp_path / "library")]
    result = CliRunner().invoke(app, [*arguments, "--license", "CC0-1.0"])
    assert result.exit_code == 0, result.output
    assert "object sofa (CC0-1.0): 1.60 × 0.50 × 0.80 m, 1 part, 1 material; " in result.output
    assert "note: sofa: 1600 units long, taken as millimetres (1.6 m)" in result.output
