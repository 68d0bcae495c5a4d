# SPDX-License-Identifier: MIT
"""Merges the maps of all views into one atlas by the median of each texel over views, or a weighted mean.

The point and normal at the centre of each covered texel are projected into every view. Views in which the
point is visible (``datagen.multiview.visibility``) contribute D, S and R, and each channel is the median (for
even counts, the mean of the middle two) or, with weights, the mean of the middle half
(``lane_sort.middle_mean``). Values are gathered, not scattered, so an atlas may have more texels than the
views have pixels. Threads process tiles; a large atlas is on disk, so memory contains only the views' maps
and a few tiles. The loop is in ``medians``.

At image borders and silhouettes, the set of merged views changes, which would cause visible steps in the
merged maps. A pixel's weight therefore decreases to almost 0 towards the nearest border. Distant and grazing
views blur texture. Exact maps (confidence 1) are therefore weighted by the square of their resolution on the
surface; for predictions (confidence 0), whose errors differ between views, resolution has no effect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.cameras import Camera
from datagen.foundation.errors import Problem, Problems, raise_problems
from datagen.foundation.peak_memory import num_threads
from datagen.geometry.views import TracedView
from datagen.multiview.visibility import PackedViews, VisibilityOptions, observe
from mitsuba_plugins.arrays import vectors_from_rows
from model.reconstruction.atlas.atlas import MAP_CHANNELS, MAP_COLUMNS, Atlas
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.merge.lane_sort import networks
from model.reconstruction.merge.medians import (
    CAMERA,
    MIN_WEIGHT,
    NUM_CHANNELS,
    PACKET,
    Rules,
    Surface,
    ViewArrays,
    may_see,
    merge_tile,
)
from model.reconstruction.merge.weights import Weights

if TYPE_CHECKING:
    import mitsuba as mi


from datagen.geometry.traced import ViewGeometry

RAMP = 0.1
"""Distance from a border over which the weight decreases, relative to the image diagonal."""
MIN_BORDER_WEIGHT = 1e-3
"""Weight at a border, above 0 so that texels visible only near borders, such as leaves, get a value."""
MIN_COSINE = 0.02
"""Minimum cosine of the angle of incidence, since a weight of 0 would discard views that show the texel."""


@dataclass(frozen=True)
class MapView:
    """Maps of a view in [0, 1]: ``diffuse_albedo``, ``specular_albedo`` (H, W, 3), ``roughness`` (H, W, 1).

    ``depth_z_m`` (H, W, 1) is 0 at pixels without a value, such as background and lamps. ``face`` (H, W):
    index of each pixel's triangle; ``confidence`` (H, W, 3): optional confidence of D, S and R in [0, 1];
    ``resolution`` (H, W): pixels per metre on the surface, 0 without a surface; None without confidence.
    """

    camera: Camera
    maps: dict[str, NDArray]
    depth_z_m: NDArray
    face: NDArray | None = None
    name: str = "view"
    confidence: NDArray | None = None
    resolution: NDArray | None = None

    def problems(self) -> list[Problem]:
        """Return all faults in shape and values of the arrays."""
        size, found = (self.camera.height_px, self.camera.width_px), Problems(self.name)
        for name, channels in MAP_CHANNELS.items():
            array = self.maps.get(name)
            if array is None or array.shape != (*size, channels):
                got = "missing" if array is None else f"shape {array.shape}"
                found.add(name, got, f"{(*size, channels)} like its camera")
            elif not np.isfinite(array).all():
                found.add(name, "NaN or Inf", "finite values", "predict it again")
        for name, *shapes in (
            ("depth_z_m", (*size, 1), size),
            ("resolution", size),
            ("confidence", (*size, 3)),
        ):
            array = getattr(self, name)
            if array is not None and array.shape not in shapes:
                found.add(name, f"shape {array.shape}", f"{shapes[0]} like its camera")
            elif name == "depth_z_m" and not np.isfinite(array).all():
                found.add(name, "NaN or Inf", "finite depth, 0 for none")
        return found


def map_views(views: Sequence[TracedView], maps: Sequence[dict[str, NDArray]]) -> list[MapView]:
    """Combine traced ``views`` with their ``maps``; the depth of lamps and background is set to 0."""
    return [
        MapView(
            view.camera,
            view_maps,
            np.where(view.geometry.surface_mask > 0, view.geometry.depth_z_m, 0),
            view.geometry.face,
            view.name,
            view_maps.get("confidence"),
            pixels_per_metre(view.camera, view.geometry) if "confidence" in view_maps else None,
        )
        for view, view_maps in zip(views, maps, strict=True)
    ]


@dataclass(frozen=True)
class MergeOptions:
    """Options of the merge.

    ``tile``: side of a tile in texels; ``weights``: weights of pixels
    (:mod:`model.reconstruction.merge.weights`).
    """

    visibility: VisibilityOptions = field(default_factory=VisibilityOptions)
    tile: int = 512
    weights: Weights = "none"

    def rules(self) -> Rules:
        """Convert the options to the parameters of the loop."""
        visibility, weights = self.visibility, self.weights
        return Rules(
            np.float32(visibility.depth_tolerance),
            np.float32(visibility.slope_tolerance_px),
            np.float32(visibility.slope_limit),
            visibility.mode == "trace",
            weights != "none",
        )


class MapMerger:
    """Merges the maps of ``views``.

    ``region_of_face`` (M,): smooth region (bounded by creases) of each triangle; if given, values are
    not interpolated between regions. ``scene`` is required for visibility by shadow rays. Raises
    :class:`InputError` for maps that do not match their cameras, and for missing views, scene or confidence.
    """

    def __init__(
        self,
        views: Sequence[MapView],
        options: MergeOptions | None = None,
        scene: mi.Scene | None = None,
        region_of_face: NDArray | None = None,
    ):
        self.options = options or MergeOptions()
        self._rules = self.options.rules()
        problems = [problem for view in views for problem in view.problems()]
        if not views:
            problems.append(Problem("merge", "", "no views", "at least one view", "add views"))
        if self._rules.is_traced and scene is None:
            problems.append(Problem("merge", "visibility.mode", "'trace'", "a scene to trace", "use 'depth'"))
        if self.options.weights == "confidence" and any(view.confidence is None for view in views):
            expected = "a confidence for every view"
            problems.append(Problem("merge", "weights", "'confidence'", expected, "use 'borders'"))
        raise_problems(problems)
        self._scene = scene
        self._views = _view_arrays(views, region_of_face, self.options)
        self._regions = region_of_face
        self._networks = networks(len(views))
        self._packed = PackedViews([view.camera for view in views], None) if self._rules.is_traced else None

    def merge(
        self, surface: TexelSurface, atlas: Atlas, progress: Callable[[int, int], Any] | None = None
    ) -> None:
        """Merge into ``atlas`` tile by tile; ``progress(done, total)`` is called after each tile."""
        regions = np.zeros(surface.num_faces) if self._regions is None else self._regions
        arrays = surface.uv, surface.vertices, surface.positions, surface.normals
        loop_surface = Surface(surface.size, *arrays, regions.astype(np.float32))
        starts = range(0, atlas.size, self.options.tile)
        total, done = len(starts) ** 2, 0
        # Mitsuba's rays already use all processors
        with ThreadPoolExecutor(1 if self._rules.is_traced else num_threads()) as pool:
            for top in starts:
                row = [
                    pool.submit(self._merge_tile, surface, loop_surface, atlas, left, top) for left in starts
                ]
                try:
                    for task in row:
                        task.result()
                        done += 1
                        if progress is not None:
                            progress(done, total)
                except BaseException:
                    for task in row:
                        task.cancel()
                    raise
                atlas.release()

    def _merge_tile(
        self, surface: TexelSurface, loop_surface: Surface, atlas: Atlas, left: int, top: int
    ) -> None:
        width, height = (min(self.options.tile, atlas.size - start) for start in (left, top))
        face = surface.faces(left, top, width, height)
        if not (face >= 0).any():
            return
        traced = np.zeros((0, 0, 0), np.bool_)
        if self._rules.is_traced:
            traced = self._trace(*surface.points(face, left, top), face >= 0)
        medians = np.zeros((height, width, NUM_CHANNELS), np.float32)
        count = np.zeros((height, width), np.uint16)
        merge_tile(
            face, left, top, loop_surface, self._views, self._rules, traced, *self._networks, medians, count
        )
        window = (slice(top, top + height), slice(left, left + width))
        atlas.face[window], atlas.count[window] = face, count
        for name, columns in MAP_COLUMNS.items():
            atlas.maps[name][window] = medians[..., columns]

    def _trace(self, points: NDArray, normals: NDArray, is_covered: NDArray) -> NDArray[np.bool_]:
        """Compute the visibility (V, H, W) of a tile's covered texels in the views by shadow rays."""
        import drjit as dr
        import mitsuba as mi

        assert self._packed is not None
        seen = np.zeros((self._packed.num_views, *is_covered.shape), np.bool_)
        chosen = points[is_covered]
        low, high = chosen.min(axis=0), chosen.max(axis=0)
        x, y, z = (np.float32(value) for value in 0.5 * (low + high))
        radius = np.float32(0.51 * np.linalg.norm(high - low) + 1e-6)
        position, normal = mi.Point3f(vectors_from_rows(chosen)), vectors_from_rows(normals[is_covered])
        for view, camera in enumerate(self._views.cameras):
            if may_see(camera, x, y, z, radius):
                index = dr.opaque(mi.UInt32, view)
                found = observe(
                    self._packed, index, position, normal, self.options.visibility, self._scene
                ).is_visible
                seen[view, is_covered] = np.asarray(found.numpy(), dtype=bool)
        return seen


def _typical_resolution(views: Sequence[MapView]) -> float:
    """Return the median over views of their median resolution (pixels per metre), 1 if none has one."""
    resolutions = [view.resolution for view in views if view.resolution is not None]
    medians = [np.median(r[r > 0]) for r in resolutions if r.any()]
    return float(np.median(medians)) if medians else 1.0


def _view_arrays(
    views: Sequence[MapView], region_of_face: NDArray | None, options: MergeOptions
) -> ViewArrays:
    """Pack the views into arrays for the loop; all pixels have region 0 if ``region_of_face`` is None.

    Raises ValueError for too many regions.
    """
    if region_of_face is not None and region_of_face.max(initial=0) >= 2**24:
        raise ValueError("expected fewer regions than float32 counts exactly")
    sizes = [view.camera.width_px * view.camera.height_px for view in views]
    ends = np.cumsum(sizes)
    cameras = np.zeros((len(views), CAMERA), np.float32)
    depth = np.empty(ends[-1], np.float32)
    packets = np.zeros((ends[-1], PACKET), np.float32)
    visibility, weights = options.visibility, options.weights
    weight = np.ones((0 if weights == "none" else ends[-1], 3), np.float32)
    typical = _typical_resolution(views)
    for index, (view, num, end) in enumerate(zip(views, sizes, ends, strict=True)):
        camera, span = view.camera, slice(end - num, end)
        cameras[index, :9] = camera.camera_from_world[:3, :3].ravel()
        cameras[index, 9:12] = camera.position_m
        cameras[index, 12:16] = camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px
        cameras[index, 16:18] = camera.width_px, camera.height_px
        cameras[index, 18] = view.depth_z_m.max(initial=0.0) * 1.1 + 1e-3
        depth[span] = view.depth_z_m.ravel()
        for name, columns in MAP_COLUMNS.items():
            packets[span, columns] = view.maps[name].reshape(num, -1)
        if region_of_face is not None and view.face is not None:
            face = view.face.reshape(num)
            packets[span, NUM_CHANNELS] = np.where(face >= 0, region_of_face[np.maximum(face, 0)], -1)
        if weights == "none":
            continue
        image = view.depth_z_m.reshape(camera.height_px, camera.width_px)
        borders = border_weights(image, visibility.depth_tolerance + visibility.slope_limit)
        weight[span] = borders.reshape(num, 1)
        if view.confidence is not None and weights == "confidence":
            weight[span] *= np.maximum(view.confidence.reshape(num, 3), MIN_WEIGHT)
        elif view.confidence is not None and view.resolution is not None and weights == "resolution":
            weight[span] *= resolution_weights(view.resolution, typical, view.confidence).reshape(num, 3)
    return ViewArrays(cameras, (ends - sizes).astype(np.int64), depth, packets, weight)


def border_weights(depth_z_m: NDArray, max_jump: float) -> NDArray[np.float32]:
    """Compute the weight (H, W) in [MIN_BORDER_WEIGHT, 1] of each pixel by distance to the nearest border.

    Borders are the edges of the image, pixels without a surface (``depth_z_m`` (H, W) is 0), and neighbouring
    pixels whose depths differ by more than ``max_jump`` relative to the larger one.
    """
    import cv2

    is_free = depth_z_m > 0
    for axis in (0, 1):
        depth, free = np.swapaxes(depth_z_m, 0, axis), np.swapaxes(is_free, 0, axis)
        jumps = np.abs(np.diff(depth, axis=0)) > max_jump * np.maximum(depth[1:], depth[:-1])
        free[1:] &= ~jumps
        free[:-1] &= ~jumps
    padded = np.pad(is_free, 1).astype(np.uint8)
    distance_px: Any = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    ramp_px = RAMP * float(np.linalg.norm(depth_z_m.shape))
    return np.clip(distance_px / ramp_px, MIN_BORDER_WEIGHT, 1).astype(np.float32)


def pixels_per_metre(camera: Camera, view: ViewGeometry) -> NDArray[np.float32]:
    """Compute f cos / z (H, W), each pixel's resolution on the surface along its coarser axis.

    f: focal length in pixels; cos: cosine of the angle of incidence; z: depth. 0 at pixels without a surface.
    """
    depth = view.depth_z_m[..., 0]
    found = np.sqrt(camera.fx_px * camera.fy_px) * np.maximum(view.cosine(camera), MIN_COSINE)
    return np.divide(found, depth, out=np.zeros_like(depth), where=depth > 0)


def resolution_weights(resolution: NDArray, typical: float, confidence: NDArray) -> NDArray[np.float32]:
    """Compute (``resolution`` / ``typical``)^(2 ``confidence``) (H, W, 3) of D, S and R.

    ``resolution`` (H, W): pixels per metre; where it is 0, weights are 1. ``typical``: median resolution of
    the views; ``confidence`` (H, W, 3) in [0, 1].
    """
    relative = np.where(resolution > 0, resolution / typical, 1).astype(np.float32)
    return relative[..., None] ** (2 * confidence.astype(np.float32))
