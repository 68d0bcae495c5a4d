# SPDX-License-Identifier: MIT
"""Asset packages: rooms, objects, materials and panoramas on disk (``asset.json`` in a folder or a zip).

Frames: metres, right-handed, Z up. An object's frame has its resting plane at z = 0 and its footprint around
the origin; its front faces -Y. Meshes are binary little-endian PLY with vertex positions (x y z), normals (nx
ny nz) and, if a texture needs them, texture coordinates (u v, v upwards: row 0 of an image is at v = 1).
Textures are PNG, JPEG or EXR files.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import Field, model_validator

from datagen.formats.base import (
    IDENTITY4,
    ClipRange,
    Matrix4,
    Positive,
    Radiometric3,
    RelativePath,
    Slug,
    StrictModel,
    Unit,
    UnitColor,
    Vector3,
)
from datagen.formats.lights import Light
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.cameras import Camera

ASSET_FILE = "asset.json"
MATERIAL_CLASSES = (
    "wood", "metal", "plastic", "rubber", "leather", "fabric", "ceramic", "stone", "paper", "glazed",
    "painted", "plaster", "glass", "organic", "other",
)  # fmt: skip
MaterialClass = Literal[
    "wood", "metal", "plastic", "rubber", "leather", "fabric", "ceramic", "stone", "paper", "glazed",
    "painted", "plaster", "glass", "organic", "other",
]  # fmt: skip
Surface = Literal[
    "ceiling", "wall", "tiles", "floor", "rug", "joinery", "radiator", "furniture", "tabletop", "worktop",
    "legs", "upholstery", "curtain", "towel", "shade", "appliance", "sanitary", "fitting", "frame", "cover",
    "vessel", "utensil", "gadget", "small",
]  # fmt: skip
"""Role of a surface in a room, which decides the likely materials (``datagen.assembly.looks``)."""
SURFACES: tuple[str, ...] = get_args(Surface)
Daytime = Literal["day", "overcast", "dusk", "night"]
DAYTIMES: tuple[Daytime, ...] = get_args(Daytime)
SupportKind = Literal["floor", "table", "shelf", "seat", "bed", "sill", "counter"]


class Texture(StrictModel):
    """A channel read from an image.

    ``encoding``: ``srgb`` is decoded to linear, ``linear`` is used as stored. ``channel`` selects one
    component for a scalar channel of a material. The value is ``scale * texel + offset``, clamped to [0, 1].
    """

    texture: RelativePath
    encoding: Literal["srgb", "linear"]
    channel: Literal["rgb", "r", "g", "b", "a"] = "rgb"
    scale: float = 1.0
    offset: float = 0.0


ColorChannel = UnitColor | Texture
ScalarChannel = Unit | Texture


MATERIAL_CHANNELS = (*MATERIAL_MAPS, "opacity", "normal")
"""Fields of a material that a texture may fill."""


class Material(StrictModel):
    """The three channels of the project's BSDF, opacity, normal map and emission.

    ``classes``: the first is the main class. ``tile_size_m``: side of the square that one UV unit covers
    on a surface, for materials that may be assigned to any object; None for unique UV layouts. ``normal``:
    tangent-space normal texture (linear, OpenGL convention, +Y up). ``opacity``: 1 = opaque. ``emission``:
    radiance in W/(m^2 sr); an emitter has no ground-truth channels and is masked. ``approximations``:
    sentences about properties that an importer or exporter could not represent.
    """

    classes: Annotated[tuple[MaterialClass, ...], Field(min_length=1)] = ("other",)
    diffuse_albedo: ColorChannel = (0.5, 0.5, 0.5)
    specular_albedo: ColorChannel = (0.04, 0.04, 0.04)
    roughness: ScalarChannel = 0.5
    opacity: ScalarChannel | None = None
    normal: Texture | None = None
    emission: Radiometric3 | None = None
    tile_size_m: Positive | None = None
    approximations: tuple[str, ...] = ()

    def textures(self) -> tuple[Texture, ...]:
        """All textures of the material, in a fixed order."""
        channels = (getattr(self, name) for name in MATERIAL_CHANNELS)
        return tuple(channel for channel in channels if isinstance(channel, Texture))


class SlotMaterial(Material):
    """A material inside an object or environment, with the name of its slot.

    ``replaceable_by``: classes of material that suit the geometry and may replace it; empty = fixed.
    ``baked_from``: the material of which this slot holds a bake for one mesh; slots with the same origin are
    one material and are varied and replaced together. None if the slot is the whole material. ``surface``:
    the slot's role in a room; None: derived from names and shape.
    """

    replaceable_by: tuple[MaterialClass, ...] = ()
    baked_from: Annotated[str, Field(min_length=1)] | None = None
    surface: Surface | None = None


class Part(StrictModel):
    """One mesh with one material; ``asset_from_part`` instances the same mesh file at several positions.

    ``uv_per_m``: median UV units per metre over the mesh, None without UVs; scales tiled materials.
    """

    name: str
    mesh: RelativePath
    material: str
    asset_from_part: Matrix4 = IDENTITY4
    uv_per_m: Positive | None = None


class SupportSurface(StrictModel):
    """Horizontal rectangle ``origin_m + s edge_u_m + t edge_v_m`` on which objects may stand.

    ``clearance_m`` is the free height above it.
    """

    name: str
    kind: SupportKind
    origin_m: Vector3
    edge_u_m: Vector3
    edge_v_m: Vector3
    clearance_m: Positive


class LightSlot(StrictModel):
    """A possible position of a lamp: a rectangle that would emit along edge_u x edge_v, or a point."""

    name: str
    kind: Literal["area", "point"]
    origin_m: Vector3
    edge_u_m: Vector3 = (0.0, 0.0, 0.0)
    edge_v_m: Vector3 = (0.0, 0.0, 0.0)


class Opening(StrictModel):
    """A window or door through which daylight enters; edge_u x edge_v points into the room."""

    name: str
    origin_m: Vector3
    edge_u_m: Vector3
    edge_v_m: Vector3


class Box(StrictModel):
    """Axis-aligned box."""

    minimum_m: Vector3
    maximum_m: Vector3

    @model_validator(mode="after")
    def _ordered(self) -> Box:
        if not all(a < b for a, b in zip(self.minimum_m, self.maximum_m, strict=True)):
            raise ValueError("expected minimum_m < maximum_m in every component")
        return self


class PinholeFields(StrictModel):
    """Name, size and lens of a camera in a file (see ``datagen.foundation.cameras`` for the conventions)."""

    name: str
    width_px: Annotated[int, Field(gt=0, le=65536)]
    height_px: Annotated[int, Field(gt=0, le=65536)]
    fx_px: Positive
    fy_px: Positive
    cx_px: float
    cy_px: float


def lens_of(camera: Camera) -> dict[str, Any]:
    """Size and lens of a camera, by field of :class:`PinholeFields`."""
    return {field: getattr(camera, field) for field in PinholeFields.model_fields if field != "name"}


class AssetCamera(PinholeFields):
    """A camera from an asset's source file (see ``datagen.foundation.cameras`` for the conventions)."""

    asset_from_camera: Matrix4
    clip_m: ClipRange = None

    def camera(self) -> Camera:
        """The camera as a :class:`datagen.foundation.cameras.Camera` in the asset's frame."""
        return Camera.of(self, self.asset_from_camera)


class Provenance(StrictModel):
    """Origin of an asset. ``license`` is an SPDX identifier."""

    license: str
    author: str = ""
    source: str = ""
    usage: Literal["any", "evaluation_only"] = "any"


class _AssetBase(StrictModel):
    format: Literal["scene-materials/asset"] = "scene-materials/asset"
    version: Literal[1] = 1
    id: Slug
    title: str
    provenance: Provenance


class MaterialAsset(_AssetBase):
    """A material that can be assigned to any slot of a suitable class.

    ``surfaces``: surfaces on which the material is usual; empty if its class alone decides.
    """

    kind: Literal["material"] = "material"
    surfaces: tuple[Surface, ...] = ()
    material: Material


class _GeometryAsset(_AssetBase):
    materials: dict[str, SlotMaterial]
    parts: Annotated[tuple[Part, ...], Field(min_length=1)]
    lights: tuple[Light, ...] = ()

    @model_validator(mode="after")
    def _parts_have_materials(self) -> _GeometryAsset:
        for index, part in enumerate(self.parts):
            if part.material not in self.materials:
                known = ", ".join(sorted(self.materials)) or "none"
                raise ValueError(
                    f"expected parts[{index}].material = {part.material!r} to be one of: {known}"
                )
        names = [part.name for part in self.parts]
        if len(set(names)) != len(names):
            raise ValueError("expected every part to have its own name")
        return self


class ObjectAsset(_GeometryAsset):
    """An object that can be placed in a room.

    ``minimum_m`` and ``maximum_m`` bound the meshes (z from 0); the footprint is their x-y rectangle unless
    ``footprint_m`` gives a convex polygon. Scale and yaw are drawn within the ranges given here. ``supports``
    is empty for hanging or built-in objects, which are never placed.
    """

    kind: Literal["object"] = "object"
    category: Slug
    minimum_m: Vector3
    maximum_m: Vector3
    footprint_m: tuple[tuple[float, float], ...] | None = None
    supports: tuple[SupportKind, ...] = ("table", "shelf", "counter")
    scale_range: tuple[Positive, Positive] = (1.0, 1.0)
    yaw_range_rad: tuple[float, float] = (-3.141592653589793, 3.141592653589793)


class EnvironmentAsset(_GeometryAsset):
    """A room: geometry, its own lights, and possible positions of objects, lights and cameras."""

    kind: Literal["environment"] = "environment"
    support_surfaces: tuple[SupportSurface, ...] = ()
    light_slots: tuple[LightSlot, ...] = ()
    openings: tuple[Opening, ...] = ()
    camera_regions: tuple[Box, ...] = ()
    cameras: tuple[AssetCamera, ...] = ()


class PanoramaAsset(_AssetBase):
    """The surroundings of a room: an equirectangular EXR ``image`` of relative radiance, linear Rec.709.

    Its centre column is +Y and its top row +Z. ``daytime`` is the time of day of the photograph, ``overcast``
    a day without shadows.
    """

    kind: Literal["panorama"] = "panorama"
    image: RelativePath
    daytime: Daytime


Asset = Annotated[MaterialAsset | ObjectAsset | EnvironmentAsset | PanoramaAsset, Field(discriminator="kind")]
