# SPDX-License-Identifier: MIT
"""The bilateral solver (Barron and Poole 2016) with dense float64 matrices, for a few hundred pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass
class DenseSystem:
    """Matrices of the bilateral solver for an image of P pixels that occupy V cells of the bilateral grid.

    ``splat`` (V, P) sums pixels by cell; ``smoothness`` (V, V) is lambda (diag(m) - diag(n) B diag(n)), where
    B (V, V) is the blur, and n and m (V,) result from bistochastisation.
    """

    splat: NDArray
    smoothness: NDArray

    def matrix(self, confidence: NDArray) -> NDArray:
        """Matrix (V, V) of the linear system for a channel with ``confidence`` (P,)."""
        return self.smoothness + np.diag(self.splat @ confidence)

    def solve(self, target: NDArray, confidence: NDArray) -> NDArray:
        """Filtered values (P,) of a channel with values ``target`` (P,) and ``confidence`` (P,)."""
        y = np.linalg.solve(self.matrix(confidence), self.splat @ (confidence * target))
        return self.splat.T @ y


def build(guide: NDArray, sigma_xy: float, sigma_luma: float, sigma_chroma: float, lam: float) -> DenseSystem:
    """Build the system of a linear RGB ``guide`` (H, W, 3) with the smoothness weight ``lam``.

    Cell sizes: ``sigma_xy`` in pixels; ``sigma_luma`` and ``sigma_chroma`` in 1/255 of the guide's maximum.
    """
    height, width, _ = guide.shape
    rgb = guide.astype(np.float64) / guide.max() * 255.0
    yuv = np.stack(
        [
            0.299 * rgb[..., 0] + 0.587 * rgb[..., 1] + 0.114 * rgb[..., 2],
            -0.168736 * rgb[..., 0] - 0.331264 * rgb[..., 1] + 0.5 * rgb[..., 2] + 128,
            0.5 * rgb[..., 0] - 0.418688 * rgb[..., 1] - 0.081312 * rgb[..., 2] + 128,
        ],
        axis=-1,
    )
    cells: dict[tuple[int, ...], int] = {}
    pixel_cells = []
    for row in range(height):
        for column in range(width):
            y, u, v = yuv[row, column]
            scaled = (row / sigma_xy, column / sigma_xy, y / sigma_luma, u / sigma_chroma, v / sigma_chroma)
            cell = tuple(int(np.floor(s)) for s in scaled)
            pixel_cells.append(cells.setdefault(cell, len(cells)))
    splat = np.zeros((len(cells), height * width))
    splat[pixel_cells, np.arange(height * width)] = 1.0
    blur = np.zeros((len(cells), len(cells)))
    for a, i in cells.items():
        for b, j in cells.items():
            gap = [abs(p - q) for p, q in zip(a, b, strict=True)]
            if sum(gap) == 0:
                blur[i, j] = 10.0
            elif sum(gap) == 1:
                blur[i, j] = 1.0
    counts = splat.sum(axis=1)
    n = np.ones(len(cells))
    for _ in range(10):  # the default of model.bilateral_solver
        n = np.sqrt(n * counts / (blur @ n))
    m = n * (blur @ n)
    return DenseSystem(splat, lam * (np.diag(m) - n[:, None] * blur * n[None, :]))
