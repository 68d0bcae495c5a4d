# SPDX-License-Identifier: MIT
"""Lookup of the material channels and ids of a scene's shapes in kernels.

A shape's material may be nested in wrappers (``mask``, ``normalmap``, ``twosided``), none of which forwards
attributes in Mitsuba. The tree of wrappers is therefore converted once per scene to a Python function per
material; Dr.Jit compiles these into one indirect call, :func:`drjit.switch`.

Shapes are identified by their index in Mitsuba's registry, the value of a ``ShapePtr`` in a kernel. The index
changes from process to process; the tables here map it to the caller's ids.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.foundation.errors import Problem, Problems, raise_problems
from mitsuba_plugins.cook_torrance import CookTorrance, Lobes
from mitsuba_plugins.texture_checks import exposed, needs_uv

Array = Any
IdTable = Mapping[str, tuple[int, int]]
"""Shape id (its key in the scene's dictionary) -> (instance id, material id); 0 is reserved for "none"."""


@dataclass(frozen=True)
class SurfaceChannels:
    """Material channels of a hit: D, S (Color3f), R (Float), the shading normal and the opacity in [0, 1].

    The unit normal is in the *local* frame of the interaction and on the viewer's side.
    """

    diffuse_albedo: Array
    specular_albedo: Array
    roughness: Array
    normal_local: Array
    opacity: Array

    def diffuse_reflectance(self) -> Array:
        """Return the diffuse reflectance (Color3f) in light that is uniform above the unmapped surface."""
        above = 0.5 + 0.5 * dr.abs(self.normal_local.z)
        return (1.0 - self.specular_albedo) * self.diffuse_albedo * above

    def fresnel(self, wi: Array) -> Array:
        """Return Schlick's Fresnel reflectance (Color3f) for the local direction ``wi`` to the viewer."""
        grazing = 1.0 - dr.minimum(dr.abs(dr.dot(self.normal_local, wi)), 1.0)
        return dr.lerp(self.specular_albedo, 1.0, dr.square(dr.square(grazing)) * grazing)


class SurfaceLobes:
    """BSDF of the ``channels`` at hits ``si``, without their opacity.

    It is compiled once for all materials, whereas calls through ``si.bsdf()`` compile one function for each
    material. Directions are in the frame of ``si``. With ``has_mapped_normals``, as in Mitsuba's
    ``normalmap``, no light is reflected through the unmapped surface, and light near its horizon is shadowed
    (Conty Estevez et al., A Microfacet-Based Shadowing Function to Solve the Bump Terminator Problem, 2019).
    """

    def __init__(self, channels: SurfaceChannels, si: Any, active: Array, has_mapped_normals: bool):
        parameters = (channels.diffuse_albedo, channels.specular_albedo, channels.roughness)
        if not has_mapped_normals:
            self.frame: Any = None
            self._lobes = Lobes(si.wi, *parameters, active)
            return
        normal = mi.Vector3f(channels.normal_local)  # on the viewer's side
        tangent = dr.normalize(dr.fma(-normal.x, normal, mi.Vector3f(1.0, 0.0, 0.0)))
        self.frame = mi.Frame3f(tangent, dr.cross(normal, tangent), normal)
        self._lobes = Lobes(self.frame.to_local(si.wi), *parameters, active)

    def eval_pdf(self, wo: Array) -> tuple[Any, Any]:
        """Return the value f cos_o (Color3f) and the density [1/sr] at ``wo``."""
        if self.frame is None:
            return self._lobes.eval_pdf(wo)
        local = self.frame.to_local(wo)
        value, pdf = self._lobes.eval_pdf(local)
        is_reflected = self._is_reflected(wo, local)
        return dr.select(is_reflected, value * self._shadow(wo), 0.0), dr.select(is_reflected, pdf, 0.0)

    def sample(self, sample1: Array, sample2: Array) -> tuple[Any, Any, Any]:
        """Sample a direction; return it, its density [1/sr] and the weight f cos_o / pdf (0: no sample)."""
        bs, weight = self._lobes.sample(sample1, sample2)
        if self.frame is None:
            return bs.wo, bs.pdf, weight
        wo = self.frame.to_world(bs.wo)
        is_reflected = self._is_reflected(wo, bs.wo)
        shadowed = dr.select(is_reflected, weight * self._shadow(wo), 0.0)
        return wo, dr.select(is_reflected, bs.pdf, 0.0), shadowed

    def _is_reflected(self, wo: Array, mapped: Array) -> Array:
        """Return whether ``wo`` is on the viewer's side of the unmapped surface and of the mapped one.

        ``mapped`` is ``wo`` in the frame of the mapped normal.
        """
        return dr.mulsign(wo.z, self.frame.n.z) * mapped.z > 0.0

    def _shadow(self, wo: Array) -> Array:
        alpha2 = dr.minimum(0.125 * mi.Frame3f.tan_theta_2(self.frame.n), 1.0)
        return 2.0 / (1.0 + dr.sqrt(1.0 + alpha2 * mi.Frame3f.tan_theta_2(wo)))


Channels = tuple[Any, Any, Any, Any, Any]
"""The values of :class:`SurfaceChannels`."""
Evaluator = Callable[[Any, Any], Channels]
"""Function of interaction and active mask."""


def _cook_torrance(bsdf: CookTorrance, si: Any, active: Any) -> Channels:
    diffuse, specular, roughness = bsdf.surface_parameters(si, active)
    if not bsdf.two_sided:  # the back of a one-sided surface reflects nothing
        is_front = si.wi.z > 0.0
        diffuse, specular = dr.select(is_front, diffuse, 0.0), dr.select(is_front, specular, 0.0)
    normal = mi.Normal3f(0.0, 0.0, dr.mulsign(mi.Float(1.0), si.wi.z))
    return diffuse, specular, roughness, normal, mi.Float(1.0)


def _mask(opacity_texture: Any, nested: Evaluator, si: Any, active: Any) -> Channels:
    *channels, nested_opacity = nested(si, active)
    opacity = dr.clip(opacity_texture.eval_1(si, active), 0.0, 1.0)
    return (*channels, opacity * nested_opacity)


def _normal_map(texture: Any, nested: Evaluator, si: Any, active: Any) -> Channels:
    normal = dr.fma(mi.Normal3f(texture.eval_3(si, active)), 2.0, -1.0)
    # Mitsuba's rule for a mapped normal that faces away from the viewer (flip_invalid_normals).
    is_invalid = si.wi.z * dr.dot(si.wi, normal) <= 0.0
    tangential = dr.select(is_invalid, -1.0, 1.0)
    normal = mi.Normal3f(normal.x * tangential, normal.y * tangential, normal.z)
    length2 = dr.squared_norm(normal)
    is_degenerate = ~(length2 > 1e-12)  # a black texel encodes no direction
    normal = dr.select(is_degenerate, mi.Normal3f(0.0, 0.0, 1.0), normal * dr.rsqrt(length2))
    # The nested material depends only on the side of wi in the mapped frame.
    side = dr.mulsign(mi.Float(1.0), dr.dot(normal, si.wi))
    nested_si = mi.SurfaceInteraction3f(si)
    nested_si.wi = mi.Vector3f(0.0, 0.0, side)
    diffuse, specular, roughness, _, opacity = nested(nested_si, active)
    return diffuse, specular, roughness, normal * side, opacity


def _two_sided(front: Evaluator, back: Evaluator, si: Any, active: Any) -> Channels:
    is_front = si.wi.z > 0.0
    mirrored = mi.SurfaceInteraction3f(si)
    mirrored.wi = mi.Vector3f(si.wi.x, si.wi.y, dr.abs(si.wi.z))
    channels = front(mirrored, active)
    if back is not front:
        other = back(mirrored, active)
        channels = tuple(dr.select(is_front, f, b) for f, b in zip(channels, other, strict=True))
    diffuse, specular, roughness, normal, opacity = channels
    normal = mi.Normal3f(normal.x, normal.y, dr.mulsign(normal.z, si.wi.z))
    return diffuse, specular, roughness, normal, opacity


class UnsupportedBsdf(Exception):
    """Exception for a BSDF other than ``cook_torrance``, alone or in supported wrappers."""


def build_evaluator(bsdf: Any) -> tuple[Evaluator, bool]:
    """Convert a tree of BSDFs to an evaluator of its channels; also return whether it can be transparent.

    Raises :class:`UnsupportedBsdf` with the class name if the tree contains anything but ``cook_torrance``,
    alone or in ``mask``, ``normalmap`` and ``twosided``.
    """
    if isinstance(bsdf, CookTorrance):
        return partial(_cook_torrance, bsdf), False
    kind = bsdf.class_name()
    children, _ = exposed(bsdf)
    if kind == "MaskBSDF":
        nested, _ = build_evaluator(children["nested_bsdf"])
        return partial(_mask, children["opacity"], nested), True
    if kind == "NormalMap":
        if children["nested_bsdf"].class_name() in ("NormalMap", "TwoSidedBRDF"):
            raise UnsupportedBsdf(f"NormalMap around {children['nested_bsdf'].class_name()}")
        nested, is_transparent = build_evaluator(children["nested_bsdf"])
        return partial(_normal_map, children["normalmap"], nested), is_transparent
    if kind == "TwoSidedBRDF":
        front, is_transparent = build_evaluator(children["brdf_0"])
        back = front
        if children.get("brdf_1", children["brdf_0"]) is not children["brdf_0"]:
            back, is_back_transparent = build_evaluator(children["brdf_1"])
            is_transparent |= is_back_transparent
        return partial(_two_sided, front, back), is_transparent
    raise UnsupportedBsdf(kind)


def _has_normal_map(bsdf: Any) -> bool:
    children = exposed(bsdf)[0].values()
    nested = (child for child in children if isinstance(child, mi.BSDF))
    return bsdf.class_name() == "NormalMap" or any(_has_normal_map(child) for child in nested)


def _nothing(si: Any, active: Any) -> Channels:
    """Return the channels of emitters and of the background, which have no ground truth."""
    return mi.Color3f(0.0), mi.Color3f(0.0), mi.Float(0.0), mi.Normal3f(0.0, 0.0, 1.0), mi.Float(1.0)


def invisible(si: Any, active: Any) -> Channels:
    """Return D, S, R, normal and opacity of the invisible BSDF ``null``: all 0 but the normal."""
    return mi.Color3f(0.0), mi.Color3f(0.0), mi.Float(0.0), mi.Normal3f(0.0, 0.0, 1.0), mi.Float(0.0)


def number_shapes(scene: mi.Scene) -> dict[str, tuple[int, int]]:
    """Return an id table that numbers a scene's shapes, except lights, and their BSDFs from 1, in order.

    Keys are shape ids; equal ids, as in scenes read from XML, become ``id``, ``id#2``, ``id#3``...
    """
    materials: dict[int, int] = {}
    bsdfs = []  # kept alive: id() is unique only while objects exist
    table: dict[str, tuple[int, int]] = {}
    for shape, name in zip(scene.shapes(), _unique_names(scene.shapes()), strict=True):
        if shape.is_emitter():
            continue
        bsdfs.append(shape.bsdf())
        material = materials.setdefault(id(bsdfs[-1]), len(materials) + 1)
        table[name] = (len(table) + 1, material)
    return table


def registry_indices(scene: mi.Scene) -> NDArray[np.int64]:
    """Return the indices (N,) of a scene's N shapes in Mitsuba's registry, in the scene's order."""
    pointers: Any = scene.shapes_dr()
    return np.asarray(dr.reinterpret_array(mi.UInt32, pointers)).astype(np.int64)


def _unique_names(shapes: Sequence[Any]) -> list[str]:
    counts: dict[str, int] = {}
    names = []
    for shape in shapes:
        count = counts[shape.id()] = counts.get(shape.id(), 0) + 1
        names.append(shape.id() if count == 1 else f"{shape.id()}#{count}")
    return names


class SceneMaterials:
    """The materials and ids of all shapes of a scene, for evaluation in kernels.

    ``ids`` maps shape ids to (instance id, material id), both in [1, 2^24); None numbers them in the scene's
    order. Raises an :class:`InputError` that lists every shape whose BSDF is not supported, that is missing
    from ``ids``, or whose textures need UVs that its mesh lacks.
    """

    def __init__(self, scene: mi.Scene, ids: IdTable | None = None):
        self.ids = dict(ids) if ids is not None else number_shapes(scene)
        problems = Problems("scene")
        self._evaluators: list[Evaluator] = [_nothing]
        self.has_transparency = False
        self.has_mapped_normals = False
        # By id(bsdf): index of the evaluator, whether it needs UVs, and the BSDF, which keeps the Python
        # wrapper of the C++ object alive: id() identifies it only while it exists.
        self._materials: dict[int, tuple[int, bool, Any]] = {}
        shapes: Sequence[Any] = scene.shapes()
        registry = registry_indices(scene)
        size = int(registry.max(initial=0)) + 1
        evaluator_index = np.zeros(size, np.uint32)
        instance_ids = np.zeros(size, np.uint32)
        material_ids = np.zeros(size, np.uint32)
        is_emitter = np.zeros(size, bool)
        for shape, name, index in zip(shapes, _unique_names(shapes), registry, strict=True):
            if shape.is_emitter():
                is_emitter[index] = True
                continue
            evaluator_index[index] = self._evaluator_index(shape, name, problems)
            if name in self.ids:
                instance_ids[index], material_ids[index] = self._checked_ids(name, problems)
            elif evaluator_index[index]:
                remedy = "add the shape to the table, and load the scene with optimize=False"
                problems.add(f"shape {name}", "no ids", "an entry in the id table", remedy)
        raise_problems(problems)
        self._evaluator_of_shape = mi.UInt32(evaluator_index)
        self._instance_of_shape = mi.UInt32(instance_ids)
        self._material_of_shape = mi.UInt32(material_ids)
        self._is_emitter_shape = mi.Bool(is_emitter)

    def _checked_ids(self, shape_id: str, problems: Problems) -> tuple[int, int]:
        instance, material = self.ids[shape_id]
        for name, value in (("instance id", instance), ("material id", material)):
            if not 0 < value < 2**24:
                where, expected = f"{shape_id}: {name}", "1 ... 16777215 (exact in a float)"
                problems.append(Problem("id table", where, str(value), expected, "number ids from 1"))
                return 0, 0
        return instance, material

    def _evaluator_index(self, shape: Any, name: str, problems: Problems) -> int:
        """Return the index of the shape's material among the evaluators; 0 if a problem was added."""
        if shape.class_name() == "Instance":
            problems.add(f"shape {name}", "an instance", "a shape with its own material", "expand instances")
            return 0
        bsdf = shape.bsdf()
        if id(bsdf) not in self._materials:
            self._materials[id(bsdf)] = self._add_evaluator(bsdf, name, problems), needs_uv(bsdf), bsdf
        index, has_textures, _ = self._materials[id(bsdf)]
        if has_textures and shape.is_mesh() and not shape.has_vertex_texcoords():
            expected = "UVs, which its material's textures need"
            problems.add(f"shape {name}", "a mesh without UVs", expected, "unwrap the mesh")
        return index

    def _add_evaluator(self, bsdf: Any, name: str, problems: Problems) -> int:
        if bsdf.class_name() == "Null":
            self._evaluators.append(invisible)
            self.has_transparency = True
            return len(self._evaluators) - 1
        try:
            evaluator, is_transparent = build_evaluator(bsdf)
        except UnsupportedBsdf as unsupported:
            expected = "cook_torrance, alone or in mask, normalmap or twosided"
            remedy = "convert the material to cook_torrance first"
            problems.add(f"BSDF of shape {name}", unsupported, expected, remedy)
            return 0
        self._evaluators.append(evaluator)
        self.has_transparency |= is_transparent
        self.has_mapped_normals |= _has_normal_map(bsdf)
        return len(self._evaluators) - 1

    # ---- inside kernels ----------------------------------------------------------------------------------

    def tables(self) -> list[Any]:
        """Return the arrays that kernels read in :meth:`channels_at` besides the arrays of the scene."""
        return [self._evaluator_of_shape]

    def _registry_index(self, si: mi.SurfaceInteraction3f) -> Array:
        return dr.reinterpret_array(mi.UInt32, si.shape)

    def shape_index(self, si: mi.SurfaceInteraction3f) -> Array:
        """Return the registry index of the shape that was hit; 0 for none."""
        return self._registry_index(si)

    def is_emitter(self, si: mi.SurfaceInteraction3f, active: Array) -> Array:
        """Return the mask of the hits ``si`` that are on lights."""
        return dr.gather(mi.Bool, self._is_emitter_shape, self._registry_index(si), active)

    def ids_at(self, shape_index: Array) -> tuple[Any, Any]:
        """Return (instance id, material id) of shapes by registry index; 0 for none and for lights."""
        return (
            dr.gather(mi.UInt32, self._instance_of_shape, shape_index),
            dr.gather(mi.UInt32, self._material_of_shape, shape_index),
        )

    def channels_at(self, si: mi.SurfaceInteraction3f, active: Array) -> SurfaceChannels:
        """Return the channels at the hits ``si``; 0 where inactive; on lights, 0 except for opacity 1."""
        return self._evaluated(self._evaluator_of_shape, si, active)

    def _evaluated(
        self, evaluator_of_shape: Array, si: mi.SurfaceInteraction3f, active: Array
    ) -> SurfaceChannels:
        index = dr.gather(mi.UInt32, evaluator_of_shape, self._registry_index(si), active)
        return SurfaceChannels(*dr.switch(index, self._evaluators, si, active))
