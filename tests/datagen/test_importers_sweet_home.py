# SPDX-License-Identifier: MIT
"""Sweet Home 3D furniture libraries: catalogue, sizes, rotation, materials, refusals, resuming."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from datagen.formats.asset import ObjectAsset, Texture
from datagen.formats.package import Package, open_package
from datagen.foundation.budget import Budget
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import decode_ply
from datagen.importers.classes import guess_category, guess_supports
from datagen.importers.common import ImportOptions
from datagen.importers.dispatch import find_sources, import_asset
from datagen.importers.obj_model import PhongMaterial, read_mtl, read_obj_model, triangulate
from datagen.importers.sweet_home import Step, import_sweet_home
from datagen.importers.sweet_home_catalogue import (
    CATALOGUE_FILE,
    open_catalogue,
    parse_properties,
    spdx_license,
)
from datagen.importers.sweet_home_materials import phong_channels, phong_roughness
from datagen.library import check_library
from tests.conftest import REPOSITORY
from tests.hostile import damage

FURNITURE = Path("/usr/share/sweethome3d/furniture")  # path of the Debian package
REPLACE = ImportOptions(dielectric="replace", missing="replace")
BOX_FACES = ((1, 2, 3, 4), (5, 8, 7, 6), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 8, 4), (5, 1, 4, 8))
MTL = """
newmtl oak
Kd 0.5 0.25 0.125
Ks 0.5 0.5 0.5
Ns 98
d 1.0
illum 2
map_Kd -s 1 1 1 C:/Somebody's folder/Planks.PNG
newmtl chrome_leg
Kd 0.3 0.3 0.3
Ks 0.8 0.8 0.8
Ns 500
illum 2
newmtl matt
Kd 1 1 1
Ks 0.9 0.9 0.9
illum 1
newmtl clear
Kd 0.8 0.9 0.9
Ks 0.5 0.5 0.5
Ns 98
d 0.25
illum 2
newmtl ghost
Kd 1 1 1
d 0.0
newmtl leaf
Kd 1 1 1
map_Kd leaf.png
"""


def box_obj(size: tuple[float, float, float], material: str, *, offset: int = 0, uv: bool = True) -> str:
    """Return OBJ text of a box from the origin to ``size``, with y up, the front at +z and outward faces."""
    x, y, z = size
    corners = [(0, 0, z), (x, 0, z), (x, y, z), (0, y, z), (0, 0, 0), (x, 0, 0), (x, y, 0), (0, y, 0)]
    lines = [f"v {a} {b} {c}" for a, b, c in corners]
    if uv:
        lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    lines += [f"usemtl {material}"]
    for face in BOX_FACES:
        words = [f"{k + offset}/{j + 1}" if uv else f"{k + offset}" for j, k in enumerate(face)]
        lines.append("f " + " ".join(words))
    return "\n".join(lines) + "\n"


class Sh3f:
    """Builder of a Sweet Home 3D furniture library."""

    def __init__(
        self, license_: str = "Creative Commons Attribution 3.0 Unported license © Ann Maker"
    ) -> None:
        self.head = f"id=Test#Models\nlicense={license_}\nprovider=www.example.org\n"
        self.entries: list[str] = []
        self.files: dict[str, bytes] = {}

    def piece(self, name: str, obj: str | None = None, mtl: str = MTL, **keys: object) -> Sh3f:
        k = len(self.entries) + 1
        values = {
            "id": f"Test#{name}",
            "name": name,
            "category": "Living room",
            "model": f"/m/{name}/{name}.obj",
            "width": 40,
            "depth": 30,
            "height": 20,
            "movable": "true",
            "doorOrWindow": "false",
            "creator": "Bob",
        } | keys
        self.entries.append("".join(f"{key}#{k}={value}\n" for key, value in values.items()))
        if obj is not None:
            self.files[f"m/{name}/{name}.obj"] = f"mtllib {name}.mtl\n{obj}".encode()
            self.files[f"m/{name}/{name}.mtl"] = mtl.encode()
        return self

    def write(self, path: Path) -> Path:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(CATALOGUE_FILE, (self.head + "\n".join(self.entries)).encode("latin-1"))
            for name, data in self.files.items():
                archive.writestr(name, data)
        return path


def planks(seed: int = 3, channels: int = 3) -> bytes:
    """Return a PNG file of 8 x 8 pixels; with four channels its upper half is transparent."""
    import cv2

    pixels = np.random.default_rng(seed).integers(40, 200, (8, 8, channels), dtype=np.uint8)
    if channels == 3:
        return encode_png(pixels)
    pixels[..., 3] = np.where(np.arange(8) < 4, 0, 255)[:, None]
    done, data = cv2.imencode(".png", pixels)
    assert done
    return data.tobytes()


def import_one(tmp_path: Path, sh3f: Sh3f, options: ImportOptions = REPLACE) -> tuple[ObjectAsset, Package]:
    [record] = import_sweet_home(sh3f.write(tmp_path / "one.sh3f"), tmp_path / "library", options)
    package = open_package(record.path)
    assert isinstance(package.asset, ObjectAsset)
    return package.asset, package


def mesh_of(package: Package, index: int = 0) -> Mesh:
    asset = package.asset
    assert isinstance(asset, ObjectAsset)
    return decode_ply(package.read_bytes(asset.parts[index].mesh), "mesh")


# the catalogue


def test_properties_are_read_as_java_reads_them() -> None:
    text = "# c\n! c\n a\\ b = x \\\n   y\nunicode:\\u00e9t\\u00E9\nplain value\nempty\nback=C\\:\\\\d\n"
    table = parse_properties(text.encode())
    assert table == {"a b": "x y", "unicode": "été", "plain": "value", "empty": "", "back": "C:\\d"}
    assert parse_properties("who=©".encode("latin-1")) == {"who": "©"}


@pytest.mark.parametrize(
    ("text", "spdx"),
    [
        ("http://creativecommons.org/choose/zero/", "CC0-1.0"),
        ("Creative Commons Attribution 3.0 United States license http://creativecommons.org/licenses/by/3.0/us/",
         "CC-BY-3.0-US"),
        ("Creative Commons Attribution 3.0 Unported license", "CC-BY-3.0"),
        ("Free Art License", "LAL-1.3"),
        ("All rights reserved", ""),
        ("http://creativecommons.org/choose/zero/ or Attribution 4.0", ""),
    ],
)  # fmt: skip
def test_licences_are_recognised_and_never_invented(text: str, spdx: str) -> None:
    assert spdx_license(text) == spdx


def test_a_piece_without_any_licence_is_refused(tmp_path: Path) -> None:
    path = Sh3f("ask me").piece("crate", box_obj((4, 2, 3), "oak")).write(tmp_path / "x.sh3f")
    with pytest.raises(InputError, match=r"Test#crate: license.*--license"):
        import_sweet_home(path, tmp_path / "library", REPLACE)


# geometry


def test_a_piece_has_the_catalogue_size_upright_and_with_its_front_to_minus_y(tmp_path: Path) -> None:
    # The model has 2 x 1 x 3 units, its axes are scaled separately, and a second part marks the front (+z).
    mark = "v 0 0 3\nv 2 0 3\nv 2 1 3\nusemtl matt\nf 9 10 11\n"
    sh3f = Sh3f().piece("crate", box_obj((2, 1, 3), "oak") + mark)
    sh3f.files["m/crate/planks.png"] = planks()
    asset, package = import_one(tmp_path, sh3f)
    assert np.allclose(asset.minimum_m, (-0.2, -0.15, 0), atol=1e-6)
    assert np.allclose(asset.maximum_m, (0.2, 0.15, 0.2), atol=1e-6)
    front = mesh_of(package, [p.material for p in asset.parts].index("matt"))
    assert np.allclose(front.positions[:, 1], -0.15, atol=1e-6)
    outward = mesh_of(package).triangles()
    normals = np.cross(outward[:, 1] - outward[:, 0], outward[:, 2] - outward[:, 0])
    centres = outward.mean(axis=1) - [0, 0, 0.1]
    assert ((normals * centres).sum(axis=1) > 0).all()
    note = json.loads((package.path / "import.json").read_text())["notes"]
    assert any("stretched" in line for line in note)


def test_the_rotation_of_the_catalogue_comes_before_the_size(tmp_path: Path) -> None:
    # the model is on its back (z up); "1 0 0  0 0 1  0 -1 0" turns it upright
    sh3f = Sh3f().piece("post", box_obj((1, 1, 5), "matt"), modelRotation="1 0 0 0 0 1 0 -1 0",
                        width=10, depth=10, height=50)  # fmt: skip
    asset, package = import_one(tmp_path, sh3f)
    assert np.allclose(asset.maximum_m, (0.05, 0.05, 0.5), atol=1e-6)
    assert not json.loads((package.path / "import.json").read_text())["notes"]


def test_concave_polygons_are_cut_inside_their_outline() -> None:
    outline = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [3, 4, 0], [3, 1, 0], [0, 1, 0]], float)
    for axes in ([0, 1, 2], [2, 0, 1], [0, 2, 1]):
        points = outline[:, axes]
        for turned in (points, points[::-1]):
            cut = turned[triangulate(turned, Budget("x"))]
            crosses = np.cross(cut[:, 1] - cut[:, 0], cut[:, 2] - cut[:, 0])
            assert len(cut) == 4
            assert np.isclose(0.5 * np.linalg.norm(crosses, axis=1).sum(), 7)  # a fan would cover more
            assert np.isclose(0.5 * np.linalg.norm(crosses.sum(axis=0)), 7)  # all triangles face the same way
    dart = b"v 0 0 0\nv 1 1 0\nv 0 3 0\nv -1 1 0\nv 0 2 0\nf 1 2 5 4\nf 2 5 4 1\n"
    model = read_obj_model(dart.replace(b"f 2 5 4 1\n", b""), "dart.obj", Budget("x"))
    assert np.isclose(model.surfaces[0].mesh.areas().sum(), 2 * 0.5 * 1 * 2)


def test_normals_are_smooth_within_a_smoothing_group_and_creased_at_sharp_edges() -> None:
    angle = np.linspace(0, 2 * np.pi, 13)[:-1]
    ring = [(np.cos(a), y, np.sin(a)) for y in (0, 2) for a in angle]
    lines = [f"v {x:.9f} {y} {z:.9f}" for x, y, z in ring]
    sides = [f"f {k + 1} {k + 13} {(k + 1) % 12 + 13} {(k + 1) % 12 + 1}" for k in range(12)]
    cap = ["f " + " ".join(str(k + 13) for k in range(12)[::-1])]
    smooth = (
        read_obj_model("\n".join([*lines, "s 1", *sides, *cap]).encode(), "can.obj", Budget("x"))
        .surfaces[0]
        .mesh
    )
    assert smooth.normals is not None
    radial = smooth.positions * [1, 0, 1]
    on_side = np.abs(smooth.normals[:, 1]) < 0.5
    assert np.allclose(smooth.normals[on_side], radial[on_side], atol=1e-4)
    assert np.allclose(smooth.normals[~on_side], [0, 1, 0], atol=1e-5)
    assert len(smooth.positions) == 36  # vertices are shared on the side and split at the rim
    flat = (
        read_obj_model("\n".join([*lines, "s off", *sides]).encode(), "can.obj", Budget("x")).surfaces[0].mesh
    )
    assert len(flat.positions) == 48


def test_duplicate_faces_and_lines_are_skipped() -> None:
    text = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nl 1 2\nf 1 2\nf 1 2 3\nf 3 2 1\nf -3 -2 -1\n"
    assert len(read_obj_model(text, "x.obj", Budget("x")).surfaces[0].mesh.faces) == 1


# materials


def test_phong_is_converted_to_d_s_and_r() -> None:
    table = read_mtl(MTL.encode(), "x.mtl")
    plastic = phong_channels(PhongMaterial((0.5, 0.5, 0.5), (0.5, 0.5, 0.5), exponent=98), is_metal=False)
    assert np.allclose(plastic.diffuse, 0.2140, atol=1e-3)  # 0.5 in sRGB
    assert np.allclose(plastic.specular, 0.04)
    assert np.isclose(plastic.roughness, 0.02**0.25, atol=1e-4)
    chrome = phong_channels(table["chrome_leg"], is_metal=True)
    assert chrome.diffuse == (0, 0, 0) and np.allclose(chrome.specular, 0.0732 + 0.6038, atol=1e-3)
    matt = phong_channels(table["matt"], is_metal=False)
    assert matt.roughness == 1 and matt.diffuse == (0.9,) * 3 and matt.specular == (0.02,) * 3
    dark = phong_channels(PhongMaterial((0.1,) * 3, (0.3,) * 3, exponent=50), is_metal=True)
    assert max(dark.diffuse) > 0 and max(dark.specular) < 0.05  # painted, not bare metal
    assert phong_channels(table["matt"], is_metal=True, is_mirror=True).roughness == 0
    theta = (np.arange(200_000) + 0.5) / 200_000 * (np.pi / 2)
    for n in (0.0, 10.0, 1000.0):  # normalised half-vector densities have equal peaks
        peak = 1 / (2 * np.pi * (np.cos(theta) ** (n + 1) * np.sin(theta)).mean() * (np.pi / 2))
        assert np.isclose(peak, 1 / (np.pi * phong_roughness(n) ** 4), rtol=1e-4)


def test_textures_are_not_tinted_and_cut_outs_keep_their_opacity(tmp_path: Path) -> None:
    model = box_obj((4, 2, 3), "oak") + box_obj((4, 2, 3), "leaf", offset=8)
    sh3f = Sh3f().piece("crate", model)
    sh3f.files["m/crate/planks.png"] = planks()
    sh3f.files["m/crate/leaf.png"] = planks(channels=4)
    asset, package = import_one(tmp_path, sh3f)
    oak, leaf = asset.materials["oak"], asset.materials["leaf"]
    assert isinstance(oak.diffuse_albedo, Texture) and oak.diffuse_albedo.scale == 1  # no tint by Kd
    assert package.read_bytes(oak.diffuse_albedo.texture) == planks()
    assert oak.classes == ("wood",) and oak.replaceable_by == ("wood", "painted") and oak.opacity is None
    assert isinstance(leaf.opacity, Texture) and leaf.opacity.channel == "a" and leaf.replaceable_by == ()
    assert asset.provenance.license == "CC-BY-3.0"
    assert asset.provenance.author == "Bob (Ann Maker)"
    assert asset.provenance.source == "www.example.org, Test#Models, Test#crate"


def test_see_through_materials_follow_the_policy(tmp_path: Path) -> None:
    pane = "v 1 1 1\nv 3 1 1\nv 3 1 2\nv 1 1 2\nusemtl clear\nf 13 14 15 16\n".replace(
        "13 14 15 16", "9 10 11 12"
    )
    bowl = box_obj((4, 2, 3), "clear", uv=False)
    sh3f = Sh3f().piece("crate", box_obj((4, 2, 3), "matt", uv=False) + pane).piece("bowl", bowl)
    path = sh3f.write(tmp_path / "x.sh3f")
    with pytest.raises(InputError) as refused:
        import_sweet_home(path, tmp_path / "refused")
    assert [str(p) for p in refused.value.problems] == [
        f"{path}: Test#{name}: material 'clear' = transparent (d 0.25); expected opaque materials: the "
        "project's BSDF does not transmit light; import with --dielectric replace, or choose with "
        "--dielectric-as NAME=opaque|remove"
        for name in ("crate", "bowl")
    ]
    crate, bowl_record = import_sweet_home(path, tmp_path / "library", REPLACE)
    asset = open_package(crate.path).asset
    assert isinstance(asset, ObjectAsset) and list(asset.materials) == ["matt"]  # the inner pane is omitted
    assert any("panes left out" in line for line in crate.approximations)
    bowl_asset = open_package(bowl_record.path).asset
    assert isinstance(bowl_asset, ObjectAsset)
    diffuse = bowl_asset.materials["clear"].diffuse_albedo
    assert isinstance(diffuse, tuple) and 0.65 < diffuse[0] < 0.75  # opal glass
    assert any("opal" in line for line in bowl_asset.materials["clear"].approximations)


def test_a_glass_table_keeps_its_top(tmp_path: Path) -> None:
    top = "v -1 2 -1\nv 5 2 -1\nv 5 2 4\nv -1 2 4\nusemtl clear\nf 9 10 11 12\n"
    ghost = "v -9 0 0\nv -9 1 0\nv -9 0 1\nusemtl ghost\nf 13 14 15\n"
    model = box_obj((4, 2, 3), "chrome_leg", uv=False) + top + ghost
    asset, _ = import_one(tmp_path, Sh3f().piece("glass_table", model, width=140, depth=50))
    assert list(asset.materials) == ["chrome_leg", "clear"]  # the transparent ghost is omitted
    assert np.isclose(asset.maximum_m[1] - asset.minimum_m[1], 0.5, atol=1e-6)


# supports


def test_floor_standing_furniture_is_never_put_on_a_table(tmp_path: Path) -> None:
    sh3f = (
        Sh3f()
        .piece("Stool", box_obj((1, 1, 1), "matt"), width=35, depth=35, height=58)
        .piece("Zydeco", box_obj((1, 1, 1), "matt"), width=35, depth=35, height=58)
        .piece("Vase", box_obj((1, 1, 1), "matt"), width=25, depth=25, height=50)
        .piece("Mug", box_obj((1, 1, 1), "matt"), width=9, depth=9, height=10)
        .piece("Cupboard", box_obj((1, 1, 1), "matt"), elevation=145)
        .piece("Pane", box_obj((1, 1, 1), "matt"), doorOrWindow="true")
        .piece("Small chair with cushion", box_obj((1, 1, 1), "matt"), height=38)
    )
    records = import_sweet_home(sh3f.write(tmp_path / "x.sh3f"), tmp_path / "library", REPLACE)
    assets = [open_package(r.path).asset for r in records]
    supports = {a.title: a.supports for a in assets if isinstance(a, ObjectAsset)}
    assert supports["Stool"] == supports["Zydeco"] == supports["Small chair with cushion"] == ("floor",)
    assert supports["Vase"] == ("floor", "table", "counter") and "table" in supports["Mug"]
    assert supports["Cupboard"] == supports["Pane"] == ()  # hung on a wall, so never placed
    assert {a.title: a.category for a in assets if isinstance(a, ObjectAsset)}["Stool"] == "seat"


def test_categories_and_supports_follow_from_names() -> None:
    assert guess_category("chair with cushion") == "seat" and guess_category("table lamp") == "lamp"
    assert guess_supports("rug", 0.01, 0.6) == ("floor",)
    assert guess_supports("", 0.58, 0.4) == ("floor",)
    assert guess_supports("", 0.3, 0.3) == ("table", "shelf", "counter", "sill")


# a whole catalogue


def catalogue_with_faults() -> Sh3f:
    rng = np.random.default_rng(7)
    sh3f = Sh3f()
    for k in range(4):
        size = tuple(rng.uniform(1, 4, 3))
        sh3f.piece(
            f"box{k}", box_obj(size, "matt"), width=size[0] * 10, height=size[1] * 10, depth=size[2] * 10
        )
    sh3f.piece("absent")  # no such model
    sh3f.piece("broken", "v 0 0 0\nv 1 0 0\nf 1 2 9\n")
    sh3f.piece("empty", "v 0 0 0\n")
    sh3f.piece("wide", box_obj((1, 1, 1), "matt"), width="wide", depth=-3, height=0)
    sh3f.piece("nan", box_obj((1, 1, 1), "matt").replace("v 1 0 1", "v nan 0 1"))
    sh3f.piece("spun", box_obj((1, 1, 1), "matt"), modelRotation="1 0 0 0 2 0 0 0 1")
    sh3f.piece("scanned", model="/m/x.dae")
    sh3f.piece("untextured", box_obj((1, 1, 1), "oak"))  # its image is missing
    sh3f.piece("colourless", box_obj((1, 1, 1), "unheard_of"))
    return sh3f


def test_faults_are_named_and_the_other_pieces_imported(tmp_path: Path) -> None:
    path = catalogue_with_faults().write(tmp_path / "x.sh3f")
    steps: list[Step] = []
    with pytest.raises(InputError) as refused:
        import_sweet_home(path, tmp_path / "library", on_step=lambda step, total: steps.append(step))
    assert len(steps) == 13
    assert [s.name for s in steps if s.outcome == "imported"] == [f"Test#box{k}" for k in range(4)]
    messages = "\n".join(str(p) for p in refused.value.problems)
    for sentence in (
        "absent.obj: no such file in the catalogue",
        "broken.obj: a face refers to entry 9 of 2",
        "empty.obj: no faces",
        "Test#wide: width = 'wide'",
        "Test#wide: depth = '-3'",
        "Test#wide: height = '0'",
        "nan.obj: NaN or infinite vertices",
        "Test#spun: modelRotation",
        "Test#scanned: model = 'm/x.dae'",
        "Test#untextured: material 'oak' = 'Planks.PNG' (no such file)",
        "Test#colourless: materials = missing material 'unheard_of'",
    ):
        assert sentence in messages
    assert check_library([tmp_path / "library"]).errors == ()


def test_a_truncated_archive_names_its_missing_pieces(tmp_path: Path) -> None:
    path = Sh3f().piece("one", box_obj((1, 1, 1), "matt")).piece("two", box_obj((1, 1, 1), "matt"))
    file = path.write(tmp_path / "x.sh3f")
    data = bytearray(file.read_bytes())
    at = data.find(b"mtllib two.mtl")
    data[at + 20 : at + 60] = b"#" * 40  # the checksum of one member is wrong
    file.write_bytes(data)
    with pytest.raises(InputError, match=r"two\.obj: Bad CRC") as refused:
        import_sweet_home(file, tmp_path / "library", REPLACE)
    assert len(refused.value.problems) == 1 and (tmp_path / "library/objects/test-one").is_dir()
    (tmp_path / "cut.sh3f").write_bytes(bytes(data[: len(data) // 2]))
    with pytest.raises(InputError, match="Sweet Home 3D furniture library"):
        import_sweet_home(tmp_path / "cut.sh3f", tmp_path / "library")
    with zipfile.ZipFile(tmp_path / "other.sh3f", "w") as archive:
        archive.writestr("a.txt", "no catalogue")
    with pytest.raises(InputError, match=f"no {CATALOGUE_FILE}"):
        open_catalogue(tmp_path / "other.sh3f", Budget("x"))


def test_damaged_files_are_read_or_refused(tmp_path: Path) -> None:
    rng = random.Random(5)
    outcomes = []
    for k in range(60):
        model = box_obj((4, 2, 3), "oak") + box_obj((2, 1, 1), "clear", offset=8)
        sh3f = Sh3f().piece("crate", model, modelRotation="1 0 0 0 0 1 0 -1 0")
        sh3f.files["m/crate/planks.png"] = planks()
        victim = rng.choice(["m/crate/crate.obj", "m/crate/crate.mtl", "m/crate/planks.png", "", "zip"])
        if victim in sh3f.files:
            sh3f.files[victim] = damage(sh3f.files[victim], rng)
        elif not victim:
            sh3f.head = damage((sh3f.head + sh3f.entries.pop()).encode(), rng).decode("latin-1")
        path = sh3f.write(tmp_path / "x.sh3f")
        if victim == "zip":
            path.write_bytes(damage(path.read_bytes(), rng))
        try:
            outcomes.append(len(import_sweet_home(path, tmp_path / f"library{k}", REPLACE)))
        except InputError:
            outcomes.append(-1)
    assert {-1, 1} <= set(outcomes)


def test_an_interrupted_import_resumes(tmp_path: Path) -> None:
    path = catalogue_with_faults().write(tmp_path / "x.sh3f")
    library = tmp_path / "library"
    done: list[Step] = []

    def interrupt(step: Step, total: int) -> None:
        done.append(step)
        if [s.outcome for s in done].count("imported") == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_sweet_home(path, library, on_step=interrupt)
    stamps = {p: p.stat().st_mtime_ns for p in library.rglob("asset.json")}
    assert len(stamps) == 2
    again: list[Step] = []
    with pytest.raises(InputError):
        import_sweet_home(path, library, on_step=lambda step, total: again.append(step))
    assert [s.outcome for s in again].count("kept") == 2 and [s.outcome for s in again].count("imported") == 2
    assert all(p.stat().st_mtime_ns == stamp for p, stamp in stamps.items())
    # another package of that name is neither kept nor overwritten
    other = Sh3f().piece("box0", box_obj((1, 1, 1), "matt"))
    other.head = other.head.replace("Test#Models", "Other#Models")
    with pytest.raises(InputError, match="has another source"):
        import_sweet_home(other.write(tmp_path / "other.sh3f"), library)


def test_options_for_single_assets_are_refused(tmp_path: Path) -> None:
    path = Sh3f().piece("one", box_obj((1, 1, 1), "matt")).write(tmp_path / "x.sh3f")
    options = ImportOptions(asset_id="chair", unit_scale=0.01, kind="material")
    with pytest.raises(InputError) as refused:
        import_sweet_home(path, tmp_path / "library", options)
    assert [p.field for p in refused.value.problems] == ["kind", "id", "unit-scale"]


def test_the_command_prints_a_summary_and_names_refused_pieces(tmp_path: Path) -> None:
    catalogue_with_faults().write(tmp_path / "x.sh3f")
    assert [s.kind for s in find_sources(tmp_path)] == ["sweet_home"]
    command = [
        sys.executable,
        "-m",
        "datagen",
        "import",
        str(tmp_path),
        "--library",
        str(tmp_path / "library"),
    ]
    result = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY)
    assert result.returncode == 2
    assert "x.sh3f: Test#wide: width = 'wide'" in result.stderr
    table = [line.split("│")[1:-1] for line in result.stdout.splitlines() if line.startswith("│ all")]
    assert [[word.strip() for word in row] for row in table] == [["all", "4", "0", "9"]]


# the real files


@pytest.fixture(scope="module")
def furniture() -> Path:
    if not FURNITURE.is_dir():
        pytest.skip("no Sweet Home 3D furniture here: apt-get install sweethome3d-furniture (120 MB)")
    return FURNITURE


def test_real_people_models_keep_their_size(furniture: Path, tmp_path: Path) -> None:
    path = furniture / "Reallusion.sh3f"
    with open_catalogue(path, Budget("x")) as catalogue:
        sizes = {p.name: p.size_m for p in catalogue.pieces[:1]}
        whole = len(catalogue.pieces)
    steps: list[Step] = []

    def stop_after_two(step: Step, total: int) -> None:
        steps.append(step)
        assert total == whole == 25
        if len(steps) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_sweet_home(path, tmp_path, on_step=stop_after_two)
    record = steps[0].record
    assert record is not None and record.license == "CC-BY-3.0-US"
    asset = open_package(record.path).asset
    assert isinstance(asset, ObjectAsset) and asset.category == "person"
    size = np.array(asset.maximum_m) - np.array(asset.minimum_m)
    width, depth, height = sizes[asset.title]
    assert np.allclose(size, (width, depth, height), atol=1e-4)


@pytest.mark.slow
def test_every_real_model_imports_and_passes_the_check(furniture: Path, tmp_path: Path) -> None:
    steps: list[Step] = []
    for path in sorted(furniture.glob("*.sh3f")):
        import_sweet_home(path, tmp_path, REPLACE, on_step=lambda step, total: steps.append(step))
    assert len(steps) == 820 and {s.outcome for s in steps} == {"imported"}
    report = check_library([tmp_path])
    assert report.num_packages == 820 and report.errors == ()


def test_import_asset_opens_furniture_libraries(tmp_path: Path) -> None:
    path = Sh3f().piece("one", box_obj((1, 1, 1), "matt")).write(tmp_path / "x.sh3f")
    [record] = import_asset(path, tmp_path / "library")
    assert record.path == tmp_path / "library" / "objects" / "test-one"
