# SPDX-License-Identifier: MIT
"""Writes a reconstruction as one USDZ file, with surfaces as UsdPreviewSurface and lights as UsdLux.

The root's variant set ``workflow`` has two variants. *metallic*, the default, is supported by all programs
and has base colour, occlusion-roughness-metalness, and one index of refraction, from the mean S of
non-metallic texels. *specular* has exact D, S and R, which some programs misread (Blender 4.5, AR Quick
Look).

The stage is in metres with Y up; one root transform rotates the capture's Z up, and everything below it is in
the capture's frame. Emissive surfaces are mesh lights whose material shows the same radiance
(``materialSyncMode`` independent), windows and panels rectangle lights, the sky a dome light, and the sun a
distant light. Requires ``usd-core`` (the extra ``usd``).
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.formats.lights import (
    AreaLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
    SphereLight,
)
from datagen.foundation.axes import affine
from datagen.foundation.durable import publish
from datagen.foundation.errors import input_error
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.naming import unique
from model.reconstruction.atlas.atlas import Atlas
from model.reconstruction.export.atlas_images import BAND, reduced_png
from model.reconstruction.export.metallic_textures import DIELECTRIC_F0, MAX_DIELECTRIC_F0
from model.reconstruction.export.slots import WORLD_FROM_SKY, Reconstruction, environment_exr, export_slots
from model.reconstruction.found_lights import ENVIRONMENT_FILE, Color

POINT_RADIUS_M = 0.01
"""Radius of the sphere that represents a point light, which UsdLux lacks."""
ROOT = "/room"
WORKFLOWS = ("specular", "metallic")  # the last is the default
_TEXTURES = {"base_color": "sRGB", "orm": "raw", "diffuse_albedo": "sRGB", "specular_albedo": "sRGB"}
_INPUTS = {
    "metallic": {"diffuseColor": "base_color.rgb", "roughness": "orm.g", "metallic": "orm.b"},
    "specular": {
        "diffuseColor": "diffuse_albedo.rgb",
        "specularColor": "specular_albedo.rgb",
        "roughness": "orm.g",
    },
}
"""Texture outputs that are connected to the inputs of the surface shader, by workflow."""
_FIRST_ZIP_TIME_S = 315532800  # 1980; constant, so that equal content has equal bytes


def require_usd() -> None:
    """Raise :class:`InputError` if ``usd-core`` is not installed."""
    try:
        import pxr.Usd  # noqa: F401
    except ImportError:
        remedy = "pip install 'scene-materials[usd]', or leave --usd out"
        raise input_error("--usd", "", "no usd-core", "the package usd-core", remedy) from None


def write_usdz(path: Path, reconstruction: Reconstruction) -> None:
    """Write one USDZ with geometry, textures of at most ``MAX_TEXTURE`` texels per side, and lights.

    Lights are the recovered lights, else the capture's point, sphere, area, directional and environment
    lights. Raises :class:`InputError` without ``usd-core``.
    """
    require_usd()
    from pxr import Sdf, UsdUtils

    with tempfile.TemporaryDirectory(prefix=".usd-", dir=path.parent) as name:
        folder = Path(name)
        _write_textures(folder, reconstruction)
        stage_file, packed = folder / "room.usdc", folder / path.name
        writer = _Stage(stage_file, mean_index(reconstruction.atlas))
        for slot_name, slot in export_slots(reconstruction).items():
            writer.mesh(slot_name, slot.mesh, slot.emission, has_material=slot.has_material)
        for light in reconstruction.exported_lights:
            writer.light(light)
        writer.save()
        for file in folder.iterdir():
            os.utime(file, (_FIRST_ZIP_TIME_S, _FIRST_ZIP_TIME_S))
        if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(stage_file)), str(packed)):
            raise OSError(f"{path}: usd-core could not write the package")
        publish(packed, path)


def mean_index(atlas: Atlas) -> float:
    """Compute the index of refraction whose F0 is the mean S of non-metallic texels, 1.5 without any."""
    total, num = 0.0, 0
    for top in range(0, atlas.size, BAND):
        specular = np.asarray(atlas.maps["specular_albedo"][top : top + BAND], np.float32)
        of_surface = specular[atlas.face[top : top + BAND] >= 0]
        dielectric = of_surface[of_surface.max(axis=-1) <= MAX_DIELECTRIC_F0]
        total, num = total + float(dielectric.mean(axis=-1).sum()), num + len(dielectric)
        atlas.release()
    root = np.sqrt(total / num if num else DIELECTRIC_F0)
    return float((1 + root) / (1 - root))


def _write_textures(folder: Path, reconstruction: Reconstruction) -> None:
    (folder / "base_color.png").write_bytes(reconstruction.metallic.base_color)
    (folder / "orm.png").write_bytes(reconstruction.metallic.orm)
    for name in ("diffuse_albedo", "specular_albedo"):
        (folder / f"{name}.png").write_bytes(reduced_png(reconstruction.atlas, name))
    found = reconstruction.shining_lights
    if found is not None and found.environment is not None:
        (folder / ENVIRONMENT_FILE).write_bytes(environment_exr(found.environment))


class _Stage:
    """Writes a USD stage to ``file``; ``index`` is the index of refraction in the metallic workflow."""

    def __init__(self, file: Path, index: float):
        from pxr import Gf, Usd, UsdGeom

        self.index = index
        self._names = {"materials"}
        self.stage = Usd.Stage.CreateNew(str(file))
        UsdGeom.SetStageUpAxis(self.stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(self.stage, 1.0)
        root = UsdGeom.Xform.Define(self.stage, ROOT)
        root.AddTransformOp().Set(Gf.Matrix4d(1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1))
        UsdGeom.Scope.Define(self.stage, f"{ROOT}/materials")
        self.stage.SetDefaultPrim(root.GetPrim())
        self.workflow = root.GetPrim().GetVariantSets().AddVariantSet("workflow")
        for name in WORKFLOWS:
            self.workflow.AddVariant(name)

    def save(self) -> None:
        self.workflow.SetVariantSelection(WORKFLOWS[-1])
        self.stage.GetRootLayer().Save()

    def mesh(self, name: str, mesh: Mesh, emission: Color | None, *, has_material: bool) -> None:
        """Add a mesh with its material; an emissive mesh is also a light."""
        from pxr import Gf, Sdf, UsdGeom, UsdLux, UsdShade, Vt

        assert mesh.normals is not None and mesh.uv is not None
        shape = UsdGeom.Mesh.Define(self.stage, self._path(name))
        shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.positions, np.float32)))
        shape.CreateFaceVertexCountsAttr(Vt.IntArray(len(mesh.faces), 3))
        indices = np.ascontiguousarray(mesh.faces.reshape(-1), np.int32)
        shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(indices))
        shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.normals, np.float32)))
        shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        shape.CreateDoubleSidedAttr(True)
        low, high = (Gf.Vec3f(*map(float, f(mesh.positions, axis=0))) for f in (np.min, np.max))
        shape.CreateExtentAttr([low, high])
        if has_material:
            kind = Sdf.ValueTypeNames.TexCoord2fArray
            primvar = UsdGeom.PrimvarsAPI(shape).CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
            primvar.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uv, np.float32)))
        material = self._material(name, emission, has_material=has_material)
        UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
        if emission is not None and max(emission) > 0:
            light = UsdLux.MeshLightAPI.Apply(shape.GetPrim())
            light = UsdLux.LightAPI(light)
            light.CreateMaterialSyncModeAttr(UsdLux.Tokens.independent)
            _set_radiance(light, emission)

    def _material(self, name: str, emission: Color | None, *, has_material: bool) -> Any:
        from pxr import Gf, Sdf, UsdShade

        path, types = f"{ROOT}/materials/{_identifier(name)}", Sdf.ValueTypeNames
        material = UsdShade.Material.Define(self.stage, path)
        shader = UsdShade.Shader.Define(self.stage, f"{path}/surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        if emission is not None:
            shader.CreateInput("emissiveColor", types.Color3f).Set(Gf.Vec3f(*emission))
        if has_material:
            self._connect_textures(path, shader)
        else:
            shader.CreateInput("useSpecularWorkflow", types.Int).Set(1)
            for black in ("diffuseColor", "specularColor"):
                shader.CreateInput(black, types.Color3f).Set(Gf.Vec3f(0))
        material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", types.Token))
        return material

    def _connect_textures(self, path: str, shader: Any) -> None:
        """Connect the textures to the surface shader, separately in each variant of the workflow."""
        from pxr import Sdf, UsdShade

        types = Sdf.ValueTypeNames
        reader = UsdShade.Shader.Define(self.stage, f"{path}/st")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", types.String).Set("st")
        st = reader.CreateOutput("result", types.Float2)
        textures = {}
        for name, space in _TEXTURES.items():
            texture = textures[name] = UsdShade.Shader.Define(self.stage, f"{path}/{name}")
            texture.CreateIdAttr("UsdUVTexture")
            texture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"./{name}.png"))
            texture.CreateInput("sourceColorSpace", types.Token).Set(space)
            for axis in ("wrapS", "wrapT"):
                texture.CreateInput(axis, types.Token).Set("clamp")
            texture.CreateInput("st", types.Float2).ConnectToSource(st)
        for workflow in WORKFLOWS:
            self.workflow.SetVariantSelection(workflow)
            with self.workflow.GetVariantEditContext():
                shader.CreateInput("useSpecularWorkflow", types.Int).Set(int(workflow == "specular"))
                if workflow == "metallic":
                    shader.CreateInput("ior", types.Float).Set(self.index)
                for name, source in _INPUTS[workflow].items():
                    texture, _, channel = source.partition(".")
                    is_color = channel == "rgb"
                    kind = types.Float3 if is_color else types.Float
                    value = textures[texture].CreateOutput(channel, kind)
                    shader.CreateInput(name, types.Color3f if is_color else types.Float).ConnectToSource(
                        value
                    )

    def light(self, light: Light) -> None:
        """Add a light; unsupported kinds are omitted. Lights of UsdLux emit along -Z."""
        from pxr import Gf, Sdf, UsdLux

        color: NDArray | Color
        match light:
            case PointLight() | SphereLight():
                made = UsdLux.SphereLight.Define(self.stage, self._path(light.name))
                if isinstance(light, PointLight):
                    radius_m, color = POINT_RADIUS_M, np.array(light.intensity) / (np.pi * POINT_RADIUS_M**2)
                else:
                    radius_m, color = light.radius_m, light.radiance
                made.CreateRadiusAttr(float(radius_m))
                made.CreateTreatAsPointAttr(isinstance(light, PointLight))
                placed = affine(np.eye(3), light.position_m)
            case AreaLight():
                u, v = np.array(light.edge_u_m, np.float64), np.array(light.edge_v_m, np.float64)
                size = np.linalg.norm(u), np.linalg.norm(v)
                placed = _frame(u / size[0], -np.cross(u, v), np.array(light.origin_m) + (u + v) / 2)
                path, color = self._path(light.name), light.radiance
                if light.shape == "disk":
                    made = UsdLux.DiskLight.Define(self.stage, path)
                    made.CreateRadiusAttr(0.5)
                    placed[:3, :2] *= size
                else:
                    made = UsdLux.RectLight.Define(self.stage, path)
                    made.CreateWidthAttr(float(size[0]))
                    made.CreateHeightAttr(float(size[1]))
            case DirectionalLight():
                made = UsdLux.DistantLight.Define(self.stage, self._path(light.name))
                made.CreateAngleAttr(float(np.degrees(light.angular_diameter_rad)))
                made.CreateNormalizeAttr(True)
                away, color = np.array(light.direction), light.irradiance
                x = np.cross(np.eye(3)[np.abs(away).argmin()], -away / np.linalg.norm(away))
                placed = _frame(x / np.linalg.norm(x), -away)
            case EnvironmentLight():
                made = UsdLux.DomeLight.Define(self.stage, self._path(light.name))
                if light.image is not None:
                    made.CreateTextureFileAttr(Sdf.AssetPath(f"./{light.image}"))
                    made.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
                placed = np.array(light.world_from_environment) @ WORLD_FROM_SKY
                color = np.asarray(light.radiance) * light.scale
            case _:
                return
        rows = placed.T  # USD uses row vectors
        made.AddTransformOp().Set(Gf.Matrix4d(*(float(v) for v in rows.ravel())))
        _set_radiance(UsdLux.LightAPI(made.GetPrim()), color)

    def _path(self, name: str) -> str:
        """Return a unique path for a mesh or light, since different names may give the same identifier."""
        identifier = unique(_identifier(name), self._names)
        self._names.add(identifier)
        return f"{ROOT}/{identifier}"


def _frame(x: NDArray, z: NDArray, origin_m: ArrayLike = (0.0, 0.0, 0.0)) -> NDArray[np.float64]:
    """Return the transform (4, 4) from a frame at ``origin_m`` with the unit vector ``x`` as its x axis and
    its z axis along ``z``, of any length.
    """
    unit = z / np.linalg.norm(z)
    return affine(np.stack([x, np.cross(unit, x), unit], axis=1), origin_m)


def _set_radiance(light: Any, radiance: NDArray | Color) -> None:
    """Set the radiance (irradiance of a distant light) as a colour of at most 1 times an intensity."""
    from pxr import Gf

    peak = float(max(radiance))
    light.CreateIntensityAttr(peak)
    light.CreateColorAttr(Gf.Vec3f(*(float(c) / peak if peak > 0 else 1.0 for c in radiance)))


def _identifier(name: str) -> str:
    """Replace the characters of ``name`` that are invalid in names of prims."""
    from pxr import Tf

    return str(Tf.MakeValidIdentifier(name))
