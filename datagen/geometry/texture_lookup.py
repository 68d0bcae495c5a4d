# SPDX-License-Identifier: MIT
"""Values of a texture at the pixels of a view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import ViewGeometry


def pixel_uv(mesh: Mesh, camera: Camera, geometry: ViewGeometry) -> NDArray[np.float64]:
    """Return the UVs (H, W, 2) of ``mesh`` at each pixel's centre, NaN off surfaces and on emitters.

    ``geometry`` is the result of tracing ``camera`` against ``mesh``, which must have UVs.
    """
    assert mesh.uv is not None
    face = np.maximum(geometry.face, 0)
    rays = camera.ray_directions()
    depth = geometry.depth_z_m[..., 0].astype(np.float64)
    points = camera.position_m + rays * (depth / (rays @ camera.forward))[..., None]
    a, b, c = np.moveaxis(mesh.triangles()[face], -2, 0)
    normal = np.cross(b - a, c - a)
    area = np.maximum((normal**2).sum(axis=-1), 1e-300)
    s = (np.cross(points - a, c - a) * normal).sum(axis=-1) / area
    t = (np.cross(b - a, points - a) * normal).sum(axis=-1) / area
    shares = np.stack([1 - s - t, s, t], axis=-1)[..., None]
    uv = (shares * mesh.uv[mesh.faces[face]]).sum(axis=-2)
    return np.where(geometry.surface_mask > 0, uv, np.nan)


def looked_up(array: NDArray, uv: NDArray) -> NDArray[np.float64]:
    """Interpolate a map (N, N, C) bilinearly at UVs (K, 2), clamped at the border; return values (K, C)."""
    size = array.shape[0]
    x = np.clip(uv[:, 0] * size - 0.5, 0, size - 1)
    y = np.clip((1 - uv[:, 1]) * size - 0.5, 0, size - 1)
    left, top = x.astype(np.int64), y.astype(np.int64)
    right, bottom = np.minimum(left + 1, size - 1), np.minimum(top + 1, size - 1)
    s, t = (x - left)[:, None], (y - top)[:, None]
    upper = array[top, left] * (1 - s) + array[top, right] * s
    lower = array[bottom, left] * (1 - s) + array[bottom, right] * s
    return np.asarray(upper * (1 - t) + lower * t, np.float64)
