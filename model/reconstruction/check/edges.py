# SPDX-License-Identifier: MIT
"""Compares the edges of a mesh and a photograph by a score for every shift between them.

Edges are fields of double angles (H, W, 2): a vector's length is the strength of the edge, and its angle is
twice the angle of the edge's normal, so parallel edges agree (+1), perpendicular edges disagree (-1) and
textures without direction cancel. The score of a shift is the mean agreement over the mesh's edges. A small
rotation of the camera shifts the image by focal length x angle, so the position of the peak score gives the
camera's error, and its height above other scores gives the certainty. If the camera is rolled or too far
forward, the peak is higher for a mesh image that is rotated or magnified accordingly.

R is the largest shift in pixels. Image axes are x right and y down; a shift (dx, dy) moves the mesh's edges
onto the photograph's.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from datagen.foundation.cameras import Camera
from datagen.foundation.color import luminance, srgb_from_linear
from datagen.geometry.traced import ViewGeometry

CREASE_RAD = np.radians(25.0)
_JUMP = 0.03  # minimum distance from the neighbour's tangent plane at a discontinuity, relative to depth
_BORDER_PX = 3
_FLAT_LEVEL = 0.01  # gradients below this are noise of 8-bit images
MIN_EDGE_PX = 60  # minimum number of edge pixels for a score
_PEAK_RADIUS_PX = 4
_NEARLY = 0.15  # scores below the peak by less than this share of its height count as equal
_WARP_WIDTH_PX = 320  # approximate width at which rotated and magnified fields are compared
_ROLLS_RAD = tuple(np.radians(k).item() for k in (-3.0, -2.0, -1.0, 1.0, 2.0, 3.0))
_ZOOMS = (0.92, 0.95, 0.975, 1.025, 1.05, 1.08)


@dataclass(frozen=True)
class EdgeMatch:
    """Best shift of a mesh's edges.

    ``peak_px`` (dx, dy): the best shift; ``blur_px2``: covariance (dx^2, dx dy, dy^2) of shifts with similar
    scores, elongated if edges are mostly parallel; ``at_zero`` and ``at_peak``: scores without a shift and at
    the best one, in standard deviations above the scores of other shifts; ``num_edge_px``: number of pixels
    on mesh edges.
    """

    peak_px: tuple[float, float]
    blur_px2: tuple[float, float, float]
    at_zero: float
    at_peak: float
    num_edge_px: int

    def surely_px(self, shift: tuple[float, float]) -> float:
        """Compute the length of ``shift`` less the standard deviation along it (``blur_px2``), at least 0."""
        length = float(np.hypot(*shift))
        x, y = np.array(shift) / max(length, 1e-9)
        xx, xy, yy = self.blur_px2
        return max(0.0, length - float(np.sqrt(max(xx * x * x + 2 * xy * x * y + yy * y * y, 0.0))))


@dataclass(frozen=True)
class WarpMatch:
    """Rotation (clockwise) and magnification about the optical axis that align the mesh with the photograph.

    Gains are increases of the peak score, in standard deviations; ``at_peak`` is the highest score.
    """

    roll_rad: float
    roll_gain: float
    zoom: float
    zoom_gain: float
    at_peak: float


def mesh_edges(geometry: ViewGeometry, camera: Camera) -> NDArray[np.bool_]:
    """Compute the mask (H, W) of visible creases and depth discontinuities, as lines two pixels wide."""
    z = geometry.depth_z_m[..., 0].astype(np.float64)
    hit = geometry.face >= 0
    normal = geometry.normal_world.astype(np.float64) @ camera.world_from_camera[:3, :3]
    centers = camera.pixel_centers()
    x, y = (centers[..., 0] - camera.cx_px) / camera.fx_px, (centers[..., 1] - camera.cy_px) / camera.fy_px
    rays = np.stack([x, y, np.ones(z.shape)], axis=-1)
    edges = np.zeros(z.shape, dtype=bool)
    for axis in (0, 1):
        a = tuple(slice(None, -1) if k == axis else slice(None) for k in (0, 1))
        b = tuple(slice(1, None) if k == axis else slice(None) for k in (0, 1))
        is_bent = (normal[a] * normal[b]).sum(axis=-1) < np.cos(CREASE_RAD)
        gap = np.minimum(
            _plane_gap(z[a], z[b], normal[a], rays[a], rays[b]),
            _plane_gap(z[b], z[a], normal[b], rays[b], rays[a]),
        )
        found = hit[a] & hit[b] & (is_bent | (gap > _JUMP))
        found |= hit[a] != hit[b]  # the silhouette of the mesh
        edges[a] |= found
        edges[b] |= found
    edges[:_BORDER_PX] = edges[-_BORDER_PX:] = False
    edges[:, :_BORDER_PX] = edges[:, -_BORDER_PX:] = False
    return edges


def _plane_gap(z: NDArray, other: NDArray, normal: NDArray, ray: NDArray, other_ray: NDArray) -> NDArray:
    """Compute a neighbour's distance from a pixel's tangent plane along its ray, relative to its depth."""
    across = (normal * other_ray).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = z * (normal * ray).sum(axis=-1) / across
        gap = np.abs(other - expected) / np.maximum(other, 1e-9)
    return np.where(np.isfinite(gap) & (expected > 0), gap, np.inf)


def edge_field(edges: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Compute double angles (H, W, 2) of the lines in a mask ``edges`` (H, W), whose normals are the
    directions of greatest curvature of the blurred mask.
    """
    soft = cv2.GaussianBlur(edges.astype(np.float32), (0, 0), 1.5)
    xx, yy = cv2.Sobel(soft, cv2.CV_32F, 2, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 2)
    xy = cv2.Sobel(soft, cv2.CV_32F, 1, 1)
    field = -np.stack([xx - yy, 2 * xy], axis=-1)
    length = np.linalg.norm(field, axis=-1)
    typical = float(np.quantile(length[edges], 0.75)) if edges.any() else 1.0
    field /= np.maximum(length, max(typical, 1e-6))[..., None]  # corners have no direction and stay short
    return np.where(edges[..., None], field, 0).astype(np.float32)


def photograph_field(color: NDArray[np.float32], valid_mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Compute double angles (H, W, 2) of a linear photograph's gradients, with lengths of at most 1."""
    grey = luminance(np.maximum(color, 0))
    level = float(np.quantile(grey[valid_mask], 0.9)) if valid_mask.any() else 0.0
    shown = srgb_from_linear(np.clip(grey * (0.7 / max(level, 1e-6)), 0, 1))
    shown = cv2.GaussianBlur(shown.astype(np.float32), (0, 0), 1.0)
    gx, gy = cv2.Scharr(shown, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(shown, cv2.CV_32F, 0, 1) / 32
    squared = gx * gx + gy * gy
    length = np.sqrt(squared)
    inside = np.asarray(cv2.erode(valid_mask.astype(np.float32), np.ones((5, 5)))) > 0
    typical = max(float(np.quantile(length[inside], 0.85)) if inside.any() else 1.0, _FLAT_LEVEL)
    weight = np.where(inside, length / (length + typical) / np.maximum(squared, 1e-12), 0)
    return np.stack([(gx * gx - gy * gy) * weight, 2 * gx * gy * weight], axis=-1).astype(np.float32)


def match_edges(
    edges: NDArray[np.bool_], photograph: NDArray[np.float32], radius_px: int
) -> EdgeMatch | None:
    """Find the best shift of ``edges`` (H, W), of at most ``radius_px`` along each axis, onto the field
    ``photograph`` (H, W, 2); None for fewer than ``MIN_EDGE_PX`` edge pixels.
    """
    num = int(edges.sum())
    if num < MIN_EDGE_PX:
        return None
    scores = shift_scores(edge_field(edges), photograph, radius_px)
    peak = np.array(np.unravel_index(int(scores.argmax()), scores.shape))
    middle, spread = _scores_off_peak(scores)
    best = float(scores[tuple(peak)])
    near = np.argwhere(scores >= best - _NEARLY * (best - middle)) - radius_px
    sub = peak - radius_px + _vertex(scores, peak)
    away = near - sub
    xx, xy, yy = (float((away[:, a] * away[:, b]).mean()) for a, b in ((1, 1), (0, 1), (0, 0)))
    at_zero = (float(scores[radius_px, radius_px]) - middle) / spread
    peak_px = (float(sub[1]), float(sub[0]))
    return EdgeMatch(peak_px, (xx, xy, yy), at_zero, (best - middle) / spread, num)


def _scores_off_peak(scores: NDArray[np.float64]) -> tuple[float, float]:
    """Compute the median and a robust standard deviation of the scores of shifts far from the best one."""
    peak = np.array(np.unravel_index(int(scores.argmax()), scores.shape))
    rows, columns = np.indices(scores.shape)
    others = scores[np.hypot(rows - peak[0], columns - peak[1]) > _PEAK_RADIUS_PX]
    middle = float(np.median(others))
    spread = max(1.4826 * float(np.median(np.abs(others - middle))), float(others.std()) * 0.5, 1e-6)
    return middle, spread


def match_warp(
    edges: NDArray[np.bool_], photograph: NDArray[np.float32], camera: Camera, radius_px: int
) -> WarpMatch | None:
    """Find the rotation and the magnification about the optical axis at which ``edges`` (H, W) best match the
    field ``photograph`` (H, W, 2), each at its best shift; None for fewer than ``MIN_EDGE_PX`` edge pixels.
    """
    if int(edges.sum()) < MIN_EDGE_PX:
        return None
    height, width = edges.shape
    shrink = max(1, -(-width // _WARP_WIDTH_PX))
    size = (width // shrink, height // shrink)
    mesh_field, taken = (
        np.asarray(cv2.resize(field, size, interpolation=cv2.INTER_AREA), np.float32)
        for field in (edge_field(edges), photograph)
    )
    center = (camera.cx_px / shrink - 0.5, camera.cy_px / shrink - 0.5)  # OpenCV: integers are pixel centres
    radius = max(6, radius_px // shrink)
    plain = shift_scores(mesh_field, taken, radius)
    middle, spread = _scores_off_peak(plain)
    at_plain = (float(plain.max()) - middle) / spread

    def height_of(roll_rad: float, zoom: float) -> float:
        found = shift_scores(_warped(mesh_field, center, roll_rad, zoom), taken, radius)
        return (float(found.max()) - middle) / spread - at_plain

    roll, roll_gain = _best(_ROLLS_RAD, [height_of(roll, 1.0) for roll in _ROLLS_RAD], 0.0)
    zoom, zoom_gain = _best(_ZOOMS, [height_of(0.0, zoom) for zoom in _ZOOMS], 1.0)
    return WarpMatch(roll, roll_gain, zoom, zoom_gain, at_plain + max(roll_gain, zoom_gain, 0.0))


def _warped(
    field: NDArray[np.float32], center: tuple[float, float], roll_rad: float, zoom: float
) -> NDArray[np.float32]:
    """Rotate and magnify a field of double angles (H, W, 2) about the pixel ``center`` (x, y)."""
    matrix = cv2.getRotationMatrix2D(center, -float(np.degrees(roll_rad)), zoom)
    moved = cv2.warpAffine(field, matrix, (field.shape[1], field.shape[0]), flags=cv2.INTER_LINEAR)
    c, s = np.cos(2 * roll_rad), np.sin(2 * roll_rad)
    x, y = moved[..., 0], moved[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1).astype(np.float32)


def _best(at: tuple[float, ...], gains: list[float], neutral: float) -> tuple[float, float]:
    """Return the value in ``at`` of the highest of ``gains``, refined by a parabola, or ``neutral`` (gain 0);
    also return its gain."""
    values, heights = np.array([*at, neutral]), np.array([*gains, 0.0])
    order = np.argsort(values)
    values, heights = values[order], heights[order]
    k = int(heights.argmax())
    gain = float(heights[k])
    if 0 < k < len(values) - 1:
        a, b, _ = np.polyfit(values[k - 1 : k + 2], heights[k - 1 : k + 2], 2)
        if a < 0:
            return float(np.clip(-b / (2 * a), values[k - 1], values[k + 1])), gain
    return float(values[k]), gain


def _vertex(scores: NDArray[np.float64], peak: NDArray) -> NDArray[np.float64]:
    """Compute the subpixel offset (2,) of the maximum from the index ``peak`` (2,) by a parabola per axis."""
    found = np.zeros(2)
    for axis in (0, 1):
        step = np.eye(2, dtype=int)[axis]
        if 0 < peak[axis] < scores.shape[axis] - 1:
            low, middle, high = (float(scores[tuple(peak + k * step)]) for k in (-1, 0, 1))
            bend = low - 2 * middle + high
            found[axis] = 0.5 * (low - high) / bend if bend < 0 else 0.0
    return found


def shift_scores(
    mesh_field: NDArray[np.float32], photograph: NDArray[np.float32], radius_px: int
) -> NDArray[np.float64]:
    """Compute the mean agreement (2 R + 1, 2 R + 1) of the fields (H, W, 2) for shifts of the mesh's field by
    (column - R, row - R) pixels, with R = ``radius_px``.
    """
    height, width = mesh_field.shape[:2]
    shape = [cv2.getOptimalDFTSize(side + radius_px) for side in (height, width)]
    total = np.zeros((shape[0], shape[1] // 2 + 1), dtype=np.complex64)
    for k in (0, 1):
        total += np.conj(fft.rfft2(mesh_field[..., k], shape)) * fft.rfft2(photograph[..., k], shape)
    scores = fft.irfft2(total, shape).astype(np.float64)
    scores = np.roll(scores, (radius_px, radius_px), axis=(0, 1))[: 2 * radius_px + 1, : 2 * radius_px + 1]
    weight = float(np.linalg.norm(mesh_field, axis=-1).sum())
    return scores / max(weight, 1e-9)
