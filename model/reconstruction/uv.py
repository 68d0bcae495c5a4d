# SPDX-License-Identifier: MIT
"""UVs for an atlas: the mesh's own where they are a valid unwrap, else new ones by xatlas.

Valid: all inside the unit square, none missing, no two triangles over the same texel. xatlas runs in
processes of their own on pieces of the mesh; a piece on which it crashes or takes too long is laid out
triangle by triangle, which always works. Pieces are packed so that a metre is the same length everywhere on
the atlas.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.meshes import Mesh, compacted, welded
from model.reconstruction.geometry import face_normals, smooth_regions
from model.reconstruction.texels import TexelSurface
from model.reconstruction.unwrap_process import PACK_RESOLUTION, PADDING

PIECE_FACES = 40_000
PIECE_TIMEOUT_S = 900.0
_CHECK_SIZE = 1024
_CHECK_OFFSET = (
    0.5123,
    0.4871,
)  # away from where people put vertices: rays on edges would meet two triangles
_MAX_OVERLAP = 0.002  # share of the covered area: a few texels along touching charts
_MAX_UNMAPPED = 0.001  # share of the surface whose UVs have no area
_RANGE_SLACK = 1e-5


@dataclass(frozen=True)
class UvReport:
    """What an unwrap is like. ``source``: whose it is; ``rejected``: why the mesh's own did not serve, '' if
    it did or there was none; ``coverage``: share of the atlas with surface; ``metres_per_side``: length that
    the atlas's side has on the surface (median); ``stretch``: 95th over 5th percentile of the density, 1 at
    best, by area; ``num_fallback_faces``: triangles that xatlas could not take."""

    source: Literal["mesh", "xatlas"]
    rejected: str
    coverage: float
    metres_per_side: float
    stretch: float
    num_fallback_faces: int = 0


def unwrapped(mesh: Mesh, jobs: int = 2) -> tuple[Mesh, UvReport]:
    """The mesh with UVs fit for an atlas; triangles keep their order and corners, vertices may be split."""
    fault = "" if mesh.uv is None else own_uv_fault(mesh)
    if mesh.uv is not None and not fault:
        return mesh, _report(mesh, "mesh", "", 0)
    made, num_fallback = _unwrap(mesh, jobs)
    return made, _report(made, "xatlas", fault, num_fallback)


def own_uv_fault(mesh: Mesh) -> str:
    """Why the mesh's UVs are not a valid unwrap; '' if they are. The Mitsuba variant must have been
    selected."""
    assert mesh.uv is not None
    used = mesh.uv[np.unique(mesh.faces)]
    low, high = float(used.min()), float(used.max())
    if low < -_RANGE_SLACK or high > 1 + _RANGE_SLACK:
        return f"UVs run from {low:.3g} to {high:.3g}, outside [0, 1]"
    areas = mesh.areas()
    unmapped = float(areas[_uv_areas(mesh) <= 1e-12].sum() / max(areas.sum(), 1e-30))
    if unmapped > _MAX_UNMAPPED:
        return f"{unmapped:.1%} of the surface has UVs without area"
    surface = TexelSurface(mesh, face_normals(mesh), _CHECK_SIZE)
    covered, several = surface.overlap_mask(_CHECK_OFFSET)
    share = float(several.sum() / max(int(covered.sum()), 1))
    return f"{share:.1%} of the layout overlaps itself" if share > _MAX_OVERLAP else ""


def _uv_areas(mesh: Mesh) -> NDArray[np.float64]:
    assert mesh.uv is not None
    corners = mesh.uv.astype(np.float64)[mesh.faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])


def _report(mesh: Mesh, source: Literal["mesh", "xatlas"], rejected: str, num_fallback: int) -> UvReport:
    areas, uv_areas = mesh.areas(), _uv_areas(mesh)
    usable = (areas > 0) & (uv_areas > 0)
    density = np.sqrt(uv_areas[usable] / areas[usable])
    order = np.argsort(density)
    share = np.cumsum(areas[usable][order]) / areas[usable].sum()
    low, middle, high = (density[order][np.searchsorted(share, q)] for q in (0.05, 0.5, 0.95))
    coverage = float(min(uv_areas.sum(), 1.0))
    return UvReport(source, rejected, coverage, float(1 / middle), float(high / low), num_fallback)


def _unwrap(mesh: Mesh, jobs: int) -> tuple[Mesh, int]:
    positions, vertex = welded(mesh)
    faces = vertex[mesh.faces]
    pieces = _pieces(mesh)
    with tempfile.TemporaryDirectory(prefix="unwrap-") as folder, ThreadPoolExecutor(max(1, jobs)) as pool:
        sheets = list(
            pool.map(
                lambda item: _unwrap_piece(positions, faces[item[1]], Path(folder) / f"{item[0]}"),
                enumerate(pieces),
            )
        )
    places, side = shelf_packed(np.array([size for _, size, _ in sheets]))
    corners = np.empty((len(faces), 3, 2))
    for (sheet, _, _), piece, place in zip(sheets, pieces, places, strict=True):
        corners[piece] = (sheet + place) / side
    index = mesh.faces.ravel()
    split = Mesh(
        mesh.positions[index],
        np.arange(len(index), dtype=np.int32).reshape(-1, 3),
        None if mesh.normals is None else mesh.normals[index],
        corners.reshape(-1, 2).astype(np.float32),
    )
    return compacted(split), sum(count for _, _, count in sheets)


def _pieces(mesh: Mesh) -> list[NDArray[np.int64]]:
    """Triangles in groups of at most ``PIECE_FACES``, whole smooth regions as far as they fit."""
    order = np.argsort(smooth_regions(mesh), kind="stable")
    return [order[first : first + PIECE_FACES] for first in range(0, len(order), PIECE_FACES)]


def _unwrap_piece(
    positions: NDArray[np.float32], faces: NDArray[np.int64], stem: Path
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Corners (M, 3, 2) on a sheet in metres, its size (2,), and how many triangles xatlas did not place."""
    used, compact = np.unique(faces, return_inverse=True)
    compact = compact.reshape(-1, 3)
    source, target = stem.with_suffix(".in.npz"), stem.with_suffix(".out.npz")
    np.savez(source, positions=positions[used], faces=compact)
    command = [sys.executable, "-m", "model.reconstruction.unwrap_process", str(source), str(target)]
    root = Path(__file__).resolve().parents[2]
    try:
        done = subprocess.run(command, timeout=PIECE_TIMEOUT_S, capture_output=True, cwd=root).returncode == 0
    except subprocess.TimeoutExpired:
        done = False
    if not done or not target.is_file():
        corners, size = triangle_sheet(positions[used], compact)
        return corners, size, len(faces)
    with np.load(target) as data:
        corners, size, is_placed = data["corners"], data["size_m"], data["is_placed"]
    is_placed &= np.isfinite(corners).all(axis=(1, 2))
    if not is_placed.all():
        rest, rest_size = triangle_sheet(positions[used], compact[~is_placed])
        corners[~is_placed] = rest + np.array([0.0, size[1]])
        size = np.array([max(size[0], rest_size[0]), size[1] + rest_size[1]])
    return corners, size, int((~is_placed).sum())


def triangle_sheet(positions: NDArray, faces: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Every triangle by itself, undistorted, its longest edge along a shelf; shelves by falling height.

    Corners (M, 3, 2) in metres and the sheet's size (2,).
    """
    p = positions.astype(np.float64)[faces]
    lengths = np.stack([np.linalg.norm(p[:, (k + 1) % 3] - p[:, k], axis=1) for k in range(3)], axis=1)
    first = lengths.argmax(axis=1)
    turn = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(p, turn[..., None], axis=1), 1, 0)
    base = lengths.max(axis=1)
    along = (b - a) / np.maximum(base, 1e-30)[:, None]
    x = ((c - a) * along).sum(axis=1)
    height = np.linalg.norm((c - a) - x[:, None] * along, axis=1)
    area = float((base * height).sum())
    gap = np.sqrt(max(area, 1e-20)) * PADDING / PACK_RESOLUTION
    boxes = np.stack([base + gap, height + gap], axis=1)
    places, side = shelf_packed(boxes)
    local = np.zeros((len(faces), 3, 2))
    local[:, 1, 0], local[:, 2, 0], local[:, 2, 1] = base, x, height
    placed = local + (places + 0.5 * gap)[:, None]
    corners = np.empty_like(placed)
    np.put_along_axis(corners, turn[..., None], placed, axis=1)
    return corners, np.array([side, side])


def shelf_packed(boxes: NDArray) -> tuple[NDArray[np.float64], float]:
    """Lower left corners (N, 2) of boxes (N, 2) in rows by falling height, and the side of the square they
    need."""
    order = np.argsort(-boxes[:, 1], kind="stable")
    best: tuple[NDArray[np.float64], float] | None = None
    widest = float(boxes[:, 0].max())
    for factor in (1.0, 1.1, 1.25, 1.5, 2.0):
        width = max(widest, factor * float(np.sqrt(boxes.prod(axis=1).sum())))
        places, height = _shelves(boxes, order, width * (1 + 1e-9))
        side = max(float((places + boxes)[:, 0].max()), height)
        if best is None or side < best[1]:
            best = places, side
    assert best is not None
    return best


def _shelves(boxes: NDArray, order: NDArray, width: float) -> tuple[NDArray[np.float64], float]:
    places = np.empty((len(boxes), 2))
    ends = np.cumsum(boxes[order, 0])
    first, used, bottom = 0, 0.0, 0.0
    while first < len(order):
        last = max(int(np.searchsorted(ends, used + width, side="right")), first + 1)
        row = order[first:last]
        places[row, 0] = ends[first:last] - boxes[row, 0] - used
        places[row, 1] = bottom
        bottom += float(boxes[row, 1].max())
        first, used = last, float(ends[last - 1])
    return places, bottom
