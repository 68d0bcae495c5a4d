# SPDX-License-Identifier: MIT
"""The full pipeline on a rendered room: shard to atlas, asset, glTF and Mitsuba scene; and the asset rendered
again."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.asset_check import check_package
from datagen.formats.asset import EnvironmentAsset, Texture
from datagen.formats.capture import Capture
from datagen.formats.configuration import Configuration
from datagen.formats.package import open_package
from datagen.formats.recipe import RenderRecipe
from datagen.formats.textures import texture_values
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.color import exposure_for, linear_from_srgb, srgb_from_linear
from datagen.foundation.errors import InputError
from datagen.foundation.images import read_image
from datagen.geometry.traced import TracedGeometry
from datagen.importers.common import ImportOptions
from datagen.importers.gltf import import_gltf
from datagen.library import Library
from datagen.rendering.renderer import SceneRenderer
from model.checkpoint import CheckpointCard, save_checkpoint
from model.confidence import ConfidenceNets
from model.networks import MaterialNetwork, NetworkConfig
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from model.reconstruction.export.metallic_textures import as_read, metallic_channels
from model.reconstruction.infer import InferOptions, InferReport, infer
from model.reconstruction.predict.sources import TRUTH, CheckpointMaps, GivenMaps
from model.reconstruction.render.relight import Insertion, RelightOptions, render_asset, write_renders
from oracles.textured_room import room_capture
from tests.model.rendered_capture import SIZE, make_shard

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
SAMPLES = 64
SMALL_SIZE = (SIZE[0] // 2, SIZE[1] // 2)


@dataclass(frozen=True)
class Rendered:
    """A shard, its configuration and library, and a checkpoint of random weights."""

    root: Path
    shard: Path
    configuration: Configuration
    library: Library
    checkpoint: Path

    def capture(self) -> Capture:
        return read_capture(self.shard)

    def small_capture(self) -> Capture:
        """The capture with views of :data:`SMALL_SIZE`."""
        return read_capture(self.shard, CaptureOptions(max_width_px=SMALL_SIZE[0]))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> Iterator[Rendered]:
    root = tmp_path_factory.mktemp("capture")
    shard, configuration, library = make_shard(root)
    torch.manual_seed(3)
    network = NetworkConfig(base_channels=4, global_channels=8)
    card = CheckpointCard(network=network, loss="none", phase="untrained", step=0)
    save_checkpoint(root / "random.safetensors", card, MaterialNetwork(network), ConfidenceNets())
    yield Rendered(root, shard, configuration, library, root / "random.safetensors")
    library.close()


@pytest.fixture(scope="module")
def truth(rendered: Rendered) -> tuple[Path, InferReport]:
    """Reconstruction of the room from ground-truth maps."""
    out = rendered.root / "truth"
    report = infer(rendered.capture(), out, TRUTH, InferOptions(atlas=512))
    return out, report


def test_geometry_of_a_shard_equals_the_rendered_one(rendered: Rendered) -> None:
    capture = rendered.capture()
    traced = TracedGeometry(capture.geometry)
    for view in capture.views[:3]:
        stored = view.source.read_maps(("depth_z_m", "normal_world"))
        seen = traced.trace_view(view.camera)
        np.testing.assert_allclose(seen.depth_z_m, stored["depth_z_m"], rtol=1e-4, atol=1e-4)
        cosine = (seen.normal_world * stored["normal_world"].astype(np.float32)).sum(axis=-1)
        assert np.mean(cosine[seen.face >= 0] > 0.99) > 0.9  # the rest: pixels at edges


def psnr(a: np.ndarray, b: np.ndarray, exposure: float) -> float:
    """PSNR (dB) of exposed, clipped, sRGB-encoded images."""
    x, y = (np.clip(srgb_from_linear(image.astype(np.float64) * exposure), 0, 1) for image in (a, b))
    return float(-10 * np.log10(np.mean((x - y) ** 2)))


def test_asset_renders_like_the_room(rendered: Rendered, truth: tuple[Path, InferReport]) -> None:
    """Both renderings are denoised at 64 samples; noise limits them to about 40 dB. Other differences are
    rounding of texels (8 bits), texture finer than the views' pixels, and mixed pixels at edges: a tenth of
    the pixels off by 6 % yields 34 dB. Radiance 5 % too bright is detected."""
    out, _ = truth
    recipe = RenderRecipe(
        variant="llvm_ad_rgb", path_samples=SAMPLES, auxiliary_samples=SAMPLES, denoise=True
    )
    renderer = SceneRenderer(rendered.configuration, rendered.library, recipe)
    names = [camera.name for camera in rendered.configuration.cameras]
    chosen = (0, 1, 3)
    options = RelightOptions(
        samples=SAMPLES,
        denoise=True,
        seed=rendered.configuration.seed,
        views=tuple(names[k] for k in chosen),
    )
    again = {image.name: image.color for image in render_asset(out / "asset", options)}
    scores, brighter = [], []
    for index in chosen:
        original = renderer.render_view(index).buffers["beauty"].astype(np.float32)
        exposure = exposure_for(original)
        scores.append(psnr(original, again[names[index]], exposure))
        brighter.append(psnr(original, again[names[index]] * 1.05, exposure))
    renderer.close()
    assert min(scores) > 33, scores
    assert np.mean(brighter) < np.mean(scores) - 0.5, (scores, brighter)


def test_atlas_contains_the_rooms_materials(rendered: Rendered, truth: tuple[Path, InferReport]) -> None:
    """The median over each part's seen texels has the values of its material."""
    out, report = truth
    assert report.atlas_size == 512 and 0.3 < report.seen_share <= 1
    asset = open_package(out / "asset").asset
    assert isinstance(asset, EnvironmentAsset)
    material = asset.materials["surface"]
    mask = read_image(out / "atlas" / "mask.png")[..., 0]
    pixels = read_image(out / "atlas" / "diffuse_albedo.png")
    diffuse = texture_values(material.diffuse_albedo, pixels, False)  # type: ignore[arg-type]
    exr = read_image(out / "atlas" / "diffuse_albedo.exr")
    np.testing.assert_allclose(diffuse, exr, atol=0.006)
    for albedo in ((0.7, 0.66, 0.6), (0.8, 0.8, 0.8), (0.3, 0.2, 0.1)):  # walls, ceiling, table
        close = (np.abs(diffuse - np.array(albedo)).max(axis=-1) < 0.02) & (mask == 255)
        assert close.sum() > 500, albedo
    assert (mask == 128).any() and (mask == 0).any()


def test_asset_is_a_valid_package(truth: tuple[Path, InferReport]) -> None:
    with open_package(truth[0] / "asset") as package:
        assert check_package(package).errors == ()
        assert isinstance(package.asset, EnvironmentAsset)
        assert len(package.asset.cameras) == 8 and len(package.asset.lights) == 2


def test_glb_round_trips_to_the_same_materials(truth: tuple[Path, InferReport], tmp_path: Path) -> None:
    out, report = truth
    assert report.gltf_error["diffuse_max"] < 0.01 and report.gltf_error["specular_max"] < 0.01
    glb = out / "capture-00000.glb"
    (imported,) = import_gltf(glb, tmp_path, ImportOptions(kind="environment", license="CC0-1.0"))
    with open_package(imported.path) as package:
        asset = package.asset
        assert isinstance(asset, EnvironmentAsset)
        material = asset.materials["surface"]
        for name, channel, is_scalar in (
            ("diffuse_albedo", material.diffuse_albedo, False),
            ("specular_albedo", material.specular_albedo, False),
            ("roughness", material.roughness, True),
        ):
            if isinstance(channel, Texture):
                stored = read_image(package.local_file(channel.texture))
                got = texture_values(channel, stored, is_scalar).reshape(512, 512, -1)
            else:
                got = np.broadcast_to(channel, (512, 512, 1 if is_scalar else 3))
            np.testing.assert_allclose(
                got, read_image(out / "atlas" / f"{name}.exr"), atol=0.011, err_msg=name
            )
        with open_package(out / "asset") as original:
            kept = original.asset
            assert isinstance(kept, EnvironmentAsset)
            from datagen.foundation.meshes.ply import decode_ply

            a = decode_ply(original.read_bytes("surface.ply"), "a")
            b = decode_ply(package.read_bytes(asset.parts[0].mesh), "b")
            np.testing.assert_allclose(
                np.sort(a.positions[a.faces].mean(axis=1), axis=0),
                np.sort(b.positions[b.faces].mean(axis=1), axis=0),
                atol=1e-4,
            )


def test_normals_break_at_creases_only() -> None:
    """Without normals, a welded cube gets flat sides and a sphere stays smooth; UVs and faces are kept."""
    import trimesh

    from datagen.foundation.meshes.mesh import Mesh
    from datagen.geometry.crease_normals import with_normals

    for shape, num in ((trimesh.creation.box(), 24), (trimesh.creation.icosphere(3), 642)):
        uv = np.random.default_rng(0).random((len(shape.vertices), 2)).astype(np.float32)
        plain = Mesh(shape.vertices.astype(np.float32), shape.faces.astype(np.int32), None, uv)
        made = with_normals(plain)
        assert len(made.positions) == num and made.normals is not None and made.uv is not None
        np.testing.assert_array_equal(made.triangles(), plain.triangles())
        np.testing.assert_array_equal(made.uv[made.faces], uv[plain.faces])
        along = (made.normals[made.faces] * shape.face_normals[:, None]).sum(axis=-1)
        assert along.min() > (0.9999 if num == 24 else 0.98)
    # a floor with a narrow bevel to a wall: the floor's corner normals hardly tilt
    xs, zs = [0, 3, 3.02, 3.02], [0, 0, 0.012, 2.5]
    points = np.array([[x, y, z] for x, z in zip(xs, zs, strict=True) for y in (0.0, 4.0)], np.float32)
    faces = np.array([f for k in (0, 2, 4) for f in ([k, k + 2, k + 1], [k + 1, k + 2, k + 3])], np.int32)
    made = with_normals(Mesh(points, faces))
    assert made.normals is not None
    assert made.normals[made.faces[:2]][..., 2].min() > 0.9999


def test_large_atlases_are_averaged_down_in_the_glb(truth: tuple[Path, InferReport], tmp_path: Path) -> None:
    """The report contains the texture size; its conversion error does not include the averaging."""
    from PIL import Image

    from model.reconstruction.atlas.atlas import empty_atlas
    from model.reconstruction.export import atlas_images, gltf
    from model.reconstruction.export.asset import Reconstruction

    report = truth[1]
    assert report.gltf_error["texture_px"] == report.atlas_size == 512
    capture = room_capture(2, (32, 24))
    atlas = empty_atlas(64)
    atlas.face[:] = 0
    atlas.maps["diffuse_albedo"][:, ::2] = 0.8
    reconstruction = Reconstruction(capture, capture.geometry.mesh, atlas, tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(atlas_images, "MAX_TEXTURE", 32)
        error = gltf.write_glb(tmp_path / "small.glb", reconstruction)
    assert error.texture_px == 32 and error.diffuse_max < 0.01
    data = (tmp_path / "small.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    first = 28 + length + view["byteOffset"]
    image = Image.open(io.BytesIO(data[first : first + view["byteLength"]]))
    assert image.size == (32, 32)
    linear = linear_from_srgb(np.asarray(image)[..., :3] / 255.0)
    np.testing.assert_allclose(linear, 0.4, atol=0.005)


def test_a_shard_finds_its_library(
    rendered: Rendered, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The library of --library is used, else that of the dataset folder, else a bundled one of equal hash."""
    from model.reconstruction.captures import rendered as reader

    alone = tmp_path / "alone.tar"
    alone.write_bytes(rendered.shard.read_bytes())
    with pytest.raises(InputError, match="room-0"):
        read_capture(alone)
    given = read_capture(alone, CaptureOptions(library=(rendered.root / "library",)))
    monkeypatch.setattr(reader, "bundled_library", lambda: rendered.root / "library")
    bundled = read_capture(alone)
    for capture in (given, bundled):
        np.testing.assert_array_equal(
            capture.geometry.mesh.positions, rendered.capture().geometry.mesh.positions
        )


def test_metallic_conversion_keeps_dielectrics_and_metals() -> None:
    """Dielectrics are kept exactly, and metals within 0.03."""
    rng = np.random.default_rng(0)
    diffuse = rng.random((50, 3)).astype(np.float32)
    specular = rng.uniform(0, 0.16, (50, 3)).astype(np.float32)
    d, s = as_read(*metallic_channels(diffuse, specular))
    np.testing.assert_allclose(d, diffuse, atol=1e-6)
    np.testing.assert_allclose(s, specular, atol=1e-6)
    metal = rng.uniform(0.3, 0.95, (50, 3)).astype(np.float32)
    d, s = as_read(*metallic_channels(np.zeros_like(metal), metal))
    assert np.abs(d).max() < 0.03 and np.abs(s - metal).max() < 0.03
    base, metallic, _ = metallic_channels(np.zeros((1, 3), np.float32), np.full((1, 3), 0.9, np.float32))
    assert metallic[0] == pytest.approx(1) and base[0, 0] == pytest.approx(0.9)


def test_mitsuba_scene_loads_and_renders(truth: tuple[Path, InferReport]) -> None:
    import mitsuba as mi

    import mitsuba_plugins

    mitsuba_plugins.register()
    scene = mi.load_file(str(truth[0] / "mitsuba" / "scene.xml"))
    assert len(scene.sensors()) == 8
    image = np.array(mi.render(scene, sensor=1, spp=64))
    (ours,) = render_asset(truth[0] / "asset", RelightOptions(views=("view-001",), samples=64, denoise=False))
    assert image.shape == (SIZE[1], SIZE[0], 3)
    np.testing.assert_allclose(image.mean(axis=(0, 1)), ours.color.mean(axis=(0, 1)), rtol=0.02)


def test_assets_can_be_relit_and_get_inserted_objects(
    rendered: Rendered, truth: tuple[Path, InferReport], tmp_path: Path
) -> None:
    out = truth[0]
    one = RelightOptions(views=("view-001",), samples=4, sky=(2.0, 0.0, 0.0), denoise=False)
    (red,) = render_asset(out / "asset", one)
    assert red.color[..., 0].mean() > 0 and red.color[..., 1:].max() == 0
    ball = rendered.root / "library" / "objects" / "ball"
    inserted = Insertion(ball, (2.5, 2.0, 1.0))
    images = [
        next(iter(render_asset(out / "asset", RelightOptions(views=("view-001",), samples=4, insertions=i))))
        for i in ((), (inserted,))
    ]
    changed = np.abs(images[0].color - images[1].color).max(axis=-1) > 0.02
    assert 5 < changed.sum() < 0.5 * changed.size
    files = write_renders(out / "asset", tmp_path / "r", RelightOptions(views=("view-002",), samples=1))
    assert [file.name for file in files] == ["view-002.exr", "view-002.png"]
    with pytest.raises(InputError, match="views = nowhere"):
        write_renders(out / "asset", tmp_path / "none", RelightOptions(views=("nowhere",)))
    assert not (tmp_path / "none").exists()
    with pytest.raises(InputError, match=r"view-002\.png.*a file; expected a folder"):
        write_renders(out / "asset", files[1])


def test_inference_runs_and_continues(rendered: Rendered, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a stop, only missing and damaged views are predicted, identically; other options are refused."""
    options = InferOptions(atlas=128, precision="float32", batch=2, has_exr=False)
    whole = infer(
        rendered.small_capture(), rendered.root / "whole", CheckpointMaps(rendered.checkpoint), options
    )
    assert whole.is_filtered and whole.precision == "float32" and whole.exposure > 0
    assert {"trace", "statistics", "predict", "unwrap", "merge", "fill", "export"} <= set(whole.seconds)
    assert "total" in whole.table()
    part = rendered.root / "part"

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "predict" and done >= 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        infer(rendered.small_capture(), part, CheckpointMaps(rendered.checkpoint), options, stop)
    kept = sorted(path.name for path in (part / "views").iterdir())
    assert len(kept) == 4 and not (part / "report.json").exists()
    before = {name: (part / "views" / name).stat().st_mtime_ns for name in kept}
    (part / "views" / kept[0]).write_bytes(b"damaged")
    infer(rendered.small_capture(), part, CheckpointMaps(rendered.checkpoint), options)
    for name in kept[1:]:
        assert (part / "views" / name).stat().st_mtime_ns == before[name]
    for folder in ("views", "atlas"):
        for path in sorted((part / folder).iterdir()):
            assert path.read_bytes() == (rendered.root / "whole" / folder / path.name).read_bytes(), path.name
    assert json.loads((part / "report.json").read_text())["num_views"] == 8
    with pytest.raises(InputError, match="other work"):
        infer(
            rendered.small_capture(),
            part,
            CheckpointMaps(rendered.checkpoint),
            InferOptions(atlas=128, precision="bfloat16"),
        )


def test_inference_with_confidence_continues(rendered: Rendered) -> None:
    """Confidence is stored with the maps; a view without it is predicted again, to the same maps; maps
    without confidence are refused."""
    out = rendered.root / "weighted"
    options = InferOptions(
        atlas=128, precision="float32", batch=2, weights="confidence", materials="network", has_exr=False
    )
    infer(rendered.small_capture(), out, CheckpointMaps(rendered.checkpoint), options)
    first = {path.name: path.read_bytes() for path in sorted((out / "views").iterdir())}
    atlas = (out / "atlas" / "roughness.png").read_bytes()
    confidence = np.load(out / "views" / "view-000.confidence.npy").astype(np.float32)
    assert confidence.shape == (*SMALL_SIZE[::-1], 3) and (confidence[..., 0] == 1).all()
    assert confidence[..., 1:].max() == 1 and confidence[..., 1:].std() > 1e-4
    (out / "views" / "view-000.confidence.npy").unlink()
    (out / "views" / "view-003.confidence.npy").write_bytes(b"damaged")
    infer(rendered.small_capture(), out, CheckpointMaps(rendered.checkpoint), options)
    assert {path.name: path.read_bytes() for path in sorted((out / "views").iterdir())} == first
    assert (out / "atlas" / "roughness.png").read_bytes() == atlas
    infer(
        rendered.small_capture(), out, CheckpointMaps(rendered.checkpoint), replace(options, weights="none")
    )
    assert (out / "atlas" / "roughness.png").read_bytes() != atlas
    bare = GivenMaps("bare", lambda traced: [{n: m[n] for n in MATERIAL_MAPS} for m in TRUTH.read(traced)])
    with pytest.raises(InputError, match="a confidence for every view"):
        infer(rendered.small_capture(), rendered.root / "none", bare, options)


def test_a_mesh_that_no_view_sees_is_refused(rendered: Rendered, tmp_path: Path) -> None:
    from dataclasses import replace

    from datagen.formats.capture import CaptureGeometry

    capture = rendered.capture()
    mesh = capture.geometry.mesh
    away = replace(mesh, positions=mesh.positions + np.float32(100))
    moved = replace(capture, geometry=CaptureGeometry(away, capture.geometry.parts))
    with pytest.raises(InputError, match="no view shows the mesh"):
        infer(moved, tmp_path, CheckpointMaps(rendered.checkpoint))
    assert read_capture(rendered.shard, CaptureOptions(max_width_px=48)).views[0].camera.width_px == 48
