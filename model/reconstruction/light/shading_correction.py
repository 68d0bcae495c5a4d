# SPDX-License-Identifier: MIT
"""Corrects the diffuse shading where the incident light is not photographed.

Missing or wrongly estimated light affects a whole neighbourhood, so the error of shading is smooth over a
surface, regardless of texture. The correction u (N, 3) of ln rho, with the albedo rho = pi radiance /
irradiance, minimises, summed over surfels and over pairs (i, j) of adjacent surfels,

    max(c, e) u^2 + SMOOTHNESS sum w (u_i - u_j)^2
        + (1 - c) (W_p (ln(D_p / rho) - u)^2 + W_r (ln(D_r / rho) - u)^2),

with c the confidence in the light, e the weight of estimated light, w the proximity of the pair, D_p the
network's albedo scaled to that of the confident surfels, and D_r the mean albedo of the confident surfels of
the same smooth region. The weights W_p and W_r decrease with the squared spread of each prior among the
confident surfels; Huber weights make both priors robust. Texture is preserved.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, cg, splu

from datagen.light.cells import cell_keys
from datagen.light.surfels import CellGrid, Surfels, grouped_medians, near_surfels

SMOOTHNESS = 100.0
"""Weight of differences of u between adjacent surfels, where u itself has weight 1 if the light is known."""
ESTIMATE_WEIGHT, ESTIMATE_EVIDENCE = 0.5, (0.1, 0.65)
"""Maximum of the weight e of estimated light, and range of the photographed share of a surfel's hemisphere
over which e increases from 0 to this maximum."""
NETWORK_WEIGHT, REGION_WEIGHT = 0.02, 0.3
"""Weights of the priors at a spread of 1; small, since the errors of neighbouring surfels are correlated."""
MIN_SPREAD_NETWORK, MIN_SPREAD_REGION = 0.25, 0.1
"""Standard deviations of ln D that are added in quadrature to the spreads."""
SCALE_SUPPORT = 0.05
"""Mean confidence in the light at which the network's albedo is multiplied by only the square root of the
factor found at confident surfels (:func:`network_scale`)."""
MIN_SUPPORT = 10.0
"""Number of confident surfels below which a region's prior has no weight; full weight requires ten times as
many."""
_NEIGHBOURS = 9
_BLOCK = 5  # in cells
_ROUNDS = 3  # iterations of reweighting
_HUBER_NETWORK, _HUBER_REGION = 0.5, 2.0  # Huber thresholds in ln D, and in spreads
_TOLERANCE, _MAX_ITERATIONS = 1e-3, 1000  # of the conjugate gradients
_MIN_ALBEDO, _MAX_ALBEDO = 0.005, 0.95


def shading_correction(
    surfels: Surfels,
    region: NDArray,
    albedo: NDArray,
    predicted: NDArray,
    confidence: NDArray,
    photographed: NDArray,
    is_diffuse: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Compute u (N, 3); exp(u) multiplies ``albedo`` (N, 3) and divides the diffuse shading.

    ``region`` (N,): index of each surfel's smooth region; ``predicted`` (N, 3): the network's albedo;
    ``confidence`` (N,): confidence in the light, in [0, 1]; ``photographed`` (N,): photographed share of each
    hemisphere times the trust in its light; ``is_diffuse`` (N,): mask of lit surfels that are not metal.
    Raises ArithmeticError if the solver does not converge.
    """
    log_albedo, log_network = _log(albedo), _log(predicted)
    confident = confidence * is_diffuse
    offset, spread = _network_offset(log_albedo - log_network, confident)
    log_network += offset
    network_weight = NETWORK_WEIGHT / (spread**2 + MIN_SPREAD_NETWORK**2)
    of_region, region_spread, support = _grouped_spread(log_albedo, confident, region)
    region_spread = np.hypot(region_spread, MIN_SPREAD_REGION)
    region_weight = REGION_WEIGHT / region_spread**2 * np.clip(support / (10 * MIN_SUPPORT), 0, 1)
    region_weight[support < MIN_SUPPORT] = 0
    unknown = (1 - confidence) * is_diffuse
    estimated = np.interp(photographed, ESTIMATE_EVIDENCE, (0, ESTIMATE_WEIGHT))
    known = np.maximum(confidence, estimated) * is_diffuse
    laplacian, blocks = _laplacian(surfels), _blocks(surfels)
    found = np.zeros_like(log_albedo)
    huber_network, huber_region = np.ones(len(found)), np.ones(len(found))
    for _ in range(_ROUNDS):
        toward_network = unknown * network_weight * huber_network
        toward_region = unknown * region_weight * huber_region
        diagonal = known + toward_network + toward_region + 1e-6
        matrix = (SMOOTHNESS * laplacian + sparse.diags(diagonal)).tocsr()
        right = toward_network[:, None] * (log_network - log_albedo)
        right += toward_region[:, None] * (of_region - log_albedo)
        found = _minimised(matrix, right, blocks, found)
        corrected = log_albedo + found
        huber_network = 1 / np.maximum(1, np.abs(corrected - log_network).mean(axis=1) / _HUBER_NETWORK)
        away = np.abs(corrected - of_region).mean(axis=1) / region_spread
        huber_region = 1 / np.maximum(1, away / _HUBER_REGION)
    return found.astype(np.float32)


def network_scale(albedo: NDArray, predicted: NDArray, confident: NDArray) -> NDArray[np.float32]:
    """Compute the RGB factor (3,) that scales the network's albedo ``predicted`` to ``albedo``, (N, 3) each.

    ``confident`` (N,) is the confidence in the surfels' light, 0 for metals. The factor tends to 1 if little
    light is known (:data:`SCALE_SUPPORT`).
    """
    support = float(confident.mean())
    offset, _ = _network_offset(_log(albedo) - _log(predicted), confident)
    return np.exp(offset * support / (support + SCALE_SUPPORT)).astype(np.float32)


def _network_offset(difference: NDArray, confident: NDArray) -> tuple[NDArray[np.float64], float]:
    """Compute the robust weighted mean (3,) and standard deviation of ``difference`` (N, 3)."""
    offset, spread, _ = _grouped_spread(difference, confident, np.zeros(len(confident), np.int64))
    return offset[0], float(spread[0])


def _log(albedo: NDArray) -> NDArray[np.float64]:
    return np.log(np.clip(albedo.astype(np.float64), _MIN_ALBEDO, _MAX_ALBEDO))


def _minimised(
    matrix: sparse.csr_matrix, right: NDArray, blocks: sparse.csr_matrix, start: NDArray
) -> NDArray:
    """Solve ``matrix`` (N, N) x = ``right`` (N, 3) by conjugate gradients from ``start`` (N, 3).

    The preconditioner, Jacobi plus a coarse solve with one unknown per block (``blocks`` (N, K), see
    :func:`_blocks`), speeds up smooth long-range corrections. Raises ArithmeticError without convergence.
    """
    coarse = splu((blocks.T @ matrix @ blocks).tocsc())
    diagonal = matrix.diagonal()

    def precondition(rest: NDArray) -> NDArray:
        return rest / diagonal + blocks @ coarse.solve(blocks.T @ rest)

    preconditioner = LinearOperator(matrix.shape, precondition, dtype=np.float64)
    found = np.empty_like(start)
    for c in range(3):
        found[:, c], failed = cg(
            matrix, right[:, c], x0=start[:, c], M=preconditioner, rtol=_TOLERANCE, maxiter=_MAX_ITERATIONS
        )
        if failed:
            raise ArithmeticError(f"shading correction: no solution after {_MAX_ITERATIONS} iterations")
    return found


def _blocks(surfels: Surfels) -> sparse.csr_matrix:
    """Compute the membership (N, K), 0 or 1, of surfels in blocks of :data:`_BLOCK`^3 cells, by cell side."""
    grid = surfels.grid
    shape = -(-grid.shape // _BLOCK)
    coarse = CellGrid(grid.low, _BLOCK * grid.cell_m, shape, grid.surfel)
    block = np.unique(cell_keys(coarse, surfels.position_m, surfels.normal), return_inverse=True)[1]
    num = len(block)
    return sparse.csr_matrix((np.ones(num), (np.arange(num), block)), (num, int(block.max()) + 1))


def _grouped_spread(
    values: NDArray, weight: NDArray, group: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Compute the robust mean (N, 3), standard deviation (N,) and total weight (N,) of the group of each row
    of ``values`` (N, 3).

    The deviation follows from absolute deviations from the median, clipped at 1. The mean is that of values
    clipped at twice the deviation, since the median of a checkerboard would be one of its two colours.
    """
    keys, index = np.unique(group, return_inverse=True)
    total = np.bincount(index, weight, len(keys)).astype(np.float64)
    medians = grouped_medians(values, np.maximum(weight, 1e-9), index, len(keys)) * (total > 0)[:, None]
    away = np.minimum(np.abs(values - medians[index]).mean(axis=1), 1) * weight
    spread = 1.2533 * np.bincount(index, away, len(keys)) / np.maximum(total, 1e-12)
    reach = 2 * spread[index][:, None]
    near = np.clip(values - medians[index], -reach, reach) * weight[:, None]
    means = np.stack([np.bincount(index, column, len(keys)) for column in near.T], axis=1)
    centre = medians + means / np.maximum(total, 1e-12)[:, None]
    return centre[index].astype(np.float64), spread[index].astype(np.float64), total[index]


def _laplacian(surfels: Surfels) -> sparse.csr_matrix:
    """Compute the Laplacian (N, N) of the graph that joins adjacent surfels with similar normals."""
    num = len(surfels)
    distance, index = near_surfels(surfels, _NEIGHBOURS)
    weight = np.exp(-0.5 * (distance / 2) ** 2)
    weight[index == np.arange(num)[:, None]] = 0
    rows = np.repeat(np.arange(num), index.shape[1])
    graph = sparse.csr_matrix((weight.ravel(), (rows, index.ravel())), (num, num))
    graph = 0.5 * (graph + graph.T)
    return sparse.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph
