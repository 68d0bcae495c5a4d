# SPDX-License-Identifier: MIT
"""The fast bilateral solver (Barron and Poole 2016) in torch, with its analytic adjoint.

The solver smooths a map t inside the regions of a guide image, weighting each pixel by its confidence c. P
and V are the numbers of pixels and of occupied grid cells ("vertices") of all images of a batch. S (V x P)
sums pixels into cells, S^T copies cells to pixels. B (V x V) is the blur over the grid: 10 on the diagonal
and 1 for each occupied neighbour along x, y, luma and the two chromas. n scales the blur such that the row
sums m of diag(n) B diag(n) are the numbers of pixels per cell. The system of one channel, with the weight
lambda of the smoothness term, is

    A y = S (c t),   A = lambda (diag(m) - diag(n) B diag(n)) + diag(S c),   filtered = S^T y.

The 10 on B's diagonal cancels against m. The smoothness term is therefore stored as a graph Laplacian, whose
row i is the sum over neighbours j of n_i n_j (y_i - y_j). If it were computed from m and B in float32, its
rounding error of about lambda would exceed small confidences.

Images of a batch share no cells, so A is block-diagonal, and one solve serves the whole batch.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from datagen.formats.base import StrictModel

warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta", category=UserWarning)

_YUV_FROM_RGB = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
_BLUR_DIAGONAL = 10.0  # two per dimension of the grid


class SolverConfig(StrictModel):
    """Parameters of the bilateral solver."""

    sigma_xy: float = Field(default=8.0, gt=0)
    """Side of a cell in pixels."""
    sigma_luma: float = Field(default=8.0, gt=0)
    """Size of a cell in luma, whose range is 0 to 255."""
    sigma_chroma: float = Field(default=2.0, gt=0)
    """Size of a cell in chroma, whose range is 0 to 255."""
    smoothness: float = Field(default=300.0, gt=0)
    """lambda: weight of the smoothness term."""
    tolerance: float = Field(default=1e-5, ge=0)
    """Conjugate gradients stop once the residual's norm is below this fraction of the right-hand side's."""
    max_iterations: int = Field(default=25, ge=1)
    """Maximum number of conjugate-gradient iterations."""
    num_bistochastize: int = Field(default=10, ge=1)
    """Number of bistochastization iterations, which compute the scale n of the blur."""
    diagonal_floor: float = Field(default=1e-5, gt=0)
    """Minimum of A's diagonal, by which the Jacobi preconditioner divides."""
    confidence_floor: float = Field(default=1e-6, gt=0)
    """Minimum confidence. An isolated region of zero confidence would make A singular; with the minimum, the
    filter returns the region's mean."""


@dataclass(frozen=True)
class BilateralGrid:
    """Occupied grid cells of a batch of guide images, and their neighbours (symbols: see the module).

    ``vertex_of_pixel`` (P,) int64: cell of each pixel; ``splat_matrix`` (V, P) float32, sparse CSR: S;
    ``coupling`` (V, V) float64, sparse CSR: n_i n_j for neighbouring cells i and j; ``coupling_sum`` (V, 1)
    float64: its row sums; ``image_starts``: index of the first cell of each image, followed by V.
    """

    batch: int
    height: int
    width: int
    vertex_of_pixel: Tensor
    splat_matrix: Tensor
    coupling: Tensor
    coupling_sum: Tensor
    image_starts: tuple[int, ...]

    @property
    def num_vertices(self) -> int:
        return int(self.coupling_sum.shape[0])

    def splat(self, pixels: Tensor) -> Tensor:
        """Sum over the pixels of each cell: (P, C) to (V, C)."""
        return self.splat_matrix.to(pixels.dtype) @ pixels

    def slice(self, vertices: Tensor) -> Tensor:
        """Copy each cell's value to its pixels: (V, C) to (P, C)."""
        return vertices.index_select(0, self.vertex_of_pixel)

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """Scalar products (B, C) of the columns of ``a`` and ``b`` (V, C), separately for each image."""
        product = a * b
        starts = self.image_starts
        return torch.stack([product[i:j].sum(dim=0) for i, j in pairwise(starts)])

    def per_vertex(self, per_image: Tensor) -> Tensor:
        """Repeat per-image values (B, C) for each cell of the image: (V, C), or (1, C) for a batch of one."""
        if self.batch == 1:
            return per_image
        counts = torch.tensor(self.image_starts, device=per_image.device).diff()
        return per_image.repeat_interleave(counts, dim=0, output_size=self.num_vertices)


def guide_yuv(guide: Tensor) -> Tensor:
    """Scale linear RGB (B, 3, H, W) to a maximum of 255 per image; return luma and chromas (offset 128)."""
    peak = guide.amax(dim=(1, 2, 3), keepdim=True).clamp_min(1e-6)  # a black guide would divide by 0
    matrix = torch.tensor(_YUV_FROM_RGB, dtype=guide.dtype, device=guide.device)
    yuv = torch.einsum("kc,bchw->bkhw", matrix, guide / peak * 255.0)
    return yuv + torch.tensor([0.0, 128.0, 128.0], dtype=guide.dtype, device=guide.device).reshape(1, 3, 1, 1)


def build_grid(guide: Tensor, config: SolverConfig | None = None) -> BilateralGrid:
    """Build the bilateral grid of guide images (B, 3, H, W) of linear RGB >= 0; no gradient flows to them."""
    config = config or SolverConfig()
    with torch.no_grad():
        keys, strides = _cell_keys(guide.detach(), config)
        vertices, vertex_of_pixel = torch.unique(keys, return_inverse=True)
        splat = _splat_matrix(vertex_of_pixel, len(vertices))
        pairs = _neighbours(vertices, strides)
        starts = torch.arange(guide.shape[0] + 1, device=keys.device) * strides[0]
        image_starts = tuple(torch.searchsorted(vertices, starts).tolist())
        counts = splat.crow_indices().diff().to(torch.float64)
        coupling = _coupling(pairs, torch.ones_like(counts))
        n = torch.ones_like(counts)
        for _ in range(config.num_bistochastize):
            blurred = _BLUR_DIAGONAL * n + (coupling @ n.unsqueeze(1)).squeeze(1)
            n = torch.sqrt(n * counts / blurred)
        coupling = _coupling(pairs, n)
        coupling_sum = coupling @ torch.ones(len(n), 1, dtype=n.dtype, device=n.device)
    batch, _, height, width = guide.shape
    return BilateralGrid(batch, height, width, vertex_of_pixel, splat, coupling, coupling_sum, image_starts)


def _cell_keys(guide: Tensor, config: SolverConfig) -> tuple[Tensor, list[int]]:
    """Return each pixel's cell as an integer key (P,), and the key's strides along image, y, x and colour."""
    batch, _, height, width = guide.shape
    yuv = guide_yuv(guide)
    sigmas = torch.tensor(
        [config.sigma_luma, config.sigma_chroma, config.sigma_chroma], dtype=yuv.dtype, device=yuv.device
    )
    color = torch.floor(yuv / sigmas.reshape(1, 3, 1, 1)).to(torch.int64)
    y = torch.floor(torch.arange(height, device=yuv.device) / config.sigma_xy).to(torch.int64)
    x = torch.floor(torch.arange(width, device=yuv.device) / config.sigma_xy).to(torch.int64)
    coordinates = [y.reshape(1, -1, 1), x.reshape(1, 1, -1), *color.unbind(dim=1)]
    lows = [int(c.min()) - 1 for c in coordinates]  # a margin of one cell: neighbours never wrap
    sizes = [int(c.max()) + 2 - low for c, low in zip(coordinates, lows, strict=True)]
    key = torch.arange(batch, device=yuv.device).reshape(-1, 1, 1).expand(batch, height, width)
    for coordinate, low, size in zip(coordinates, lows, sizes, strict=True):
        key = key * size + (coordinate - low)
    strides = [1]
    for size in reversed(sizes):
        strides.insert(0, strides[0] * size)
    return key.reshape(-1), strides


def _splat_matrix(vertex_of_pixel: Tensor, num_vertices: int) -> Tensor:
    """Sparse CSR matrix S (V, P) in float32 that is 1 at (v, p) if pixel p is in cell v, else 0."""
    order = torch.argsort(vertex_of_pixel, stable=True)
    counts = torch.bincount(vertex_of_pixel, minlength=num_vertices)
    starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    ones = torch.ones(len(order), device=order.device)
    return torch.sparse_csr_tensor(
        starts, order, ones, size=(num_vertices, len(order)), check_invariants=False
    )


def _neighbours(vertices: Tensor, strides: list[int]) -> Tensor:
    """Indices (2, E) of all ordered pairs of adjacent cells, given the sorted keys ``vertices`` (V,)."""
    indices = torch.arange(len(vertices), device=vertices.device)
    pairs = []
    for stride in strides[1:]:
        wanted = vertices + stride
        found = torch.searchsorted(vertices, wanted).clamp_max(len(vertices) - 1)
        hit = vertices[found] == wanted
        low, high = indices[hit], found[hit]
        pairs += [torch.stack([low, high]), torch.stack([high, low])]
    return torch.cat(pairs, dim=1)


def _coupling(pairs: Tensor, n: Tensor) -> Tensor:
    """Sparse CSR matrix (V, V) with n_i n_j at each (i, j) of ``pairs`` (2, E), for the scale ``n`` (V,)."""
    order = torch.argsort(pairs[0] * len(n) + pairs[1])
    rows, columns = pairs[0][order], pairs[1][order]
    starts = torch.searchsorted(rows, torch.arange(len(n) + 1, device=n.device))
    values = n[rows] * n[columns]
    return torch.sparse_csr_tensor(starts, columns, values, size=(len(n), len(n)), check_invariants=False)


def solve(
    grid: BilateralGrid, config: SolverConfig, weights: Tensor, rhs: Tensor, start: Tensor
) -> tuple[Tensor, float]:
    """Solve A y = ``rhs`` (V, C) for y (V, C) by preconditioned conjugate gradients; also return the maximum
    residual relative to ``rhs``. Symbols: see the module.

    ``weights`` (V, C) is S c, the confidence summed by cell; ``start`` (V, C) is the initial y. Every (image,
    channel) is a separate system; converged systems are not updated while others continue.
    """
    dtype = rhs.dtype
    coupling = grid.coupling.to(dtype) * config.smoothness
    diagonal = grid.coupling_sum.to(dtype) * config.smoothness + weights

    def apply(y: Tensor) -> Tensor:
        return diagonal * y - coupling @ y

    inverse = 1.0 / diagonal.clamp_min(config.diagonal_floor)
    y = start
    residual = rhs - apply(y)
    z = inverse * residual
    direction = z
    rz = grid.dot(residual, z)
    scale = grid.dot(rhs, rhs).sqrt().clamp_min(torch.finfo(dtype).tiny)
    iteration, error = 0, grid.dot(residual, residual).sqrt() / scale
    while iteration < config.max_iterations and bool((error > config.tolerance).any()):
        is_active = (error > config.tolerance) & (rz > 0)  # rz is 0 only at the exact solution
        applied = apply(direction)
        curvature = grid.dot(direction, applied)
        step = torch.where(is_active, rz / torch.where(curvature > 0, curvature, torch.ones_like(rz)), 0.0)
        y = y + grid.per_vertex(step) * direction
        residual = residual - grid.per_vertex(step) * applied
        z = inverse * residual
        rz_next = grid.dot(residual, z)
        beta = torch.where(is_active, rz_next / torch.where(rz > 0, rz, torch.ones_like(rz)), 0.0)
        direction = z + grid.per_vertex(beta) * direction
        rz = rz_next
        error = grid.dot(residual, residual).sqrt() / scale
        iteration += 1
    return y, float(error.max()) if error.numel() else 0.0


class _Filter(torch.autograd.Function):
    """The filter x = S^T A^-1 S (c t). For a loss L, with g = dL/dx and z = S^T A^-1 S g, its adjoint is
    dL/dt = c z, dL/dc = z (t - x)."""

    @staticmethod
    def forward(
        ctx: Any, target: Tensor, confidence: Tensor, grid: BilateralGrid, config: SolverConfig
    ) -> Tensor:
        c = confidence.clamp_min(config.confidence_floor)
        weights, rhs = grid.splat(c), grid.splat(c * target)
        y, _ = solve(grid, config, weights, rhs, rhs / weights)
        filtered = grid.slice(y)
        ctx.save_for_backward(target, confidence, filtered, weights)
        ctx.grid, ctx.config = grid, config
        return filtered

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:
        target, confidence, filtered, weights = ctx.saved_tensors
        rhs = ctx.grid.splat(grad)
        z, _ = solve(ctx.grid, ctx.config, weights, rhs, rhs / weights)
        z = ctx.grid.slice(z)
        floor = ctx.config.confidence_floor
        grad_confidence = z * (target - filtered) * (confidence >= floor)
        return confidence.clamp_min(floor) * z, grad_confidence, None, None


def bilateral_solve(
    target: Tensor, confidence: Tensor, grid: BilateralGrid, config: SolverConfig | None = None
) -> Tensor:
    """Smooth ``target`` (B, C, H, W), weighted by ``confidence`` (B, C or 1, H, W) >= 0, within regions of
    the guide images of ``grid``.

    Differentiable in target and confidence. The system is solved in float64, since at small confidence it is
    too ill-conditioned for float32. Raises ``ValueError`` if target and guide differ in size.
    """
    config = config or SolverConfig()
    batch, channels, height, width = target.shape
    if (batch, height, width) != (grid.batch, grid.height, grid.width):
        raise ValueError(
            f"target {tuple(target.shape)} does not fit a guide of {grid.batch} images, "
            f"{grid.height} x {grid.width}"
        )
    pixels = [
        image.to(torch.float64)
        .expand(batch, channels, height, width)
        .permute(0, 2, 3, 1)
        .reshape(-1, channels)
        for image in (target, confidence)
    ]
    filtered = _Filter.apply(*pixels, grid, config)
    return filtered.reshape(batch, height, width, channels).permute(0, 3, 1, 2).to(target.dtype)
