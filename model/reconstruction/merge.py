# SPDX-License-Identifier: MIT
"""Merges the maps of all views into one atlas (method 7): by texel, the exact median over the views that see
it.

Letters: V views, K covered texels of a tile. For each covered texel the point and the normal under its
centre are projected into every view; the views that see it (``datagen.multiview.visibility``) contribute
their D, S and R there, and each channel takes the median, of an even number the mean of the middle two.
Nothing is scattered, so an atlas may have more texels than the views have pixels. Work goes tile by tile:
memory holds the views' maps and one tile, while the atlas itself lies on disk.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datagen.cameras import Camera
from datagen.errors import InputError, Problem
from datagen.multiview.visibility import PackedViews, VisibilityOptions, aligned_empty, observe, project
from model.reconstruction.geometry import copied
from model.reconstruction.texels import TexelSurface, TexelTile

if TYPE_CHECKING:
    import mitsuba as mi

MAP_CHANNELS = {"diffuse_albedo": 3, "specular_albedo": 3, "roughness": 1}
"""Maps that are merged and their channels, in the order of the packed storage."""
NUM_CHANNELS = sum(MAP_CHANNELS.values())
ATLAS_DTYPE = np.float16
DEFAULT_TILE = 512
_MIN_WEIGHT = 1e-3  # nearer to zero, the quotient would amplify rounding


@dataclass(frozen=True)
class MapView:
    """A view's maps: ``diffuse_albedo`` and ``specular_albedo`` (H, W, 3), ``roughness`` (H, W, 1), in [0,
    1].

    ``depth_z_m`` (H, W, 1) is 0 where the view has nothing to say: background, lamps, pixels without a
    source.
    """

    camera: Camera
    maps: dict[str, NDArray]
    depth_z_m: NDArray
    face: NDArray | None = None
    name: str = "view"

    def problems(self) -> list[Problem]:
        """Every fault of the arrays."""
        shape = (self.camera.height_px, self.camera.width_px)
        found = []
        for name, channels in MAP_CHANNELS.items():
            array = self.maps.get(name)
            if array is None or array.shape != (*shape, channels):
                got = "missing" if array is None else f"shape {array.shape}"
                found.append(Problem(self.name, name, got, f"{(*shape, channels)} like its camera"))
            elif not np.isfinite(array).all():
                found.append(Problem(self.name, name, "NaN or Inf", "finite values", "predict it again"))
        return found


@dataclass(frozen=True)
class MergeOptions:
    """``fetch`` reads a map at a projection between the pixels that show the same depth, or from the nearest
    pixel; ``tile`` is the side of a tile in texels."""

    fetch: Literal["nearest", "bilinear"] = "bilinear"
    visibility: VisibilityOptions = field(default_factory=VisibilityOptions)
    tile: int = DEFAULT_TILE


@dataclass(frozen=True)
class Atlas:
    """A merged atlas: ``maps`` by name (N, N, 3 or 1) in [0, 1], ``count`` (N, N) how many views each
    texel's medians are over, ``face`` (N, N) its triangle or -1. Row 0 is at v = 1. Texels of count 0 hold 0
    until they are filled."""

    maps: dict[str, NDArray]
    count: NDArray[np.uint16]
    face: NDArray[np.int32]

    @property
    def size(self) -> int:
        """Texels along a side."""
        return int(self.count.shape[0])

    @property
    def seen_mask(self) -> NDArray[np.bool_]:
        """Texels that hold observations."""
        return np.asarray(self.count > 0)

    @property
    def unseen_mask(self) -> NDArray[np.bool_]:
        """Texels with surface that no view sees."""
        return np.asarray((self.face >= 0) & (self.count == 0))


def empty_atlas(size: int, folder: Path | None = None) -> Atlas:
    """An atlas in memory or, given a ``folder``, in files there that are mapped into memory."""
    shapes: dict[str, tuple[tuple[int, ...], Any]] = {
        name: ((size, size, channels), ATLAS_DTYPE) for name, channels in MAP_CHANNELS.items()
    }
    shapes["count"], shapes["face"] = ((size, size), np.uint16), ((size, size), np.int32)
    if folder is None:
        arrays: dict[str, NDArray] = {name: np.zeros(*shape) for name, shape in shapes.items()}
    else:
        folder.mkdir(parents=True, exist_ok=True)
        arrays = {
            name: np.lib.format.open_memmap(folder / f"{name}.npy", "w+", dtype, shape)
            for name, (shape, dtype) in shapes.items()
        }
    arrays["face"][...] = -1
    return Atlas({name: arrays[name] for name in MAP_CHANNELS}, arrays["count"], arrays["face"])


class MapMerger:
    """The maps of all views on the device, ready to be gathered for any texel.

    Raises :class:`InputError` for maps that do not fit their cameras.
    """

    def __init__(
        self,
        views: Sequence[MapView],
        options: MergeOptions | None = None,
        scene: mi.Scene | None = None,
        region_of_face: NDArray | None = None,
    ):
        self.options = options or MergeOptions()
        problems = [problem for view in views for problem in view.problems()]
        if self.options.visibility.mode == "trace" and scene is None:
            problems.append(Problem("merge", "visibility.mode", "'trace'", "a scene to trace", "use 'depth'"))
        if problems:
            raise InputError(*problems)
        import mitsuba as mi

        self._scene = scene
        self._views = [view.camera for view in views]
        self._packed = PackedViews(self._views, [view.depth_z_m for view in views])
        self._maps = _pack_maps(views, self._packed, region_of_face)
        regions = np.zeros(1) if region_of_face is None else region_of_face
        self._region_of_face = mi.Float(copied(regions, np.float32))
        self._has_regions = region_of_face is not None
        self._farthest_m = [float(view.depth_z_m.max(initial=0.0)) for view in views]
        self._capacity = 1 << max(2, (len(views) - 1).bit_length())  # rounded up: fewer kernels to compile

    def medians(
        self,
        points: mi.Point3f,
        normals: mi.Vector3f,
        regions: mi.Float,
        candidates: NDArray[np.uint32],
    ) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """Medians (K, 7) and counts (K,) at surface points, over those of the ``candidates`` that see
        them."""
        import drjit as dr
        import mitsuba as mi

        num_points = dr.width(points)
        if len(candidates) == 0:
            return np.zeros((num_points, NUM_CHANNELS), np.float32), np.zeros(num_points, np.uint32)
        channels, count = _gather_medians(
            self._packed,
            self._maps,
            points,
            normals,
            regions,
            mi.UInt32(copied(candidates, np.uint32)),
            self._capacity,
            self.options,
            self._scene,
        )
        dr.eval(channels, count)
        return np.stack([c.numpy() for c in channels], axis=-1), np.asarray(count.numpy())

    def merge(
        self, surface: TexelSurface, atlas: Atlas, progress: Callable[[int, int], Any] | None = None
    ) -> None:
        """Fill ``atlas`` tile by tile. ``progress(done, total)`` is called after each tile."""
        starts = range(0, atlas.size, self.options.tile)
        total = len(starts) ** 2
        for number, (top, left) in enumerate(((t, left) for t in starts for left in starts), start=1):
            width, height = (min(self.options.tile, atlas.size - start) for start in (left, top))
            self._merge_tile(surface.tile(left, top, width, height), (left, top, width, height), atlas)
            if progress is not None:
                progress(number, total)

    def _merge_tile(self, texels: TexelTile, rectangle: tuple[int, int, int, int], atlas: Atlas) -> None:
        import drjit as dr
        import mitsuba as mi

        left, top, width, _ = rectangle
        index = np.asarray(texels.texel.numpy())
        if index.size == 0:
            return
        points = np.asarray(texels.points.numpy()).reshape(3, -1)
        candidates = self._candidates(points.min(axis=1), points.max(axis=1))
        face = texels.face if self._has_regions else dr.zeros(mi.UInt32, index.size)
        regions = dr.gather(mi.Float, self._region_of_face, face)
        medians, count = self.medians(texels.points, texels.normals, regions, candidates)
        rows, columns = top + index // width, left + index % width
        atlas.face[rows, columns] = np.asarray(texels.face.numpy()).astype(np.int32)
        atlas.count[rows, columns] = count
        first = 0
        for name, channels in MAP_CHANNELS.items():
            atlas.maps[name][rows, columns] = medians[:, first : first + channels]
            first += channels

    def _candidates(self, low: NDArray, high: NDArray) -> NDArray[np.uint32]:
        """Views whose frustum may meet a box: those for which not all corners lie beyond one of its
        planes."""
        corners = np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])
        chosen = []
        for index, camera in enumerate(self._views):
            x, y, z = (corners @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]).T
            left, top = -camera.cx_px, -camera.cy_px
            right, bottom = camera.width_px - camera.cx_px, camera.height_px - camera.cy_px
            beyond = (
                (z <= 0).all(),
                (z > self._farthest_m[index] * 1.1 + 1e-3).all(),
                (camera.fx_px * x < left * z).all(),
                (camera.fx_px * x > right * z).all(),
                (camera.fy_px * y < top * z).all(),
                (camera.fy_px * y > bottom * z).all(),
            )
            if not any(beyond):
                chosen.append(index)
        return np.array(chosen, dtype=np.uint32)


def _pack_maps(
    views: Sequence[MapView], packed: PackedViews, region_of_face: NDArray | None
) -> tuple[mi.Float, mi.Float]:
    """Maps of all pixels as two arrays of packets: D and R, S and the smooth region (0 where unknown)."""
    import mitsuba as mi

    storage = [aligned_empty(packed.num_pixels * 4, np.float32) for _ in range(2)]
    first_packet, second_packet = (flat.reshape(-1, 4) for flat in storage)
    second_packet[:, 3] = 0
    if region_of_face is not None and len(region_of_face) >= 2**24:
        raise ValueError("expected fewer regions than float32 counts exactly")
    for first, view in zip(packed.first_pixels, views, strict=True):
        num = view.camera.width_px * view.camera.height_px
        span = slice(first, first + num)
        first_packet[span, :3] = view.maps["diffuse_albedo"].reshape(num, 3)
        first_packet[span, 3] = view.maps["roughness"].reshape(num)
        second_packet[span, :3] = view.maps["specular_albedo"].reshape(num, 3)
        if region_of_face is not None and view.face is not None:
            face = view.face.reshape(num)
            second_packet[span, 3] = np.where(face >= 0, region_of_face[np.maximum(face, 0)], -1)
    return mi.Float(storage[0]), mi.Float(storage[1])


def _gather_medians(
    packed: PackedViews,
    maps: tuple[mi.Float, mi.Float],
    points: mi.Point3f,
    normals: mi.Vector3f,
    regions: mi.Float,
    candidates: mi.UInt32,
    capacity: int,
    options: MergeOptions,
    scene: mi.Scene | None,
) -> tuple[list[mi.Float], mi.UInt32]:
    """Medians by channel, in the order D S R, and counts (*traced*).

    Each channel's values are kept sorted in local memory as they come; a value sinks to its place and what it
    displaces is carried on.
    """
    import drjit as dr
    import mitsuba as mi

    num_candidates = dr.opaque(mi.UInt32, dr.width(candidates))
    infinity = mi.Float(np.inf)

    def insert(count: Any, values: list[Any], lists: tuple[Any, ...], active: Any) -> tuple[Any, ...]:
        def body(j: Any, *state: Any) -> tuple[Any, ...]:
            carried, kept = list(state[:NUM_CHANNELS]), list(state[NUM_CHANNELS:])
            for c in range(NUM_CHANNELS):
                other = dr.select(j < count, kept[c][j], infinity)
                kept[c][j] = dr.minimum(carried[c], other)
                carried[c] = dr.maximum(carried[c], other)
            return (j + 1, *carried, *kept)

        state = (mi.UInt32(0), *values, *lists)
        result = dr.while_loop(state, lambda j, *_: active & (j <= count), body, label="insert")
        return tuple(result[1 + NUM_CHANNELS :])

    def visit(slot: Any, count: Any, *lists: Any) -> tuple[Any, ...]:
        view = dr.gather(mi.UInt32, candidates, slot)
        seen = observe(packed, view, points, normals, options.visibility, scene)
        at = project(packed, view, points)
        fetched = _fetch(packed, at, maps, regions, options, seen.is_visible)
        lists = insert(count, fetched.values, lists, fetched.is_found)
        return (slot + 1, count + dr.select(fetched.is_found, mi.UInt32(1), mi.UInt32(0)), *lists)

    locals_ = tuple(dr.alloc_local(mi.Float, capacity) for _ in range(NUM_CHANNELS))
    start: Any = (mi.UInt32(0), dr.zeros(mi.UInt32, dr.width(points)), *locals_)
    visit_view: Any = visit
    result: Any = dr.while_loop(start, lambda slot, *_: slot < num_candidates, visit_view, label="merge")
    count, lists = result[1], result[2:]
    has_any = count > 0
    lower = dr.select(has_any, (count - 1) // 2, 0)
    upper = dr.select(has_any, count // 2, 0)
    medians = [dr.select(has_any, 0.5 * (kept[lower] + kept[upper]), 0.0) for kept in lists]
    return medians, count


class _Fetched(NamedTuple):
    """A map's channels at a projection, in the order D S R, and whether anything was there to read."""

    values: list[mi.Float]
    is_found: mi.Bool


def _fetch(
    packed: PackedViews,
    at: Any,
    maps: tuple[mi.Float, mi.Float],
    region: mi.Float,
    options: MergeOptions,
    active: mi.Bool,
) -> _Fetched:
    """The maps between the four pixels around a projection, or at the nearest (*traced*).

    Pixels of another smooth region, or (between pixels) of another depth, show something else and do not
    count.
    """
    import drjit as dr
    import mitsuba as mi

    last_x, last_y = at.layout[1] - 1, at.layout[2] - 1
    if options.fetch == "nearest":
        taps = [(mi.UInt32(at.u_px), mi.UInt32(at.v_px), mi.Float(1))]
    else:
        x = dr.clip(at.u_px - 0.5, 0, mi.Float(last_x))  # the border pixel continues past its centre
        y = dr.clip(at.v_px - 0.5, 0, mi.Float(last_y))
        left, top = mi.UInt32(x), mi.UInt32(y)
        right, bottom = dr.minimum(left + 1, last_x), dr.minimum(top + 1, last_y)
        s, t = x - mi.Float(left), y - mi.Float(top)
        taps = [(left, top, (1 - s) * (1 - t)), (right, top, s * (1 - t))]
        taps += [(left, bottom, (1 - s) * t), (right, bottom, s * t)]
    tolerance = at.z_m * (options.visibility.depth_tolerance + options.visibility.slope_limit)
    first: Any = mi.Vector4f(0)
    second: Any = mi.Vector4f(0)
    weights: Any = mi.Float(0)
    for column, row, share in taps:
        pixel = at.layout[0] + row * at.layout[1] + column
        packet = dr.gather(mi.Vector4f, maps[1], pixel, active)
        is_same = packet[3] == region
        if options.fetch == "bilinear":
            depth = dr.gather(mi.Float, packed.depth, pixel, active)
            is_same &= dr.abs(depth - at.z_m) <= tolerance
        weight: Any = dr.select(is_same, share, 0)
        first += weight * dr.gather(mi.Vector4f, maps[0], pixel, active)
        second += weight * packet
        weights += weight
    is_found = active & (weights > _MIN_WEIGHT)
    scale = dr.rcp(dr.maximum(weights, _MIN_WEIGHT))
    values = [first[0], first[1], first[2], second[0], second[1], second[2], first[3]]
    return _Fetched([value * scale for value in values], is_found)
