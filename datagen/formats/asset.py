# SPDX-License-Identifier: MIT
"""Asset packages: rooms, objects, materials and panoramas on disk (``asset.json`` in a folder or a zip).

Frames are in metres, right-handed, Z up. An object rests on z = 0 of its frame, with its footprint around the
origin; its front faces -Y. Meshes are binary little-endian PLY with vertex positions (x y z), normals (nx ny
nz) and, if a texture needs them, texture coordinates (u v, v upwards: row 0 of an image is at v = 1).
Textures are PNG, JPEG or EXR files.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

import numpy as np
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
    check_unique,
)
from datagen.formats.lights import Light
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.cameras import Camera

ASSET_FILE = "asset.json"
MaterialClass = Literal[
    "wood", "metal", "plastic", "rubber", "leather", "fabric", "ceramic", "stone", "paper", "glazed",
    "painted", "plaster", "glass", "organic", "other",
]  # fmt: skip
MATERIAL_CLASSES: tuple[str, ...] = get_args(MaterialClass)
Surface = Literal[
    "ceiling", "wall", "tiles", "floor", "rug", "joinery", "radiator", "furniture", "tabletop", "worktop",
    "legs", "upholstery", "curtain", "towel", "shade", "appliance", "sanitary", "fitting", "frame", "cover",
    "vessel", "utensil", "gadget", "small",
]  # fmt: skip
"""Role of a surface in a room; determines its likely materials (``datagen.assembly.looks``)."""
SURFACES: tuple[str, ...] = get_args(Surface)
Daytime = Literal["day", "overcast", "dusk", "night"]
DAYTIMES: tuple[Daytime, ...] = get_args(Daytime)
SupportKind = Literal["floor", "table", "shelf", "seat", "bed", "sill", "counter"]


class Texture(StrictModel):
    """A channel of a material read from an image: ``scale * texel + offset``, clamped to [0, 1].

    ``encoding``: ``srgb`` texels are decoded to linear, except alpha; ``linear`` ones are used as stored.
    ``channel``: ``rgb`` (its luminance if the material's channel is scalar), or a single component.
    """

    texture: RelativePath
    encoding: Literal["srgb", "linear"]
    channel: Literal["rgb", "r", "g", "b", "a"] = "rgb"
    scale: float = 1.0
    offset: float = 0.0


ColorChannel = UnitColor | Texture
ScalarChannel = Unit | Texture


MATERIAL_CHANNELS = (*MATERIAL_MAPS, "opacity", "normal")
"""Fields of a material that may be textures."""


class Material(StrictModel):
    """A material: D, S and R of the project's BSDF, opacity, normal map and emission.

    ``classes``: the first is the main class. ``tile_size_m``: length of one UV unit on a surface, for
    materials that may be assigned to any object; None for textures made for one mesh. ``normal``:
    tangent-space normal texture (linear, OpenGL convention, +Y up). ``opacity``: 1 = opaque. ``emission``:
    radiance in W/(m^2 sr); emitters have no ground truth and are outside ``surface_mask``.
    ``approximations``: sentences about properties that an importer or exporter could not represent.
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
    """The material of a slot of an object or environment; its key in ``materials`` names the slot.

    ``replaceable_by``: classes of the materials that may replace it; empty = fixed. ``baked_from``: name of
    the source material, if this one was baked from it for a mesh; slots of the same source are varied and
    replaced together. ``surface``: the slot's role in a room; None: derived from names and shape.
    """

    replaceable_by: tuple[MaterialClass, ...] = ()
    baked_from: Annotated[str, Field(min_length=1)] | None = None
    surface: Surface | None = None


class Part(StrictModel):
    """One mesh with the material of one slot; parts with different ``asset_from_part`` may share a mesh file.

    ``uv_per_m``: median number of UV units per metre, for scaling tiled materials; None without UVs.
    """

    name: str
    mesh: RelativePath
    material: str
    asset_from_part: Matrix4 = IDENTITY4
    uv_per_m: Positive | None = None


class SupportSurface(StrictModel):
    """Horizontal rectangle on which objects may stand, with free height ``clearance_m`` above it.

    Its points are ``origin_m + s edge_u_m + t edge_v_m``, s and t in [0, 1].
    """

    name: str
    kind: SupportKind
    origin_m: Vector3
    edge_u_m: Vector3
    edge_v_m: Vector3
    clearance_m: Positive


class LightSlot(StrictModel):
    """A possible position of a lamp: a point, or a rectangle that emits along edge_u x edge_v."""

    name: str
    kind: Literal["area", "point"]
    origin_m: Vector3
    edge_u_m: Vector3 = (0.0, 0.0, 0.0)
    edge_v_m: Vector3 = (0.0, 0.0, 0.0)


class Opening(StrictModel):
    """Rectangle of a window or door that admits daylight; edge_u x edge_v points into the room."""

    name: str
    origin_m: Vector3
    edge_u_m: Vector3
    edge_v_m: Vector3


class Box(StrictModel):
    """Axis-aligned box in the asset's frame."""

    minimum_m: Vector3
    maximum_m: Vector3

    @model_validator(mode="after")
    def _ordered(self) -> Box:
        if not all(a < b for a, b in zip(self.minimum_m, self.maximum_m, strict=True)):
            raise ValueError("expected minimum_m < maximum_m in every component")
        return self


class PinholeFields(StrictModel):
    """Name, image size and intrinsics of a camera in a file (conventions: ``datagen.foundation.cameras``)."""

    name: str
    width_px: Annotated[int, Field(gt=0, le=65536)]
    height_px: Annotated[int, Field(gt=0, le=65536)]
    fx_px: Positive
    fy_px: Positive
    cx_px: float
    cy_px: float


def lens_of(record: Camera | PinholeFields) -> dict[str, Any]:
    """Image size and intrinsics of a camera, as keyword arguments of :class:`PinholeFields`."""
    return {field: getattr(record, field) for field in PinholeFields.model_fields if field != "name"}


class AssetCamera(PinholeFields):
    """A camera from an asset's source file, in the asset's frame."""

    asset_from_camera: Matrix4
    clip_m: ClipRange = None

    def camera(self) -> Camera:
        pose = np.array(self.asset_from_camera, dtype=np.float64)
        return Camera(**lens_of(self), world_from_camera=pose, clip_m=self.clip_m)


class Provenance(StrictModel):
    """Origin of an asset. ``license``: SPDX identifier; ``usage: evaluation_only`` excludes it from plans."""

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
    """A material that can be assigned to the slots that accept its main class (``replaceable_by``).

    ``surfaces``: surfaces on which the material is common; empty if only its class matters.
    """

    kind: Literal["material"] = "material"
    surfaces: tuple[Surface, ...] = ()
    material: Material


class GeometryAsset(_AssetBase):
    """Base of objects and environments: meshes with materials, and lights."""

    materials: dict[str, SlotMaterial]
    parts: Annotated[tuple[Part, ...], Field(min_length=1)]
    lights: tuple[Light, ...] = ()

    @model_validator(mode="after")
    def _parts_have_materials(self) -> GeometryAsset:
        for index, part in enumerate(self.parts):
            if part.material not in self.materials:
                known = ", ".join(sorted(self.materials)) or "none"
                raise ValueError(
                    f"expected parts[{index}].material = {part.material!r} to be one of: {known}"
                )
        check_unique("the parts", self.parts)
        return self


class ObjectAsset(GeometryAsset):
    """An object that can be placed in a room.

    ``minimum_m`` and ``maximum_m`` are the corners of the meshes' bounding box, whose lowest z is 0. The
    footprint is the convex hull of the meshes' x-y projection (``footprint_m`` is ignored). Each placement
    draws a scale and a yaw from ``scale_range`` and ``yaw_range_rad``. ``supports``: kinds of surfaces on
    which it may stand; objects that list none, such as hanging and built-in ones, are never placed.
    """

    kind: Literal["object"] = "object"
    category: Slug
    minimum_m: Vector3
    maximum_m: Vector3
    footprint_m: tuple[tuple[float, float], ...] | None = None
    supports: tuple[SupportKind, ...] = ("table", "shelf", "counter")
    scale_range: tuple[Positive, Positive] = (1.0, 1.0)
    yaw_range_rad: tuple[float, float] = (-3.141592653589793, 3.141592653589793)


class EnvironmentAsset(GeometryAsset):
    """A room: geometry, lights, and possible positions of objects, added lights and cameras."""

    kind: Literal["environment"] = "environment"
    support_surfaces: tuple[SupportSurface, ...] = ()
    light_slots: tuple[LightSlot, ...] = ()
    openings: tuple[Opening, ...] = ()
    camera_regions: tuple[Box, ...] = ()
    cameras: tuple[AssetCamera, ...] = ()


class PanoramaAsset(_AssetBase):
    """The surroundings of a room: an equirectangular EXR ``image`` of relative radiance, linear Rec.709.

    Its centre column faces +Y and its top row +Z. ``daytime``: time of day of the photograph; ``overcast``
    means a day without shadows.
    """

    kind: Literal["panorama"] = "panorama"
    image: RelativePath
    daytime: Daytime


Asset = Annotated[MaterialAsset | ObjectAsset | EnvironmentAsset | PanoramaAsset, Field(discriminator="kind")]
