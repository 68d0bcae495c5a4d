# SPDX-License-Identifier: MIT
"""glTF files as packages: containers, geometry, materials, kinds, real furniture."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datagen.formats.asset import EnvironmentAsset, ObjectAsset, Texture
from datagen.formats.lights import PointLight
from datagen.formats.package import open_package
from datagen.formats.textures import texture_values
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png, read_image
from datagen.foundation.meshes.gltf import GltfFile
from datagen.foundation.meshes.ply import decode_ply
from datagen.importers.common import ImportOptions
from datagen.importers.dispatch import find_sources, import_asset
from datagen.importers.gltf import import_gltf

LICENSED = ImportOptions(license="CC0-1.0", overwrite=True)
QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0]], np.float32)  # in x-y, facing +z, 2 m tall
QUAD_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # glTF: v points down


class Builder:
    """Builder of a small glTF document with one buffer."""

    def __init__(self) -> None:
        self.data = b""
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": "panel"}],
            "meshes": [],
            "materials": [],
            "bufferViews": [],
            "accessors": [],
            "images": [],
            "textures": [],
        }

    def accessor(self, array: np.ndarray, kind: str, component: int) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.json["bufferViews"].append(view)
        self.data += array.tobytes()
        entry = {
            "bufferView": len(self.json["bufferViews"]) - 1,
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        self.json["accessors"].append(entry)
        return len(self.json["accessors"]) - 1

    def quad(self, material: int | None = 0, positions: np.ndarray = QUAD) -> Builder:
        primitive: dict[str, Any] = {
            "attributes": {
                "POSITION": self.accessor(positions, "VEC3", 5126),
                "TEXCOORD_0": self.accessor(QUAD_UV, "VEC2", 5126),
            },
            "indices": self.accessor(np.array([0, 1, 2, 0, 2, 3], np.uint16), "SCALAR", 5123),
        }
        if material is not None:
            primitive["material"] = material
        self.json["meshes"].append({"primitives": [primitive]})
        return self

    def image(self, uri: str) -> int:
        self.json["images"].append({"uri": uri})
        self.json["textures"].append({"source": len(self.json["images"]) - 1})
        return len(self.json["textures"]) - 1

    def material(self, **entry: Any) -> Builder:
        self.json["materials"].append({"name": f"Mat{len(self.json['materials'])}", **entry})
        return self

    def write(self, path: Path) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        document = {k: v for k, v in self.json.items() if v != []}
        if path.suffix == ".glb":
            document["buffers"] = [{"byteLength": len(self.data)}]
            text = json.dumps(document).encode()
            text += b" " * (-len(text) % 4)
            body = self.data + b"\0" * (-len(self.data) % 4)
            chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
            chunks += struct.pack("<II", len(body), 0x004E4942) + body
            path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
        else:
            uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
            document["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
            path.write_text(json.dumps(document))
        return path


def panel(tmp_path: Path, builder: Builder, options: ImportOptions = LICENSED, suffix: str = ".gltf") -> Any:
    path = builder.write(tmp_path / "source" / f"panel{suffix}")
    (record,) = import_gltf(path, tmp_path / "library", options)
    return record, open_package(record.path)


def noise(path: Path, low: int = 0, high: int = 255, seed: int = 0) -> np.ndarray:
    pixels = np.random.default_rng(seed).integers(low, high + 1, (16, 16, 3)).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(pixels))
    return pixels


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_axes_resting_plane_and_uvs(tmp_path: Path, suffix: str) -> None:
    _, package = panel(tmp_path, Builder().quad().material(), suffix=suffix)
    asset = package.asset
    assert isinstance(asset, ObjectAsset)
    np.testing.assert_allclose(asset.minimum_m, [-0.5, 0, 0], atol=1e-6)
    np.testing.assert_allclose(asset.maximum_m, [0.5, 0, 2], atol=1e-6)
    mesh = decode_ply(package.read_bytes("meshes/panel.ply"), "panel")
    assert mesh.normals is not None
    assert mesh.uv is not None
    np.testing.assert_allclose(mesh.normals, [[0, -1, 0]] * len(mesh.normals), atol=1e-6)  # faces -Y
    np.testing.assert_allclose(mesh.uv[:, 1], mesh.positions[:, 2] / 2, atol=1e-6)  # v points up
    cross = np.cross(*(mesh.triangles()[0, k] - mesh.triangles()[0, 0] for k in (1, 2)))
    assert cross[1] < 0
    assert asset.parts[0].uv_per_m == pytest.approx(np.sqrt(0.5), rel=1e-5)


def test_mirroring_nodes_keep_their_orientation(tmp_path: Path) -> None:
    builder = Builder().quad().material()
    builder.json["nodes"][0]["scale"] = [-1, 1, 1]
    _, package = panel(tmp_path, builder)
    mesh = decode_ply(package.read_bytes("meshes/panel.ply"), "panel")
    triangle = mesh.triangles()[0]
    assert np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])[1] < 0


def test_node_transforms_multiply_down_the_tree(tmp_path: Path) -> None:
    builder = Builder().quad().material()
    half = np.sqrt(0.5)
    builder.json["nodes"] = [
        {"children": [1], "translation": [0, 0, 5], "rotation": [0, half, 0, half]},
        {"mesh": 0, "name": "panel", "scale": [3, 1, 1]},
    ]
    path = builder.write(tmp_path / "t.gltf")
    with GltfFile(path) as file:
        (_, placed) = file.placed_nodes()
    np.testing.assert_allclose(placed.scene_from_node @ [1, 0, 0, 1], [0, 0, 2, 1], atol=1e-6)


def test_constants_stay_constants(tmp_path: Path) -> None:
    builder = Builder().quad()
    builder.material(
        pbrMetallicRoughness={
            "baseColorFactor": [0.8, 0.4, 0.2, 1],
            "metallicFactor": 0.25,
            "roughnessFactor": 0.7,
        },
        extensions={"KHR_materials_ior": {"ior": 1.8}, "KHR_materials_specular": {"specularFactor": 0.5}},
    )
    _, package = panel(tmp_path, builder)
    material = package.asset.materials["Mat0"]
    f0 = (0.8 / 2.8) ** 2 * 0.5
    np.testing.assert_allclose(material.diffuse_albedo, np.array([0.8, 0.4, 0.2]) * 0.75, rtol=1e-5)
    np.testing.assert_allclose(
        material.specular_albedo, f0 * 0.75 + np.array([0.8, 0.4, 0.2]) * 0.25, rtol=1e-5
    )
    assert material.roughness == 0.7
    assert package.names() == ("meshes/panel.ply",)


def test_plain_channels_are_not_resampled(tmp_path: Path) -> None:
    builder = Builder().quad()
    noise(tmp_path / "source" / "color.png")
    packed = noise(tmp_path / "source" / "arm.png", seed=1)
    packed[..., 2] = 1  # metalness 1/255 is compression noise
    (tmp_path / "source" / "arm.png").write_bytes(encode_png(packed))
    builder.material(
        pbrMetallicRoughness={
            "baseColorTexture": {"index": builder.image("color.png")},
            "metallicRoughnessTexture": {"index": builder.image("arm.png")},
            "roughnessFactor": 0.5,
        }
    )
    _, package = panel(tmp_path, builder)
    material = package.asset.materials["Mat0"]
    assert material.diffuse_albedo == Texture(texture="textures/color.png", encoding="srgb")
    assert material.specular_albedo == (0.04, 0.04, 0.04)
    assert material.roughness == Texture(
        texture="textures/arm.png", encoding="linear", channel="g", scale=0.5
    )
    for name in ("color.png", "arm.png"):
        assert package.read_bytes(f"textures/{name}") == (tmp_path / "source" / name).read_bytes()


def test_metal_textures_are_combined_texel_by_texel(tmp_path: Path) -> None:
    builder = Builder().quad()
    color = noise(tmp_path / "source" / "color.png")
    packed = noise(tmp_path / "source" / "arm.png", seed=1)
    builder.material(
        pbrMetallicRoughness={
            "baseColorTexture": {"index": builder.image("color.png")},
            "metallicRoughnessTexture": {"index": builder.image("arm.png")},
        }
    )
    _, package = panel(tmp_path, builder)
    material = package.asset.materials["Mat0"]
    base = texture_values(Texture(texture="c.png", encoding="srgb"), color, False)
    metal = packed[..., 2:].astype(np.float32) / 255
    expected = {"diffuse_albedo": base * (1 - metal), "specular_albedo": 0.04 * (1 - metal) + base * metal}
    for name, values in expected.items():
        texture = getattr(material, name)
        pixels = read_image(package.local_file(texture.texture))
        assert pixels.shape == color.shape
        got = texture_values(texture, pixels, False)
        # half a step of 8-bit sRGB is at most 0.0045 in linear values
        np.testing.assert_allclose(got, values, atol=0.0046)


def test_normals_opacity_and_emission(tmp_path: Path) -> None:
    builder = Builder().quad()
    flat = np.full((8, 8, 3), (178, 128, 230), np.uint8)
    (tmp_path / "source").mkdir()
    (tmp_path / "source" / "n.png").write_bytes(encode_png(flat))
    import cv2

    rgba = np.full((8, 8, 4), 200, np.uint8)
    rgba[:4, :, 3] = 20
    cv2.imwrite(str(tmp_path / "source" / "a.png"), rgba)
    builder.material(
        pbrMetallicRoughness={"baseColorTexture": {"index": builder.image("a.png")}, "metallicFactor": 0},
        normalTexture={"index": builder.image("n.png"), "scale": 2.0},
        alphaMode="MASK",
        alphaCutoff=0.5,
        emissiveFactor=[1, 0.5, 0.25],
        extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 8}},
    )
    _, package = panel(tmp_path, builder)
    material = package.asset.materials["Mat0"]
    assert material.emission == (8.0, 4.0, 2.0)
    assert isinstance(material.opacity, Texture)
    opacity = texture_values(material.opacity, read_image(package.local_file(material.opacity.texture)), True)
    np.testing.assert_array_equal(opacity, np.repeat([[0.0], [1.0]], 4, axis=0) * np.ones((1, 8)))
    assert material.normal is not None
    normal = read_image(package.local_file(material.normal.texture))[0, 0] / 255 * 2 - 1
    expected = np.array([2 * (178 / 127.5 - 1), 2 * (128 / 127.5 - 1), 230 / 127.5 - 1])
    np.testing.assert_allclose(normal, expected / np.linalg.norm(expected), atol=0.005)


def test_scaled_normals_of_similar_names_stay_apart(tmp_path: Path) -> None:
    builder = Builder().quad()
    for k, name in enumerate(("Wood 1", "wood-1")):
        noise(tmp_path / "source" / f"normal_{k}.png", seed=k)
        builder.material(name=name, normalTexture={"index": builder.image(f"normal_{k}.png"), "scale": 0.5})
    primitive = builder.json["meshes"][0]["primitives"][0]
    builder.json["meshes"][0]["primitives"].append({**primitive, "material": 1})
    record, package = panel(tmp_path, builder)
    names = [material.normal.texture for material in package.asset.materials.values()]
    assert "textures/wood-1_normal_scaled.png" in names
    first, second = (read_image(record.path / name) for name in names)
    assert (first != second).any()


@pytest.mark.parametrize("suffix", [".webp", ".tif"])
def test_alpha_of_converted_images_is_kept(tmp_path: Path, suffix: str) -> None:
    pixels = np.random.default_rng(6).integers(0, 255, (16, 16, 4)).astype(np.uint8)
    (tmp_path / "source").mkdir()
    Image.fromarray(pixels).save(tmp_path / "source" / f"leaf{suffix}", lossless=True)
    builder = Builder().quad()
    texture = {"index": builder.image(f"leaf{suffix}")}
    builder.material(alphaMode="BLEND", pbrMetallicRoughness={"baseColorTexture": texture})
    record, package = panel(tmp_path, builder)
    opacity = package.asset.materials["Mat0"].opacity
    assert opacity.channel == "a"
    np.testing.assert_array_equal(read_image(record.path / opacity.texture)[..., 3], pixels[..., 3])


def test_texture_transforms_move_the_uvs(tmp_path: Path) -> None:
    builder = Builder().quad()
    noise(tmp_path / "source" / "color.png")
    transform = {"offset": [0.25, 0.5], "scale": [2, 3], "rotation": 0.0}
    info = {"index": builder.image("color.png"), "extensions": {"KHR_texture_transform": transform}}
    builder.material(pbrMetallicRoughness={"baseColorTexture": info, "metallicFactor": 0})
    _, package = panel(tmp_path, builder)
    mesh = decode_ply(package.read_bytes("meshes/panel.ply"), "panel")
    assert mesh.uv is not None
    x, z = mesh.positions[:, 0] + 0.5, mesh.positions[:, 2] / 2
    down = 3 * (1 - z) + 0.5
    np.testing.assert_allclose(mesh.uv, np.stack([2 * x + 0.25, 1 - down], axis=1), atol=1e-5)


def test_glass_and_unknown_extensions_are_refused_by_name(tmp_path: Path) -> None:
    builder = Builder().quad().material(extensions={"KHR_materials_transmission": {"transmissionFactor": 1}})
    with pytest.raises(InputError, match=r"'Mat0'.*transmission 1"):
        panel(tmp_path, builder)
    record, _ = panel(tmp_path, builder, ImportOptions(license="CC0-1.0", dielectric="replace"))
    assert any("opal glass" in sentence for sentence in record.approximations)
    builder.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    with pytest.raises(InputError, match="KHR_draco_mesh_compression"):
        panel(tmp_path, builder)


@pytest.mark.parametrize(
    "uri", ["../secret.bin", "/etc/passwd", "http://example.com/x.bin", "%2e%2e/secret.bin"]
)
def test_files_outside_the_folder_are_refused(tmp_path: Path, uri: str) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(1000))
    path = Builder().quad().material().write(tmp_path / "source" / "panel.gltf")
    document = json.loads(path.read_text())
    document["buffers"][0]["uri"] = uri
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"a file inside|no such file"):
        import_gltf(path, tmp_path / "library", LICENSED)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda d: d["nodes"].append({"children": [1]}) or d["scenes"][0].update(nodes=[1]),
            "two parents or a cycle",
        ),
        (lambda d: d["accessors"][0].update(count=10_000), "10000 entries"),
        (lambda d: d["accessors"][0].update(bufferView=99), "an index below"),
        (lambda d: d["accessors"][0].update(byteOffset=-4), "offset -4; expected numbers of at least 0"),
        (lambda d: d["meshes"][0]["primitives"][0].update(material=7), "an index below 1 into materials"),
        (lambda d: d["asset"].update(version="1.0"), "2.0"),
        (lambda d: d["scenes"][0].update(nodes=[]), "no triangles"),
        (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), "no POSITION"),
    ],
)
def test_damaged_documents_are_refused(tmp_path: Path, damage: Any, message: str) -> None:
    path = Builder().quad().material().write(tmp_path / "panel.gltf")
    document = json.loads(path.read_text())
    damage(document)
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=message):
        import_gltf(path, tmp_path / "library", LICENSED)


def test_cut_binaries_and_foreign_files_are_refused(tmp_path: Path) -> None:
    path = Builder().quad().material().write(tmp_path / "panel.glb")
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"cut short|bytes"):
        import_gltf(path, tmp_path / "library", LICENSED)
    (tmp_path / "x.gltf").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="a glTF file"):
        import_gltf(tmp_path / "x.gltf", tmp_path / "library", LICENSED)


def test_strided_sparse_and_normalised_accessors(tmp_path: Path) -> None:
    builder = Builder()
    interleaved = np.arange(24, dtype=np.float32).reshape(4, 6)
    builder.accessor(interleaved, "VEC3", 5126)
    builder.json["bufferViews"][0]["byteStride"] = 24
    builder.accessor(np.array([0, 128, 255], np.uint8).reshape(-1, 1), "SCALAR", 5121)
    builder.json["accessors"][1]["normalized"] = True
    indices = builder.accessor(np.array([2], np.uint8), "SCALAR", 5121)
    values = builder.accessor(np.array([[7, 8, 9]], np.float32), "VEC3", 5126)
    sparse = {
        "count": 1,
        "indices": {"bufferView": indices, "componentType": 5121},
        "values": {"bufferView": values},
    }
    builder.json["accessors"].append({"componentType": 5126, "type": "VEC3", "count": 4, "sparse": sparse})
    with GltfFile(builder.write(tmp_path / "a.gltf")) as file:
        np.testing.assert_array_equal(file.accessor(0, "t"), interleaved[:, :3])
        np.testing.assert_allclose(file.accessor(1, "t")[:, 0], [0, 128 / 255, 1])
        expected = np.zeros((4, 3))
        expected[2] = [7, 8, 9]
        np.testing.assert_array_equal(file.accessor(4, "t"), expected)


def test_rooms_become_environments_with_lights_and_cameras(tmp_path: Path) -> None:
    builder = Builder().material()
    wall = np.array([[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]], np.float32)
    floor = wall[::-1].copy()
    sides = [np.array([[-2, 0, z], [2, 0, z], [2, 2.6, z], [-2, 2.6, z]], np.float32) for z in (-2, 2)]
    sides += [s[:, [2, 1, 0]] for s in sides]
    builder.json["nodes"] = []
    for k, quad in enumerate([floor, wall + np.array([0, 2.6, 0], np.float32), *sides]):
        builder.quad(0, np.ascontiguousarray(quad))
        builder.json["nodes"].append({"mesh": k, "name": f"side{k}"})
    builder.json["extensions"] = {
        "KHR_lights_punctual": {"lights": [{"type": "point", "intensity": 683.0, "color": [1, 0.5, 0.25]}]}
    }
    builder.json["nodes"].append(
        {"name": "bulb", "translation": [0, 2, 1], "extensions": {"KHR_lights_punctual": {"light": 0}}}
    )
    builder.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1.0, "aspectRatio": 1.5}}]
    builder.json["nodes"].append({"name": "eye", "translation": [0, 1.5, 1.5], "camera": 0})
    builder.json["scenes"][0]["nodes"] = list(range(len(builder.json["nodes"])))
    _, package = panel(tmp_path, builder)
    asset = package.asset
    assert isinstance(asset, EnvironmentAsset)
    (light,) = asset.lights
    assert isinstance(light, PointLight)
    np.testing.assert_allclose(light.intensity, [1, 0.5, 0.25])
    np.testing.assert_allclose(light.position_m, [0, -1, 2], atol=1e-9)
    camera = asset.cameras[0]
    assert (camera.width_px, camera.height_px) == (1080, 720)
    matrix = np.array(camera.asset_from_camera)
    np.testing.assert_allclose(matrix[:3, 2], [0, 1, 0], atol=1e-9)  # -Z of glTF becomes +Y
    np.testing.assert_allclose(matrix[:3, 1], [0, 0, -1], atol=1e-9)
    (surface,) = asset.support_surfaces
    assert surface.kind == "floor"
    assert len(asset.camera_regions) == 1


# ---- real furniture ---------------------------------------------------------------------------------


def test_images_of_furniture_are_copied_unchanged(tmp_path: Path, shared_data: Path) -> None:
    folder = shared_data / "furniture" / "living_room_polyhaven" / "assets"
    (record,) = import_gltf(folder / "wooden_table_02_1k.gltf", tmp_path, ImportOptions(category="table"))
    package = open_package(record.path)
    asset = package.asset
    assert isinstance(asset, ObjectAsset)
    assert asset.provenance.license == "CC0-1.0"
    assert asset.supports == ("floor",)
    assert 0.3 < asset.maximum_m[2] < 1.2
    material = asset.materials["wooden_table_02"]
    assert material.classes == ("wood",)
    assert material.normal is not None
    assert isinstance(material.diffuse_albedo, Texture)  # baked: its metalness is small but not constant
    for channel in (material.roughness, material.normal):
        assert isinstance(channel, Texture)
        source = folder / "textures" / Path(channel.texture).name
        assert package.read_bytes(channel.texture) == source.read_bytes()
    assert isinstance(material.roughness, Texture)
    assert material.roughness.channel == "g"


def test_a_set_can_be_split_into_objects(tmp_path: Path, shared_data: Path) -> None:
    path = shared_data / "furniture" / "living_room_polyhaven" / "assets" / "tea_set_01_1k.gltf"
    records = import_asset(path, tmp_path, split=True)
    assert len(records) == 8  # of ten nodes, because each of the two lids joins its pot
    for record in records:
        asset = open_package(record.path).asset
        assert isinstance(asset, ObjectAsset)
        assert asset.category == "crockery"
        assert max(asset.maximum_m) < 0.3
    pot = open_package(tmp_path / "objects" / "tea_set_01_teapot_01").asset
    assert isinstance(pot, ObjectAsset)
    assert len(pot.parts) == 2


def test_a_missing_image_is_refused_or_replaced_by_name(tmp_path: Path, shared_data: Path) -> None:
    path = shared_data / "furniture" / "living_room_polyhaven" / "assets" / "living_room.gltf"
    with pytest.raises(InputError, match=r"DoorMat.*wood_table_worn_nor_gl_1k\.png"):
        import_asset(path, tmp_path)
    (record,) = import_asset(path, tmp_path, ImportOptions(missing="replace"))
    asset = open_package(record.path).asset
    assert isinstance(asset, EnvironmentAsset)
    assert asset.materials["DoorMat"].normal is None
    assert [s.kind for s in asset.support_surfaces] == ["floor"]
    (region,) = asset.camera_regions
    assert region.maximum_m[0] - region.minimum_m[0] > 5
    (opening,) = asset.openings
    assert np.cross(opening.edge_u_m, opening.edge_v_m)[1] > 0  # the window is at -y and faces inwards


def test_sources_are_found_and_unknown_ones_refused(tmp_path: Path, shared_data: Path) -> None:
    assert {s.kind for s in find_sources(shared_data / "textures" / "ambientcg")} == {"material"}
    assert len(find_sources(shared_data / "scenes")) == 6
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(InputError, match="a Mitsuba scene"):
        find_sources(tmp_path / "notes.txt")
    with pytest.raises(InputError, match="no such file or folder"):
        find_sources(tmp_path / "absent")
    with pytest.raises(InputError, match="no --id, since several"):
        import_asset(shared_data / "textures" / "ambientcg", tmp_path, ImportOptions(asset_id="x"))
    with pytest.raises(InputError, match="lower-case"):
        import_asset(
            shared_data / "textures" / "ambientcg" / "gold", tmp_path, ImportOptions(asset_id="Gold!")
        )
