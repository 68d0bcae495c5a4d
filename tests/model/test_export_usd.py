# SPDX-License-Identifier: MIT
"""USDZ, checked with USD's validators and readers against mesh, maps and lights."""

from __future__ import annotations

import importlib.util
import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from datagen.formats.lights import (
    AreaLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
    SphereLight,
)
from datagen.foundation.errors import InputError
from model.reconstruction.atlas.atlas import empty_atlas
from model.reconstruction.export import atlas_images, usd
from model.reconstruction.export.atlas_images import write_atlas_images
from model.reconstruction.export.slots import Reconstruction
from model.reconstruction.found_lights import FoundLamp, FoundLights, FoundPatch, FoundSun, Rectangle
from model.reconstruction.infer import InferOptions, infer
from model.reconstruction.predict.sources import TRUTH
from oracles.textured_room import room_capture

needs_usd = pytest.mark.skipif(importlib.util.find_spec("pxr") is None, reason="needs usd-core")
Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
PANEL = Rectangle((9.0, 0.0, 1.0), (0.0, 0.0, 1.5), (0.0, 1.0, 0.0), (1.0, 2.0, 4.0))
PANELS = FoundPatch("panel-0", (PANEL,), (9.0, 0.5, 1.5), 1.5, (1.0, 2.0, 4.0))

SUN = FoundSun((0.6, 0.0, 0.8), (30.0, 20.0, 10.0), 0.0093)


def made(folder: Path, lights: FoundLights | None, known: tuple[Light, ...] = ()) -> Path:
    """Export the textured room with an atlas of random values as USDZ."""
    capture = replace(room_capture(2, (32, 24)), lights=known)
    atlas = empty_atlas(64)
    atlas.face[:] = 0
    random = np.random.default_rng(1)
    for values in atlas.maps.values():
        values[:] = random.random(values.shape)
    folder.mkdir(exist_ok=True)
    write_atlas_images(folder / "atlas", atlas, has_exr=False)
    path = folder / "room.usdz"
    usd.write_usdz(path, Reconstruction(capture, capture.geometry.mesh, atlas, folder / "atlas", lights))
    return path


def all_lights(folder: Path) -> Path:
    """Export the room with a lamp, an emissive surface, a panel, a sun, and a sky with one bright pixel."""
    lamps = tuple(
        FoundLamp(slot, np.array([face], np.int32), 1, (1.0, 2.0, 4.0), (0.0, 0.0, 0.0), 0.01, is_named)
        for slot, face, is_named in (("lamp-0", 0, True), ("found-0", 5, False))
    )
    sky = np.zeros((16, 32, 3), np.float32)
    sky[4, 20] = [7, 8, 9]
    return made(folder, FoundLights(lamps, (PANELS,), environment=sky, sun=SUN))


def faults(stage: Any) -> list[str]:
    """Names of the faults found by the validators of ``usdchecker``."""
    from pxr import UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    return sorted({f"{e.GetValidator().GetMetadata().name}: {e.GetMessage()}" for e in errors})


def texture(shader: Any, name: str) -> tuple[str, str, str]:
    """File, channel and colour space of the texture that feeds an input of a shader."""
    from pxr import UsdShade

    connected, channel, _ = shader.GetInput(name).GetConnectedSource()
    source = UsdShade.Shader(connected.GetPrim())
    file = Path(source.GetInput("file").Get().path).name
    return file, channel, source.GetInput("sourceColorSpace").Get()


def to_world(prim: Any) -> NDArray[np.float64]:
    """World transform (4, 4) of a prim, for column vectors."""
    from pxr import UsdGeom

    return np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)).T


@needs_usd
def test_usd_validators_find_nothing(tmp_path: Path) -> None:
    from pxr import Usd

    path = all_lights(tmp_path)
    assert faults(Usd.Stage.Open(str(path))) == []
    with zipfile.ZipFile(path) as package:  # injected faults: no texture, and no up axis
        package.extractall(tmp_path / "open")
    (tmp_path / "open" / "orm.png").unlink()
    stage = Usd.Stage.Open(str(tmp_path / "open" / "room.usdc"))
    stage.ClearMetadata("upAxis")
    found = "\n".join(faults(stage))
    assert "upAxis" in found and "orm.png" in found


@needs_usd
def test_surfaces_are_exported_completely(tmp_path: Path) -> None:
    """The USDZ is in metres with Y up; D, S and R equal the atlas's images and feed the right inputs."""
    from pxr import Usd, UsdGeom, UsdShade

    path = all_lights(tmp_path)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/room/surface"))
    mesh = room_capture(2, (32, 24)).geometry.mesh
    turned = to_world(surface.GetPrim())[:3, :3]
    np.testing.assert_allclose(turned, Y_UP_FROM_Z_UP, atol=1e-12)
    points, faces = (
        np.array(surface.GetPointsAttr().Get()),
        np.array(surface.GetFaceVertexIndicesAttr().Get()),
    )
    assert mesh.uv is not None
    uv = np.array(UsdGeom.PrimvarsAPI(surface).GetPrimvar("st").Get())
    rest = [k for k in range(len(mesh.faces)) if k not in (0, 5)]
    np.testing.assert_allclose(points[faces].reshape(-1, 3, 3), mesh.triangles()[rest], atol=1e-6)
    np.testing.assert_allclose(uv[faces].reshape(-1, 3, 2), mesh.uv[mesh.faces[rest]], atol=1e-6)
    material = UsdShade.MaterialBindingAPI(surface).ComputeBoundMaterial()[0]
    shader = material.ComputeSurfaceSource()[0]
    for workflow, wanted in (
        ("metallic", {"diffuseColor": "base_color.rgb", "metallic": "orm.b", "roughness": "orm.g"}),
        ("specular", {"diffuseColor": "diffuse_albedo.rgb", "specularColor": "specular_albedo.rgb"}),
    ):
        if workflow == "specular":  # the default is the other one
            stage.GetDefaultPrim().GetVariantSet("workflow").SetVariantSelection(workflow)
        assert shader.GetInput("useSpecularWorkflow").Get() == (workflow == "specular")
        for name, source in wanted.items():
            image = source.partition(".")[0]
            space = "raw" if image == "orm" else "sRGB"
            assert texture(shader, name) == (f"{image}.png", source.partition(".")[2], space)
        assert faults(stage) == []
    with zipfile.ZipFile(path) as package:
        inside = {
            n: np.asarray(Image.open(io.BytesIO(package.read(n)))) for n in package.namelist() if "png" in n
        }
    written = {p.name: np.asarray(Image.open(p)) for p in (tmp_path / "atlas").glob("*.png")}
    for name in ("diffuse_albedo.png", "specular_albedo.png"):
        np.testing.assert_array_equal(inside[name], written[name])
    np.testing.assert_array_equal(inside["orm.png"][..., 1], written["roughness.png"])
    assert (inside["orm.png"][..., 0] == 255).all() and len(np.unique(inside["orm.png"][..., 2])) > 100


def test_one_index_represents_all_dielectrics() -> None:
    atlas = empty_atlas(16)
    atlas.face[2:] = 0
    atlas.maps["specular_albedo"][:] = 0.5
    assert usd.mean_index(atlas) == pytest.approx(1.5)
    atlas.maps["specular_albedo"][2:9] = 0.0625
    assert usd.mean_index(atlas) == pytest.approx(1.25 / 0.75)


@needs_usd
def test_lights_are_exported_at_their_positions(tmp_path: Path) -> None:
    from pxr import Usd, UsdLux, UsdShade

    stage = Usd.Stage.Open(str(all_lights(tmp_path)))
    for slot, has_material in (("lamp_0", False), ("found_0", True)):
        prim = stage.GetPrimAtPath(f"/room/{slot}")
        assert prim.HasAPI(UsdLux.MeshLightAPI)
        np.testing.assert_allclose(radiance(prim), [1, 2, 4])
        shader = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]
        np.testing.assert_allclose(shader.GetInput("emissiveColor").Get(), [1, 2, 4])
        assert shader.GetInput("diffuseColor").HasConnectedSource() == has_material
    rectangle = UsdLux.RectLight(stage.GetPrimAtPath("/room/panel_0_0"))
    half = np.array([rectangle.GetWidthAttr().Get(), rectangle.GetHeightAttr().Get()]) / 2
    placed = to_world(rectangle.GetPrim())
    corners = [placed[:3] @ [x * half[0], y * half[1], 0, 1] for x in (-1, 1) for y in (-1, 1)]
    wanted = PANEL.corners() @ Y_UP_FROM_Z_UP.T
    np.testing.assert_allclose(sorted(map(tuple, corners)), sorted(map(tuple, wanted)), atol=1e-6)
    normal = Y_UP_FROM_Z_UP @ np.cross(PANEL.edge_u_m, PANEL.edge_v_m)
    np.testing.assert_allclose(-placed[:3, 2], normal / np.linalg.norm(normal), atol=1e-6)
    np.testing.assert_allclose(radiance(rectangle.GetPrim()), [1, 2, 4])
    distant = UsdLux.DistantLight(stage.GetPrimAtPath("/room/sun"))
    assert distant.GetNormalizeAttr().Get() and distant.GetAngleAttr().Get() == pytest.approx(0.533, abs=1e-3)
    np.testing.assert_allclose(radiance(distant.GetPrim()), SUN.irradiance)
    towards = to_world(distant.GetPrim())[:3, 2]  # it emits along -Z
    np.testing.assert_allclose(towards, Y_UP_FROM_Z_UP @ SUN.direction, atol=1e-6)
    dome = stage.GetPrimAtPath("/room/sky")
    # OpenEXR's convention for a dome's texture: longitude grows from +Z to +X and leftwards, latitude to +Y
    longitude, latitude = np.pi * (1 - 2 * 20.5 / 32), np.pi * (0.5 - 4.5 / 16)
    shown = np.cos(latitude) * np.array([np.sin(longitude), 0, np.cos(longitude)])
    shown[1] = np.sin(latitude)
    # ours: +Y in the middle, +X right of it, +Z up
    right = np.pi * (2 * 20.5 / 32 - 1)
    ours = np.array([np.cos(latitude) * np.sin(right), np.cos(latitude) * np.cos(right), np.sin(latitude)])
    np.testing.assert_allclose(to_world(dome)[:3, :3] @ shown, Y_UP_FROM_Z_UP @ ours, atol=1e-6)


def radiance(prim: Any) -> NDArray[np.float64]:
    from pxr import UsdLux

    light = UsdLux.LightAPI(prim)
    return np.array(light.GetColorAttr().Get()) * light.GetIntensityAttr().Get()


@needs_usd
def test_known_lights_are_exported_where_none_were_found(tmp_path: Path) -> None:
    """Without found lights those of the capture are exported, a point as a sphere of equal intensity."""
    from pxr import Usd, UsdLux

    known: tuple[Light, ...] = (
        PointLight(name="bulb", position_m=(1.0, 2.0, 2.5), intensity=(5.0, 5.0, 4.0)),
        SphereLight(name="globe", position_m=(0.0, 0.0, 1.0), radius_m=0.2, radiance=(3.0, 3.0, 3.0)),
        AreaLight(
            name="area", origin_m=(0, 0, 2), edge_u_m=(1, 0, 0), edge_v_m=(0, 1, 0), radiance=(2.0, 2.0, 2.0)
        ),
        AreaLight(
            name="disk",
            origin_m=(0, 0, 2),
            edge_u_m=(3, 0, 0),
            edge_v_m=(0, 2, 0),
            radiance=(2.0, 2.0, 2.0),
            shape="disk",
        ),
        DirectionalLight(name="sun", direction=(0, 0, -2), irradiance=(3.0, 2.0, 1.0)),
        EnvironmentLight(name="grey", radiance=(1.0, 1.0, 1.0), scale=0.5),
        EnvironmentLight(name="elsewhere", image="sky.exr", asset="other"),
    )
    stage = Usd.Stage.Open(str(made(tmp_path, None, known)))
    bulb = stage.GetPrimAtPath("/room/bulb")
    radius = UsdLux.SphereLight(bulb).GetRadiusAttr().Get()
    np.testing.assert_allclose(radiance(bulb) * np.pi * radius**2, [5, 5, 4], rtol=1e-5)
    np.testing.assert_allclose(to_world(bulb)[:3, 3], [1, 2.5, -2])
    assert UsdLux.SphereLight(stage.GetPrimAtPath("/room/globe")).GetRadiusAttr().Get() == pytest.approx(0.2)
    np.testing.assert_allclose(radiance(stage.GetPrimAtPath("/room/area")), 2)
    disk = UsdLux.DiskLight(stage.GetPrimAtPath("/room/disk"))
    axes = disk.GetRadiusAttr().Get() * np.linalg.norm(to_world(disk.GetPrim())[:3, :2], axis=0)
    np.testing.assert_allclose(axes, [1.5, 1.0])
    np.testing.assert_allclose(to_world(disk.GetPrim())[:3, 3], [1.5, 2, -1])
    np.testing.assert_allclose(radiance(stage.GetPrimAtPath("/room/grey")), 0.5)
    assert not stage.GetPrimAtPath("/room/elsewhere")
    np.testing.assert_allclose(radiance(stage.GetPrimAtPath("/room/sun")), [3, 2, 1])
    np.testing.assert_allclose(to_world(stage.GetPrimAtPath("/room/sun"))[:3, 2], [0, 1, 0], atol=1e-6)


@needs_usd
def test_equal_content_gives_equal_bytes(tmp_path: Path) -> None:
    assert made(tmp_path / "a", None).read_bytes() == made(tmp_path / "b", None).read_bytes()
    assert [p.name for p in (tmp_path / "a").iterdir() if p.name != "atlas"] == ["room.usdz"]


@needs_usd
def test_large_atlases_are_averaged_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atlas_images, "MAX_TEXTURE", 32)
    with zipfile.ZipFile(made(tmp_path, None)) as package:
        image = np.asarray(Image.open(io.BytesIO(package.read("orm.png")))) / 255.0
    rough = np.asarray(Image.open(tmp_path / "atlas" / "roughness.png")) / 255.0
    np.testing.assert_allclose(image[..., 1], rough.reshape(32, 2, 32, 2).mean(axis=(1, 3)), atol=0.005)


def test_infer_writes_it_on_demand(
    tmp_path: Path, mitsuba_variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without usd-core an error is raised before any view is processed."""
    capture = room_capture(3, (48, 32))
    with monkeypatch.context() as patch:
        patch.setitem(__import__("sys").modules, "pxr.Usd", None)
        with pytest.raises(InputError, match=r"--usd: no usd-core.*scene-materials\[usd\]"):
            infer(capture, tmp_path / "without", TRUTH, InferOptions(atlas=64, has_usd=True))
    assert not (tmp_path / "without" / "views").exists()
    if importlib.util.find_spec("pxr") is not None:
        infer(capture, tmp_path / "with", TRUTH, InferOptions(atlas=64, has_usd=True, is_checked=False))
        usdz = tmp_path / "with" / f"{capture.name}.usdz"
        assert zipfile.is_zipfile(usdz)
        infer(capture, tmp_path / "with", TRUTH, InferOptions(atlas=32, is_checked=False))
        assert not usdz.exists()


@needs_usd
def test_lights_of_similar_names_are_all_exported(tmp_path: Path) -> None:
    """Lights whose names become equal USD identifiers, or equal that of another prim, are numbered."""
    from pxr import Usd

    names = ("lamp 1", "lamp-1", "surface", "materials")
    known = tuple(PointLight(name=name, position_m=(1, 2, 2.5), intensity=(5, 5, 4)) for name in names)
    stage = Usd.Stage.Open(str(made(tmp_path, None, known)))
    types = {prim.GetName(): prim.GetTypeName() for prim in stage.GetDefaultPrim().GetChildren()}
    assert types.pop("materials") == "Scope" and types.pop("surface") == "Mesh"
    assert types == dict.fromkeys(("lamp_1", "lamp_1_2", "surface_2", "materials_2"), "SphereLight")
