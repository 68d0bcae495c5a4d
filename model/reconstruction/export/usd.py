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
from numpy.typing import NDArray

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
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.naming import unique
from model.reconstruction.atlas.atlas import MAP_CHANNELS, Atlas
from model.reconstruction.export.atlas_images import averaged, map_bytes, texture_shrink
from model.reconstruction.export.metallic_textures import DIELECTRIC_F0, MAX_DIELECTRIC_F0
from model.reconstruction.export.slots import WORLD_FROM_SKY, Reconstruction, environment_exr, export_slots
from model.reconstruction.found_lights import ENVIRONMENT_FILE, SKY, SUN, Color

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
_BAND = 1024
_FIRST_ZIP_TIME_S = 315532800  # 1980; constant, so that equal content has equal bytes


def require_usd() -> None:
    """Raise :class:`InputError` if ``usd-core`` is not installed."""
    try:
        import pxr.Usd  # noqa: F401
    except ImportError:
        remedy = "pip install 'scene-materials[usd]', or leave --usd out"
        raise input_error("--usd", "", "no usd-core", "the package usd-core", remedy) from None


def write_usdz(path: Path, reconstruction: Reconstruction) -> None:
    """Write one USDZ with geometry, textures of at most ``MAX_TEXTURE`` texels a side, and lights.

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
        found = reconstruction.shining_lights
        if found is None:
            for light in reconstruction.capture.lights:
                writer.known_light(light)
        else:
            for patch in found.sending:
                for number, rectangle in enumerate(patch.rectangles):
                    edges = (rectangle.origin_m, rectangle.edge_u_m, rectangle.edge_v_m)
                    writer.flat(f"{patch.slot}-{number}", *edges, rectangle.radiance)
            if found.environment is not None:
                (folder / ENVIRONMENT_FILE).write_bytes(environment_exr(found.environment))
                writer.dome(SKY, (1.0, 1.0, 1.0), ENVIRONMENT_FILE, np.eye(4))
            if found.sun is not None:
                away = -np.array(found.sun.direction)
                writer.distant(SUN, away, found.sun.irradiance, found.sun.angular_diameter_rad)
        writer.save()
        for file in folder.iterdir():
            os.utime(file, (_FIRST_ZIP_TIME_S, _FIRST_ZIP_TIME_S))
        if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(stage_file)), str(packed)):
            raise OSError(f"{path}: usd-core could not write the package")
        publish(packed, path)


def mean_index(atlas: Atlas) -> float:
    """Compute the index of refraction whose F0 is the mean S of non-metallic texels, 1.5 without any."""
    total, num = 0.0, 0
    for top in range(0, atlas.size, _BAND):
        specular = np.asarray(atlas.maps["specular_albedo"][top : top + _BAND], np.float32)
        of_surface = specular[atlas.face[top : top + _BAND] >= 0]
        dielectric = of_surface[of_surface.max(axis=-1) <= MAX_DIELECTRIC_F0]
        total, num = total + float(dielectric.mean(axis=-1).sum()), num + len(dielectric)
        atlas.release()
    root = np.sqrt(total / num if num else DIELECTRIC_F0)
    return float((1 + root) / (1 - root))


def _write_textures(folder: Path, reconstruction: Reconstruction) -> None:
    atlas, made = reconstruction.atlas, reconstruction.metallic
    (folder / "base_color.png").write_bytes(made.base_color)
    (folder / "orm.png").write_bytes(made.orm)
    shrink = texture_shrink(atlas)
    side = atlas.size // shrink
    for name in ("diffuse_albedo", "specular_albedo"):
        stored = np.empty((side, side, MAP_CHANNELS[name]), np.uint8)
        for first in range(0, side, _BAND):
            rows = atlas.maps[name][first * shrink : (first + _BAND) * shrink]
            stored[first : first + _BAND] = map_bytes(name, averaged(rows, shrink).astype(np.float16))
        (folder / f"{name}.png").write_bytes(encode_png(stored))
        atlas.release()


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
            _shine(light, emission)

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

    def known_light(self, light: Light) -> None:
        """Add a light of the capture; unsupported kinds and images in other packages are omitted."""
        if isinstance(light, PointLight):
            radiance = np.asarray(light.intensity) / (np.pi * POINT_RADIUS_M**2)
            self._sphere(light.name, light.position_m, POINT_RADIUS_M, radiance, is_point=True)
        elif isinstance(light, SphereLight):
            radiance = np.asarray(light.radiance)
            self._sphere(light.name, light.position_m, light.radius_m, radiance, is_point=False)
        elif isinstance(light, AreaLight):
            place = light.origin_m, light.edge_u_m, light.edge_v_m
            self.flat(light.name, *place, light.radiance, is_disk=light.shape == "disk")
        elif isinstance(light, DirectionalLight):
            away = np.array(light.direction)
            self.distant(light.name, away, light.irradiance, light.angular_diameter_rad)
        elif isinstance(light, EnvironmentLight) and light.image is None:
            radiance = np.asarray(light.radiance) * light.scale
            self.dome(light.name, tuple(radiance), None, np.array(light.world_from_environment))

    def flat(
        self,
        name: str,
        origin: Color,
        edge_u: Color,
        edge_v: Color,
        radiance: Color,
        *,
        is_disk: bool = False,
    ) -> None:
        """Add a rectangle, or the ellipse in it, that emits along edge_u x edge_v; in UsdLux along -Z."""
        from pxr import UsdLux

        u, v = np.array(edge_u, np.float64), np.array(edge_v, np.float64)
        width, height = np.linalg.norm(u), np.linalg.norm(v)
        normal = np.cross(u, v)
        placed = np.eye(4)
        placed[:3, 0], placed[:3, 2] = u / width, -normal / np.linalg.norm(normal)
        placed[:3, 1] = np.cross(placed[:3, 2], placed[:3, 0])
        placed[:3, 3] = np.array(origin) + (u + v) / 2
        path = self._path(name)
        if is_disk:
            light = UsdLux.DiskLight.Define(self.stage, path)
            light.CreateRadiusAttr(0.5)
            placed[:3, :2] *= (width, height)
        else:
            light = UsdLux.RectLight.Define(self.stage, path)
            light.CreateWidthAttr(float(width))
            light.CreateHeightAttr(float(height))
        self._place(light, placed)
        _shine(UsdLux.LightAPI(light.GetPrim()), radiance)

    def dome(self, name: str, radiance: Color, image: str | None, world_from_environment: NDArray) -> None:
        """Add a dome light of constant radiance, times ``image`` in the project's convention if given."""
        from pxr import Sdf, UsdLux

        light = UsdLux.DomeLight.Define(self.stage, self._path(name))
        if image is not None:
            light.CreateTextureFileAttr(Sdf.AssetPath(f"./{image}"))
            light.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
        self._place(light, world_from_environment @ WORLD_FROM_SKY)
        _shine(UsdLux.LightAPI(light.GetPrim()), radiance)

    def distant(self, name: str, direction: NDArray, irradiance: Color, diameter_rad: float) -> None:
        """Add a distant light that travels in ``direction`` (3,)."""
        from pxr import UsdLux

        light = UsdLux.DistantLight.Define(self.stage, self._path(name))
        light.CreateAngleAttr(float(np.degrees(diameter_rad)))
        light.CreateNormalizeAttr(True)
        placed = np.eye(4)
        placed[:3, 2] = -direction / np.linalg.norm(direction)
        placed[:3, 0] = np.cross(np.eye(3)[np.abs(direction).argmin()], placed[:3, 2])
        placed[:3, 0] /= np.linalg.norm(placed[:3, 0])
        placed[:3, 1] = np.cross(placed[:3, 2], placed[:3, 0])
        self._place(light, placed)
        _shine(UsdLux.LightAPI(light.GetPrim()), irradiance)

    def _sphere(
        self, name: str, position: Color, radius: float, radiance: NDArray, *, is_point: bool
    ) -> None:
        from pxr import UsdLux

        light = UsdLux.SphereLight.Define(self.stage, self._path(name))
        light.CreateRadiusAttr(float(radius))
        light.CreateTreatAsPointAttr(is_point)
        self._place(light, affine(np.eye(3), position))
        _shine(UsdLux.LightAPI(light.GetPrim()), tuple(radiance))

    def _path(self, name: str) -> str:
        """Return a new path for a mesh or light; names of lights may be equal as identifiers."""
        identifier = unique(_identifier(name), self._names)
        self._names.add(identifier)
        return f"{ROOT}/{identifier}"

    def _place(self, prim: Any, placed: NDArray) -> None:
        from pxr import Gf

        rows = np.asarray(placed, np.float64).T  # USD uses row vectors
        prim.AddTransformOp().Set(Gf.Matrix4d(*(float(v) for v in rows.ravel())))


def _shine(light: Any, radiance: Color) -> None:
    """Set the radiance (irradiance of a distant light) as a colour of at most 1 times an intensity."""
    from pxr import Gf

    peak = float(max(radiance))
    light.CreateIntensityAttr(peak)
    light.CreateColorAttr(Gf.Vec3f(*(float(c) / peak if peak > 0 else 1.0 for c in radiance)))


def _identifier(name: str) -> str:
    """Replace the characters of ``name`` that are invalid in names of prims."""
    from pxr import Tf

    return str(Tf.MakeValidIdentifier(name))
