# SPDX-License-Identifier: MIT
"""Integrals of spherical Gaussians in float64, by midpoint sums over the sphere or the hemisphere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def inner_product(axis1: NDArray, sharpness1: float, axis2: NDArray, sharpness2: float) -> float:
    """Integral over the sphere of the product of two lobes exp(sharpness (axis.w - 1)) with unit axes."""
    axis = sharpness1 * axis1 + sharpness2 * axis2
    length = np.linalg.norm(axis)
    # the product at direction w is exp(axis.w - sharpness1 - sharpness2); z is the cosine of w with the axis
    z = (np.arange(4_000_000) + 0.5) / 4_000_000 * 2 - 1
    values = np.exp(length * z - sharpness1 - sharpness2)
    return float(2 * np.pi * values.mean() * 2)


def irradiance(sharpness: float, cos_beta: float, num_z: int = 3000, num_phi: int = 600) -> float:
    """Integral over the hemisphere of a lobe times the cosine; beta is the angle from lobe axis to normal."""
    z = (np.arange(num_z) + 0.5) / num_z
    phi = (np.arange(num_phi) + 0.5) / num_phi * 2 * np.pi
    z, phi = np.meshgrid(z, phi, indexing="ij")
    sin_beta = np.sqrt(max(0.0, 1 - cos_beta**2))
    cos_angle = z * cos_beta + np.sqrt(1 - z * z) * np.cos(phi) * sin_beta
    return float((np.exp(sharpness * (cos_angle - 1)) * z).mean() * 2 * np.pi)
