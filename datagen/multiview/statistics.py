# SPDX-License-Identifier: MIT
"""Multi-view colour statistics of every pixel: minimum, median and maximum over the best views.

The Dr.Jit kernel runs on CPU and GPU and is compiled once for all views. For each pixel with a surface, the
point p is unprojected from the view's depth, the views in which p is visible are ranked (``view_selection``),
the colours in the best views are fetched at p's projections, and each channel is sorted by a sorting network.
The median of an even number of colours is the mean of the middle two. Pixels without a surface (nothing hit,
an emitter, or less than half covered by reflecting surface), and pixels whose point is visible in no view,
get their own colour and the count 0.

Functions marked *traced* take and return Dr.Jit arrays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.buffers import MIN_COVERAGE, STATISTICS_BUFFERS
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import Problem, Problems, input_error, raise_problems
from datagen.multiview.view_selection import Selection, select_views
from datagen.multiview.visibility import PackedViews, VisibilityOptions, project
from mitsuba_plugins.arrays import aligned, aligned_empty, vectors_from_rows
from mitsuba_plugins.variant import select_variant

if TYPE_CHECKING:
    import mitsuba as mi

MIN_BEST_VIEWS, MAX_BEST_VIEWS = 4, 24
_MIN_WEIGHT = 1e-3


@dataclass(frozen=True)
class StatisticsView:
    """Input of the statistics from one view; arrays may have any float dtype.

    ``color`` (H, W, 3), scene-linear; ``depth_z_m`` (H, W, 1), 0 without a hit; ``normal_world`` (H, W, 3);
    ``surface_mask`` (H, W, 1), in [0, 1].
    """

    camera: Camera
    color: NDArray
    depth_z_m: NDArray
    normal_world: NDArray
    surface_mask: NDArray
    name: str = "view"

    @classmethod
    def from_buffers(
        cls, camera: Camera, buffers: Mapping[str, NDArray], name: str = "view"
    ) -> StatisticsView:
        """Create the input from a view's buffers by name; ``color`` is ``beauty``."""
        color, depth, normal = buffers["beauty"], buffers["depth_z_m"], buffers["normal_world"]
        return cls(camera, color, depth, normal, buffers["surface_mask"], name)

    def problems(self) -> list[Problem]:
        """List the faults of the arrays: shapes that do not match the camera, NaN and Inf."""
        height, width = self.camera.height_px, self.camera.width_px
        found, remedy = Problems(self.name), "render the view again"
        channels = {"color": 3, "depth_z_m": 1, "normal_world": 3, "surface_mask": 1}
        for name, num_channels in channels.items():
            array, shape = getattr(self, name), (height, width, num_channels)
            if array.shape != shape:
                found.add(name, f"shape {array.shape}", f"{shape} like its camera", remedy)
            elif not np.isfinite(array).all():
                bad = np.count_nonzero(~np.isfinite(array))
                found.add(name, f"{bad} NaN or Inf", "finite values", remedy)
        return found


@dataclass(frozen=True)
class StatisticsOptions:
    """Options of the statistics. Raises :class:`InputError` for invalid values.

    ``best_views``: maximum number k of views used for a pixel, in [4, 24]. ``include_self``: whether the
    pixel's own view is a candidate.
    """

    best_views: int = 12
    include_self: bool = True
    visibility: VisibilityOptions = field(default_factory=VisibilityOptions)

    def __post_init__(self) -> None:
        if not MIN_BEST_VIEWS <= self.best_views <= MAX_BEST_VIEWS:
            expected = f"a whole number in [{MIN_BEST_VIEWS}, {MAX_BEST_VIEWS}]"
            raise input_error("statistics", "best_views", repr(self.best_views), expected, "correct it")


def has_surface(depth_z_m: NDArray, surface_mask: NDArray) -> NDArray[np.bool_]:
    """Mask (H, W) of pixels that show a reflecting surface and have statistics, from buffers (H, W, 1)."""
    return (depth_z_m[..., 0] > 0) & (surface_mask[..., 0] >= MIN_COVERAGE)


def compute_statistics(
    views: Sequence[StatisticsView],
    options: StatisticsOptions | None = None,
    scene: mi.Scene | None = None,
    only: Sequence[int] | None = None,
) -> Iterator[dict[str, NDArray[np.float32]]]:
    """Iterate over the statistics of all views, or of those with indices ``only``, as arrays by buffer name.

    ``color_min``, ``color_median``, ``color_max`` (H, W, 3) are scene-linear; ``observation_count`` is
    (H, W, 1). ``scene`` is needed only for visibility by ``trace``: a ``mi.Scene``, or any object whose
    ``ray_test(ray, active=mask)`` returns whether a ray is occluded. Input is checked before iteration; all
    faults are raised in one :class:`InputError`.
    """
    options = options or StatisticsOptions()
    problems = [problem for view in views for problem in view.problems()]
    if options.visibility.mode == "trace" and scene is None:
        problems.append(
            Problem("statistics", "visibility.mode", "'trace'", "a scene to trace", "use 'depth'")
        )
    raise_problems(problems)
    select_variant()
    packed = PackedViews([view.camera for view in views], [view.depth_z_m for view in views])
    wanted = range(len(views)) if only is None else only
    return _statistics_of_all(views, packed, options, scene, wanted)


def _statistics_of_all(
    views: Sequence[StatisticsView],
    packed: PackedViews,
    options: StatisticsOptions,
    scene: mi.Scene | None,
    wanted: Sequence[int],
) -> Iterator[dict[str, NDArray[np.float32]]]:
    import drjit as dr

    colors = _pack_colors(views, packed)

    def launch(index: int) -> tuple[Any, ...]:
        result = _view_statistics(views[index], index, packed, colors, options, scene)
        dr.eval(result)  # asynchronous: the next view is computed while the caller writes this one
        return result

    pending = launch(wanted[0]) if wanted else ()
    for done, index in enumerate(wanted, start=1):
        view = views[index]
        result, pending = pending, launch(wanted[done]) if done < len(wanted) else ()
        shape = (view.camera.height_px, view.camera.width_px, -1)
        arrays = [np.stack([channel.numpy() for channel in color], axis=-1) for color in result[:3]]
        arrays.append(result[3].numpy()[:, None])
        yield {name: array.reshape(shape) for name, array in zip(STATISTICS_BUFFERS, arrays, strict=True)}


def _pack_colors(views: Sequence[StatisticsView], packed: PackedViews) -> mi.Float:
    """Colours of all views as four floats per pixel (the last is 0), for fetching by one packet load."""
    import mitsuba as mi

    flat = aligned_empty(packed.num_pixels * 4, np.float32)
    colors = flat.reshape(-1, 4)
    colors[:, 3] = 0
    for first, view in zip(packed.first_pixels, views, strict=True):
        pixels = view.color.reshape(-1, 3)
        colors[first : first + len(pixels), :3] = pixels
    return mi.Float(flat)


def _view_statistics(
    view: StatisticsView,
    index: int,
    packed: PackedViews,
    colors: mi.Float,
    options: StatisticsOptions,
    scene: mi.Scene | None,
) -> tuple[Any, ...]:
    """Minimum, median, maximum (lists of three channels) and count of each pixel of a view (*traced*)."""
    import drjit as dr
    import mitsuba as mi

    own_pixel, points, selection = choose_for_pixels(view, index, packed, options, scene)
    own_color = dr.gather(mi.Vector4f, colors, own_pixel)
    own_view = dr.opaque(mi.UInt32, index)
    chosen = _fetch_colors(packed, points, selection, colors, options, own_view, own_color)
    count = selection.num_chosen
    statistics = [
        _order_statistics([dr.select(j < count, color[j], np.inf) for j in range(options.best_views)], count)
        for color in chosen
    ]
    has_any = count > 0
    minimum, median, maximum = (
        [dr.select(has_any, statistics[c][s], own_color[c]) for c in range(3)] for s in range(3)
    )
    return minimum, median, maximum, mi.Float(count)


def choose_for_pixels(
    view: StatisticsView,
    index: int,
    packed: PackedViews,
    options: StatisticsOptions,
    scene: mi.Scene | None = None,
) -> tuple[mi.UInt32, mi.Point3f, Selection]:
    """Packed indices, world points and chosen views of the pixels of view ``index``, row-major (*traced*)."""
    import drjit as dr
    import mitsuba as mi

    own = dr.opaque(mi.UInt32, index)
    first = dr.opaque(mi.UInt32, int(packed.first_pixels[index]))
    pixel = dr.arange(mi.UInt32, view.camera.width_px * view.camera.height_px)
    mask = dr.gather(mi.Bool, mi.Bool(aligned(has_surface(view.depth_z_m, view.surface_mask))), pixel)
    normals = vectors_from_rows(view.normal_world.reshape(-1, 3))
    normals *= dr.rsqrt(dr.maximum(dr.squared_norm(normals), 1e-12))  # shorter at edges (averaged)
    own_pixel = first + pixel

    points = _unproject(packed, own, pixel, dr.gather(mi.Float, packed.depth, own_pixel))
    best, visibility, include_own = options.best_views, options.visibility, options.include_self
    selection = select_views(packed, points, normals, best, visibility, scene, own, include_own, mask)
    return own_pixel, points, selection


def _unproject(packed: PackedViews, view: mi.UInt32, pixel: mi.UInt32, depth: mi.Float) -> mi.Point3f:
    """World points at the centres of a view's pixels (*traced*)."""
    import drjit as dr
    import mitsuba as mi

    at = project(packed, view, mi.Point3f(0, 0, 0))
    # In idle lanes of a kernel's last SIMD packet, gathers return 0, and an integer division by 0 crashes.
    width = dr.maximum(at.layout[1], 1)
    row = pixel // width
    x = (mi.Float(pixel - row * width) + 0.5 - at.intrinsics[2]) / at.intrinsics[0]
    y = (mi.Float(row) + 0.5 - at.intrinsics[3]) / at.intrinsics[1]
    return mi.Point3f(at.rotation.T @ mi.Vector3f(x * depth, y * depth, depth) + at.centre)


def _fetch_colors(
    packed: PackedViews,
    points: mi.Point3f,
    selection: Selection,
    colors: mi.Float,
    options: StatisticsOptions,
    own: mi.UInt32,
    own_color: mi.Vector4f,
) -> Any:
    """Colours of the points in their chosen views, as local arrays (k,) of red, green and blue (*traced*)."""
    import drjit as dr
    import mitsuba as mi

    def body(*state: Any) -> tuple[Any, ...]:
        j, red, green, blue = state
        view = selection.views[j]
        at = project(packed, view, points)
        is_own = view == own
        fetched = _fetch_bilinear(packed, at, colors, options.visibility, ~is_own)
        color = dr.select(is_own, own_color, fetched)  # exact, without a projection
        red[j], green[j], blue[j] = color[0], color[1], color[2]
        return j + 1, red, green, blue

    locals_ = tuple(dr.alloc_local(mi.Float, options.best_views, mi.Float(0)) for _ in range(3))
    state = (mi.UInt32(0), *locals_)
    _, *rgb = dr.while_loop(state, lambda j, *_: j < selection.num_chosen, body, label="fetch_colors")
    return rgb


def _fetch_bilinear(
    packed: PackedViews, at: Any, colors: mi.Float, options: VisibilityOptions, active: mi.Bool
) -> mi.Vector4f:
    """Interpolate colours between the four pixels around the projection, excluding those at another depth."""
    import drjit as dr
    import mitsuba as mi

    # beyond the outermost pixel centres the border pixel's colour is repeated
    last_x, last_y = at.layout[1] - 1, at.layout[2] - 1
    x = dr.clip(at.u_px - 0.5, 0, mi.Float(last_x))
    y = dr.clip(at.v_px - 0.5, 0, mi.Float(last_y))
    left, top = mi.UInt32(x), mi.UInt32(y)
    right, bottom = dr.minimum(left + 1, last_x), dr.minimum(top + 1, last_y)
    share_x, share_y = x - mi.Float(left), y - mi.Float(top)
    tolerance = at.z_m * (options.depth_tolerance + options.slope_limit)
    total: Any = mi.Vector4f(0)
    weights: Any = mi.Float(0)
    for column, row, weight in (
        (left, top, (1 - share_x) * (1 - share_y)),
        (right, top, share_x * (1 - share_y)),
        (left, bottom, (1 - share_x) * share_y),
        (right, bottom, share_x * share_y),
    ):
        pixel = at.layout[0] + row * at.layout[1] + column
        depth = dr.gather(mi.Float, packed.depth, pixel, active)
        weight = dr.select(dr.abs(depth - at.z_m) <= tolerance, weight, 0)
        total += weight * dr.gather(mi.Vector4f, colors, pixel, active)
        weights += weight
    # Only with visibility by trace can all four depths differ; small weights would amplify rounding errors.
    nearest = dr.gather(mi.Vector4f, colors, at.pixel(), active)
    return dr.select(weights > _MIN_WEIGHT, total / weights, nearest)


def _order_statistics(values: list[Any], count: mi.UInt32) -> tuple[Any, Any, Any]:
    """Minimum, median and maximum of the first ``count`` of ``values``; the rest must be Inf (*traced*)."""
    import drjit as dr

    values = list(values)
    for low, high in sorting_network(len(values)).tolist():
        values[low], values[high] = (
            dr.minimum(values[low], values[high]),
            dr.maximum(values[low], values[high]),
        )
    lower, upper, maximum = values[0], values[0], values[0]
    for rank in range(1, len(values)):
        maximum = dr.select(count == rank + 1, values[rank], maximum)
        lower = dr.select((count - 1) // 2 == rank, values[rank], lower)
        upper = dr.select(count // 2 == rank, values[rank], upper)
    return values[0], 0.5 * (lower + upper), maximum


def sorting_network(size: int) -> NDArray[np.int64]:
    """Index pairs (C, 2) to compare and exchange in turn, Batcher's odd-even merge sort of ``size`` keys."""
    pairs = [np.zeros((0, 2), np.int64)]
    run = 1
    while run < size:
        step = run
        while step >= 1:
            low = np.arange(step % run, size - step)
            is_first = (low - step % run) // step % 2 == 0
            low = low[is_first & (low // (2 * run) == (low + step) // (2 * run))]
            pairs.append(np.stack([low, low + step], axis=1))
            step //= 2
        run *= 2
    return np.concatenate(pairs)
