# SPDX-License-Identifier: MIT
"""Makes UVs for an atlas: those of the mesh if they are a valid unwrap, else new ones by xatlas.

UVs are valid if all are inside the unit square, none is missing and no two triangles overlap. xatlas runs in
separate processes on pieces of the mesh. A piece on which it crashes or takes too long is unwrapped by
Blender's Smart UV Project, if bpy is installed; if that fails too, its triangles are placed individually.
Pieces are packed at the same scale.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh, compacted, welded
from datagen.foundation.progress import Advance, no_advance
from datagen.geometry.traced import face_normals, smooth_regions
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.unwrap.charts import chart_of_faces
from model.reconstruction.unwrap.xatlas_process import PACK_RESOLUTION, PADDING

PIECE_FACES = 40_000
PIECE_TIMEOUT_S = 900.0
XATLAS_PROCESS = "model.reconstruction.unwrap.xatlas_process"
BLENDER_PROCESS = "model.reconstruction.unwrap.blender_process"
MIN_PADDING_TEXELS = 1
_MAX_PADDING, _MAX_CHART_FACES = 8, 1_000_000
_CHECK_SIZE = 1024
_CHECK_OFFSET = (0.5123, 0.4871)  # avoids samples on edges, where two triangles meet
_MAX_OVERLAP = 0.002  # share of the covered area; tolerates a few texels along touching charts
_MAX_UNMAPPED = 0.001  # share of the surface with degenerate UVs
_RANGE_SLACK = 1e-5


@dataclass(frozen=True)
class UvReport:
    """Quality of an unwrap.

    ``source``: origin of the UVs; ``rejected``: fault of the mesh's UVs, or ''; ``coverage``: share of the
    atlas with a surface; ``metres_per_side``: median length on the surface that corresponds to the atlas
    side, on the finest charts if ``is_repacked``, i.e. their scales were changed; ``stretch``: ratio of the
    95th to the 5th percentile of texel density by area before, ideally 1;
    ``padding_texels``: see :func:`padding_texels`; ``num_blender_faces``: triangles unwrapped by Blender
    after xatlas failed; ``num_fallback_faces``: triangles placed individually.
    """

    source: Literal["mesh", "xatlas"]
    rejected: str
    coverage: float
    metres_per_side: float
    stretch: float
    num_fallback_faces: int = 0
    num_blender_faces: int = 0
    padding_texels: int | None = None
    is_repacked: bool = False

    @property
    def notes(self) -> list[str]:
        """Messages for the user about faults of the unwrap."""
        notes = [f"the mesh's own UVs are not used: {self.rejected}"] if self.rejected else []
        if self.num_blender_faces:
            notes.append(f"xatlas failed on {self.num_blender_faces} triangles; Blender unwrapped them")
        if self.num_fallback_faces:
            has_bpy = find_spec("bpy") is not None
            notes.append(
                f"{self.num_fallback_faces} triangles are placed individually, which wastes texels at their "
                "seams; unwrap the mesh by hand" + ("" if has_bpy else " or install bpy for Blender's unwrap")
            )
        if self.padding_texels is not None and self.padding_texels < MIN_PADDING_TEXELS:
            notes.append("charts touch each other: colours may bleed over seams in coarse mip levels")
        return notes


def unwrapped(mesh: Mesh, jobs: int = 2, progress: Advance = no_advance) -> tuple[Mesh, UvReport]:
    """Return the mesh with UVs for an atlas; triangles keep their order, but vertices may be split."""
    fault = "" if mesh.uv is None else own_uv_fault(mesh)
    if mesh.uv is not None and not fault:
        return mesh, _report(mesh, "mesh", "")
    made, num_blender, num_fallback = _unwrap(mesh, jobs, progress)
    return made, _report(made, "xatlas", fault, num_fallback, num_blender)


def own_uv_fault(mesh: Mesh) -> str:
    """Return the reason why the mesh's UVs are not a valid unwrap, or '' if they are."""
    assert mesh.uv is not None
    used = mesh.uv[np.unique(mesh.faces)]
    low, high = float(used.min()), float(used.max())
    if low < -_RANGE_SLACK or high > 1 + _RANGE_SLACK:
        return f"UVs run from {low:.3g} to {high:.3g}, outside [0, 1]"
    areas = mesh.areas()
    unmapped = float(areas[uv_areas(mesh) <= 1e-12].sum() / max(areas.sum(), 1e-30))
    if unmapped > _MAX_UNMAPPED:
        return f"{unmapped:.1%} of the surface has UVs without area"
    surface = TexelSurface(mesh, face_normals(mesh), _CHECK_SIZE)
    covered, several = surface.overlap_mask(_CHECK_OFFSET)
    share = float(several.sum() / max(int(covered.sum()), 1))
    return f"{share:.1%} of the layout overlaps itself" if share > _MAX_OVERLAP else ""


def uv_areas(mesh: Mesh) -> NDArray[np.float64]:
    """Compute the areas (M,) of the triangles' UVs."""
    assert mesh.uv is not None
    corners = mesh.uv.astype(np.float64)[mesh.faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])


def padding_texels(mesh: Mesh) -> int | None:
    """Compute the texels between the two nearest charts on an atlas of 1024 texels a side, at most 8; None
    for meshes of over a million triangles.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    if len(mesh.faces) > _MAX_CHART_FACES:
        return None
    bare = compacted(Mesh(mesh.positions, mesh.faces, None, mesh.uv))
    face = TexelSurface(bare, face_normals(bare), _CHECK_SIZE).faces(0, 0, _CHECK_SIZE, _CHECK_SIZE)
    chart = np.where(face >= 0, chart_of_faces(bare)[np.maximum(face, 0)], -1)
    highest, lowest = chart, np.where(chart >= 0, chart, np.iinfo(np.int32).max)
    for distance in range(1, _MAX_PADDING + 1):
        highest, lowest = maximum_filter(highest, 3), minimum_filter(lowest, 3)
        if ((chart >= 0) & (highest != lowest)).any():
            return distance - 1
    return _MAX_PADDING


def _report(
    mesh: Mesh, source: Literal["mesh", "xatlas"], rejected: str, num_fallback: int = 0, num_blender: int = 0
) -> UvReport:
    areas, of_uv = mesh.areas(), uv_areas(mesh)
    usable = (areas > 0) & (of_uv > 0)
    density = np.sqrt(of_uv[usable] / areas[usable])
    order = np.argsort(density)
    share = np.cumsum(areas[usable][order]) / areas[usable].sum()
    low, middle, high = (density[order][np.searchsorted(share, q)] for q in (0.05, 0.5, 0.95))
    coverage = float(min(of_uv.sum(), 1.0))
    return UvReport(
        source,
        rejected,
        coverage,
        float(1 / middle),
        float(high / low),
        num_fallback,
        num_blender,
        padding_texels(mesh),
    )


def _unwrap(mesh: Mesh, jobs: int, progress: Advance) -> tuple[Mesh, int, int]:
    positions, vertex = welded(mesh)
    faces = vertex[mesh.faces]
    pieces = _pieces(mesh)
    with tempfile.TemporaryDirectory(prefix="unwrap-") as folder, ThreadPoolExecutor(max(1, jobs)) as pool:

        def unwrap(number: int) -> _Sheet:
            return _unwrap_piece(positions, faces[pieces[number]], Path(folder) / f"{number}")

        sheets = []
        for sheet in pool.map(unwrap, range(len(pieces))):
            sheets.append(sheet)
            progress(len(sheets), len(pieces))
    places, side = shelf_packed(np.array([sheet.size_m for sheet in sheets]))
    corners = np.empty((len(faces), 3, 2))
    for sheet, piece, place in zip(sheets, pieces, places, strict=True):
        corners[piece] = (sheet.corners + place) / side
    index = mesh.faces.ravel()
    split = Mesh(
        mesh.positions[index],
        np.arange(len(index), dtype=np.int32).reshape(-1, 3),
        None if mesh.normals is None else mesh.normals[index],
        corners.reshape(-1, 2).astype(np.float32),
    )
    num_blender = sum(sheet.num_blender for sheet in sheets)
    return compacted(split), num_blender, sum(sheet.num_single for sheet in sheets)


def _pieces(mesh: Mesh) -> list[NDArray[np.int64]]:
    """Group triangle indices into pieces of at most ``PIECE_FACES``, in the order of smooth regions."""
    order = np.argsort(smooth_regions(mesh), kind="stable")
    return [order[first : first + PIECE_FACES] for first in range(0, len(order), PIECE_FACES)]


@dataclass(frozen=True)
class _Sheet:
    """Layout of a piece: triangle corners (M, 3, 2) and size (2,) in metres, and the numbers of triangles
    placed by Blender and individually.
    """

    corners: NDArray[np.float64]
    size_m: NDArray[np.float64]
    num_blender: int
    num_single: int


def _unwrap_piece(positions: NDArray[np.float32], faces: NDArray[np.int64], stem: Path) -> _Sheet:
    used, compact = np.unique(faces, return_inverse=True)
    compact = compact.reshape(-1, 3)
    source = stem.with_suffix(".in.npz")
    np.savez(source, positions=positions[used], faces=compact)
    num_blender = 0
    made = _run(XATLAS_PROCESS, source, stem.with_suffix(".xatlas.npz"))
    if made is None and find_spec("bpy") is not None:
        made = _run(BLENDER_PROCESS, source, stem.with_suffix(".blender.npz"))
        num_blender = 0 if made is None else int(made[2].sum())
    if made is None:
        corners, size = triangle_sheet(positions[used], compact)
        return _Sheet(corners, size, 0, len(faces))
    corners, size, is_placed = made
    if not is_placed.all():
        rest, rest_size = triangle_sheet(positions[used], compact[~is_placed])
        corners[~is_placed] = rest + np.array([0.0, size[1]])
        size = np.array([max(size[0], rest_size[0]), size[1] + rest_size[1]])
    return _Sheet(corners, size, num_blender, int((~is_placed).sum()))


def _run(
    module: str, source: Path, target: Path
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]] | None:
    """Unwrap the file ``source`` in a process; return corners, size and mask of placed triangles, as
    described in ``xatlas_process``, or None if it failed or placed none.
    """
    command = [sys.executable, "-m", module, str(source), str(target)]
    root = Path(__file__).resolve().parents[3]
    try:
        done = subprocess.run(command, timeout=PIECE_TIMEOUT_S, capture_output=True, cwd=root).returncode == 0
    except subprocess.TimeoutExpired:
        done = False
    if not done or not target.is_file():
        return None
    with np.load(target) as data:
        corners, size, is_placed = data["corners"], data["size_m"], data["is_placed"]
    is_placed = is_placed & np.isfinite(corners).all(axis=(1, 2))
    return (corners, size, is_placed) if is_placed.any() and np.isfinite(size).all() else None


def triangle_sheet(positions: NDArray, faces: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lay out separate, undistorted triangles in rows along their longest edges.

    Returns the corners (M, 3, 2) and size (2,) of the layout in metres.
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
    """Pack boxes of sizes (N, 2) in rows by decreasing height; return their lower left corners (N, 2) and the
    side of the square around them.
    """
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
