# SPDX-License-Identifier: GPL-3.0-or-later
"""Channels of an exported package at random points of its surface."""

from __future__ import annotations

import numpy as np

from datagen.formats.asset import SlotMaterial, Texture
from datagen.formats.package import Package
from datagen.formats.textures import texture_values
from datagen.foundation.images import read_image
from datagen.foundation.meshes.mesh import Mesh
from tests.blender_addon.graphs import lookup

SCALARS = ("roughness", "opacity")
SAMPLES_PER_TRIANGLE = 40


def surface_samples(mesh: Mesh, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random points (N, 3) on the mesh and their UVs (N, 2), which are 0 without a UV map."""
    generator = np.random.default_rng(seed)
    faces = mesh.faces
    weights = generator.dirichlet((1, 1, 1), (len(faces), SAMPLES_PER_TRIANGLE))
    points = np.einsum("tsk,tkc->tsc", weights, mesh.positions[faces].astype(float)).reshape(-1, 3)
    if mesh.uv is None:
        return points, np.zeros((len(points), 2))
    return points, np.einsum("tsk,tkc->tsc", weights, mesh.uv[faces].astype(float)).reshape(-1, 2)


def channel_at(package: Package, material: SlotMaterial, name: str, uv: np.ndarray) -> np.ndarray:
    value = getattr(material, name)
    is_scalar = name in SCALARS
    if isinstance(value, Texture):
        pixels = texture_values(value, read_image(package.path / value.texture), is_scalar).astype(float)
        sampled = lookup(pixels[..., None] if is_scalar else pixels, uv)
        return sampled[:, 0] if is_scalar else sampled
    if value is None:
        assert name == "opacity"
        value = 1.0
    return np.broadcast_to(value, (len(uv),) if is_scalar else (len(uv), 3))
