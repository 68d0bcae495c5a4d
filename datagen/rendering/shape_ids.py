# SPDX-License-Identifier: MIT
"""Ids of merged shapes for the ground-truth pass, looked up by triangle instead of by shape."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datagen.foundation.errors import Problems, raise_problems
from datagen.rendering.scene_builder import BuiltScene
from mitsuba_plugins.surface_material import (
    SceneMaterials,
    SurfaceChannels,
    invisible,
    registry_indices,
)

Array = Any


class MergedShapeMaterials(SceneMaterials):
    """:class:`SceneMaterials` of a :class:`BuiltScene`.

    Ids are looked up by a triangle's index in the scene, which starts at 1; 0 means no triangle. Lights
    hidden from the camera count as fully transparent surfaces.
    """

    def __init__(self, built: BuiltScene):
        shape_ids = {name: (1, material) for name, material in built.shape_materials.items()}
        super().__init__(built.scene, shape_ids)
        registry = registry_indices(built.scene)
        first_face = np.zeros(int(registry.max(initial=0)) + 1, np.uint32)
        instances, materials = [np.zeros(1, np.uint32)], [np.zeros(1, np.uint32)]
        num_faces = 1
        for shape, index in zip(built.scene.shapes(), registry, strict=True):
            name = shape.id()
            faces = built.face_instances.get(name)
            if faces is None or shape.is_emitter():  # lights have depth, but no ids
                faces = np.zeros(max(int(shape.primitive_count()), 1), np.uint32)
            first_face[index] = num_faces
            instances.append(faces)
            materials.append(np.where(faces > 0, built.shape_materials.get(name, 0), 0).astype(np.uint32))
            num_faces += len(faces)
        self._first_face = mi.UInt32(first_face)
        self._instance_of_face = mi.UInt32(np.concatenate(instances))
        self._material_of_face = mi.UInt32(np.concatenate(materials))
        self._bsdf_of_shape = self._bsdfs_with_lights(built, registry)
        self._hide(built, registry)

    def _bsdfs_with_lights(self, built: BuiltScene, registry: NDArray[np.int64]) -> Any:
        """Table from a shape's registry index to the index of its channel evaluator, also for lights."""
        problems = Problems("scene")
        evaluator = np.array(self._evaluator_of_shape)
        for shape, index in zip(built.scene.shapes(), registry, strict=True):
            evaluator[index] = self._evaluator_index(shape, shape.id(), problems)
        raise_problems(problems)
        return mi.UInt32(evaluator)

    def _hide(self, built: BuiltScene, registry: NDArray[np.int64]) -> None:
        if not built.hidden_shapes:
            return
        self._evaluators.append(invisible)
        self.has_transparency = True
        evaluator = np.array(self._evaluator_of_shape)
        is_emitter = np.array(self._is_emitter_shape)
        for shape, index in zip(built.scene.shapes(), registry, strict=True):
            if shape.id() in built.hidden_shapes:
                evaluator[index] = len(self._evaluators) - 1
                is_emitter[index] = False
        self._evaluator_of_shape = mi.UInt32(evaluator)
        self._is_emitter_shape = mi.Bool(is_emitter)

    def tables(self) -> list[Any]:
        """Arrays that a recorded kernel reads, in addition to those of the scene."""
        return [*super().tables(), self._bsdf_of_shape]

    def reflecting_channels_at(self, si: mi.SurfaceInteraction3f, active: Array) -> SurfaceChannels:
        """Return channels at the hit ``si`` like :meth:`channels_at`, but also for the surfaces of lights."""
        return self._evaluated(self._bsdf_of_shape, si, active)

    def shape_index(self, si: mi.SurfaceInteraction3f) -> Array:
        """Index of the triangle that was hit; 0 for none."""
        is_hit = si.is_valid()
        first = dr.gather(mi.UInt32, self._first_face, self._registry_index(si), is_hit)
        return dr.select(is_hit, first + si.prim_index, 0)

    def ids_at(self, shape_index: Array) -> tuple[Any, Any]:
        """Instance ids and material ids of the triangles numbered by :meth:`shape_index`; 0 for lights."""
        return (
            dr.gather(mi.UInt32, self._instance_of_face, shape_index),
            dr.gather(mi.UInt32, self._material_of_face, shape_index),
        )
