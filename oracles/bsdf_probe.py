# SPDX-License-Identifier: MIT
"""Evaluates the plugin ``cook_torrance`` for NumPy arrays of directions and materials."""

from __future__ import annotations

from typing import Any

import numpy as np

from mitsuba_plugins import register, select_variant
from oracles import VARIANT

select_variant(VARIANT)
register()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

EPS = float(np.finfo(np.float32).eps)
# Angles of wi from the normal; the last is 1e-6 rad above the horizon.
_DEGREES = [0.0, 1.0, 10.0, 30.0, 45.0, 60.0, 75.0, 85.0, 89.0, 89.9]
ANGLES_RAD = np.concatenate([np.radians(_DEGREES), np.pi / 2 - np.array([1e-4, 1e-5, 1e-6])])
ROUGHNESS = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])


def vector(array: np.ndarray) -> Any:
    """Convert an array (n, 3) to a Vector3f."""
    a = np.asarray(array, np.float32)
    return mi.Vector3f(*(mi.Float(np.ascontiguousarray(a[:, i])) for i in range(3)))


def color(array: np.ndarray) -> Any:
    """Convert an array (n, 3) to a Color3f."""
    v = vector(array)
    return mi.Color3f(v.x, v.y, v.z)


def array(value: Any) -> np.ndarray:
    """Convert a Dr.Jit array to NumPy, (n,) or (n, 3)."""
    a = np.array(value)
    return a.T if a.ndim == 2 else a


def _layout(n: int) -> tuple[int, int]:
    width = int(np.ceil(np.sqrt(n)))
    return width, int(np.ceil(n / width))


def interaction(wi: np.ndarray) -> Any:
    """SurfaceInteraction3f with local directions ``wi`` (n, 3); lane i uses texel i of :func:`material`."""
    n = len(wi)
    width, height = _layout(n)
    index = np.arange(n)
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = vector(wi)
    si.uv = mi.Point2f(
        mi.Float(((index % width + 0.5) / width).astype(np.float32)),
        mi.Float(((index // width + 0.5) / height).astype(np.float32)),
    )
    si.sh_frame = mi.Frame3f(mi.Vector3f(0.0, 0.0, 1.0))
    si.n = mi.Normal3f(0.0, 0.0, 1.0)
    si.dp_du = mi.Vector3f(1.0, 0.0, 0.0)
    si.t = mi.Float(1.0)  # type: ignore[assignment]  # Mitsuba's stubs
    return si


def _texels(values: np.ndarray) -> np.ndarray:
    width, height = _layout(len(values))
    flat = np.zeros((width * height, values.shape[1]), np.float32)
    flat[: len(values)] = values
    return flat.reshape(height, width, -1)


def material(diffuse: Any, specular: Any, roughness: Any, num: int = 1, **options: Any) -> Any:
    """Create a ``cook_torrance`` BSDF with n = ``num`` texels from D, S (n, 3) and R (n,), or from scalars.

    Values are set after construction, so they may be outside the range that the plugin accepts.
    """
    d, s = (np.broadcast_to(np.asarray(a, np.float32), (num, 3)) for a in (diffuse, specular))
    r = np.broadcast_to(np.asarray(roughness, np.float32), (num,))[:, None]
    channels = {"diffuse_albedo": _texels(d), "specular_albedo": _texels(s), "roughness": _texels(r)}
    bitmap = dict(type="bitmap", raw=True, filter_type="nearest", wrap_mode="clamp", format="variant")
    textures = {
        name: {**bitmap, "bitmap": mi.Bitmap(np.zeros_like(texels))} for name, texels in channels.items()
    }
    bsdf = mi.load_dict({"type": "cook_torrance", **textures, **options})
    parameters = mi.traverse(bsdf)
    for name, texels in channels.items():
        parameters[f"{name}.data"] = mi.TensorXf(texels)
    parameters.update()
    return bsdf


def unit_float32(w: np.ndarray) -> np.ndarray:
    """Round directions (n, 3) to float32, the precision of the BSDF; returns float64, not normalised."""
    return np.asarray(w, np.float32).astype(np.float64)
