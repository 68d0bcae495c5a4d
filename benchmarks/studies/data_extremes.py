# SPDX-License-Identifier: MIT
"""Accuracy of statistics, projection, encodings and rendering for extreme inputs, in tables.

    python -m benchmarks.studies.data_extremes            all tables as Markdown

``tests/benchmarks/test_extremes.py`` checks the results of the same functions. The scene of boxes is in
``oracles/multiview_scenes.py``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import markdown
from datagen.formats.lights import AreaLight
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.buffers import BUFFERS
from datagen.foundation.color import linear_from_log, log_from_linear
from datagen.foundation.exr import decode_view, encode_view, to_storage
from datagen.multiview.statistics import StatisticsView, compute_statistics
from datagen.multiview.visibility import PackedViews
from mitsuba_plugins.variant import select_variant
from oracles.multiview_scenes import make_views
from oracles.point_observations import observe_points
from oracles.rendering_scenes import SmallScene, down_camera, quad, renderer

SCALES = (1e-3, 1e-1, 1e2, 1e4)
RADIANCES = (1e-6, 1e-3, 1e3, 1e6)
HALF_VALUES = (0.0, 3e-8, 1e-6, 1e-4, 0.01, 1.0, 65504.0, 65520.0, 1e6, np.inf)
COLORS = ("color_min", "color_median", "color_max")


def scaled_views(views: Sequence[StatisticsView], factor: float) -> list[StatisticsView]:
    """Return the views of the same scene enlarged by ``factor``."""
    found = []
    for view in views:
        pose = view.camera.world_from_camera.copy()
        pose[:3, 3] *= factor
        camera = replace(view.camera, world_from_camera=pose)
        found.append(replace(view, camera=camera, depth_z_m=(view.depth_z_m * factor).astype(np.float32)))
    return found


def scale_of_scene(factor: float, size: tuple[int, int] = (60, 40)) -> dict[str, float]:
    """Changes of statistics and projections, by name, when the whole scene is enlarged by ``factor``."""
    views = make_views((size,), is_noise=False)
    larger = scaled_views(views, factor)
    changed, difference = [], 0.0
    for one, other in zip(compute_statistics(views), compute_statistics(larger), strict=True):
        is_same = (one["observation_count"] == other["observation_count"])[..., 0]
        changed.append(1.0 - is_same.mean())
        for name in COLORS:
            difference = max(difference, float(np.abs(one[name] - other[name])[is_same].max()))
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (2000, 3)) * factor
    normals = rng.normal(size=(2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = observe_points(
        PackedViews([v.camera for v in larger], [v.depth_z_m for v in larger]), points, normals
    )
    pixel_error = 0.0
    for index, view in enumerate(larger):
        mask = seen.visible_mask[index]
        if mask.any():
            expected, _ = view.camera.project(points[mask])
            pixel_error = max(pixel_error, float(np.abs(seen.pixels[index][mask] - expected).max()))
    return {
        "pixels with another count": float(np.mean(changed)),
        "largest difference of a colour": difference,
        "largest error of a projection, px": pixel_error,
    }


def scale_of_radiance(factor: float, size: tuple[int, int] = (33, 22)) -> float:
    """Largest relative difference of statistics when all colours are multiplied by ``factor``."""
    views = make_views((size,))
    brighter = [replace(v, color=v.color * np.float32(factor)) for v in views]
    largest = 0.0
    for one, other in zip(compute_statistics(views), compute_statistics(brighter), strict=True):
        assert (one["observation_count"] == other["observation_count"]).all()
        for name in COLORS:
            expected = one[name].astype(np.float64) * np.float64(np.float32(factor))
            error = np.abs(other[name] - expected) / np.maximum(expected, 1e-30)
            largest = max(largest, float(error.max()))
    return largest


def stored_as_half(value: float) -> float:
    """The radiance ``value`` after a round trip through a view's file, which stores half floats."""
    image = np.full((2, 2, 3), value, np.float32)
    stored = to_storage(BUFFERS["beauty"], image)
    return float(decode_view(encode_view({"beauty": stored}))["beauty"][0, 0, 0])


def log_round_trip(dtype: Any) -> float:
    """Largest absolute error of log encoding and decoding over [0, 1], for inputs of ``dtype``."""
    values = np.concatenate([np.linspace(0, 1, 20001), np.geomspace(1e-7, 1, 2001)]).astype(dtype)
    return float(np.abs(linear_from_log(log_from_linear(values)).astype(np.float64) - values).max())


def alike_views(num_views: int, size: tuple[int, int] = (16, 12)) -> list[StatisticsView]:
    """Make ``num_views`` identical views."""
    (view,) = make_views((size,), num_views=1)
    return [replace(view, name=f"view_{k:03}") for k in range(num_views)]


def spread_of_alike_views(num_views: int) -> float:
    """Largest difference between maximum and minimum colour over identical views, relative to the colour."""
    views = alike_views(num_views)
    (result,) = compute_statistics(views, only=(0,))
    own = np.maximum(views[0].color, 1e-30)
    return float(((result["color_max"] - result["color_min"]) / own).max())


def lit_floor(metres: float, radiance: float) -> NDArray[np.float64]:
    """Image (8, 8, 3) of a floor under a square light of ``radiance``, with lengths scaled by ``metres``."""
    size = 10 * metres
    floor = quad([-size / 2, -size / 2, 0], [size, 0, 0], [0, size, 0])
    light = AreaLight(
        name="light",
        origin_m=(-metres, metres, 2 * metres),
        edge_u_m=(2 * metres, 0, 0),
        edge_v_m=(0, -2 * metres, 0),
        radiance=(radiance,) * 3,
    )
    camera = down_camera(view_m=metres, z=metres)
    recipe = RenderRecipe(path_samples=64, auxiliary_samples=4, max_depth=3, denoise=False)
    with tempfile.TemporaryDirectory() as folder:
        scene = SmallScene(parts={"floor": (floor, "grey")})
        one = renderer(Path(folder), scene, [camera], recipe, lights=(light,))
        buffers = one.render_view(0).buffers
    np.testing.assert_allclose(buffers["depth_z_m"], metres, rtol=1e-5)
    return buffers["beauty"].astype(np.float64)


def image_at_scales(cases: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Largest and median relative difference from the image of case (1, 1), by case (scale, radiance).

    The random numbers are the same, so differences are due to rounding; near the light's edge, one of a
    pixel's 64 paths may miss the light in one of the images only.
    """
    expected = lit_floor(1.0, 1.0)
    found = [np.abs(lit_floor(metres, radiance) / radiance / expected - 1) for metres, radiance in cases]
    return [(float(difference.max()), float(np.median(difference))) for difference in found]


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Markdown table with a title."""
    return f"**{title}**\n\n{markdown(header, (map(_text, row) for row in rows))}\n"


def _text(cell: object) -> str:
    return f"{cell:.3g}" if isinstance(cell, float) else str(cell)


def relative(got: NDArray | float, expected: float) -> str:
    """Relative error as text; "" if ``expected`` is 0 or beyond the range of half floats."""
    if not 0 < expected < 65519:
        return ""
    return f"{abs(float(got) - expected) / expected:.1e}"


def main() -> None:
    select_variant()
    scales = {factor: scale_of_scene(factor) for factor in SCALES}
    names = list(next(iter(scales.values())))
    rows = [[f"{f:g}", *(found[name] for name in names)] for f, found in scales.items()]
    print(table("Scale of the scene, against 1", ["metres to a metre", *names], rows))
    rows = [[f"{f:g}", scale_of_radiance(f)] for f in (*RADIANCES, 2.0**-20, 2.0**20)]
    print(table("Radiance, against 1", ["factor", "largest relative difference of a statistic"], rows))
    cases = [(f, 1.0) for f in (1e-3, 1e-2, 1e-1, 10.0, 1e2, 1e4)] + [
        (1.0, r) for r in (1e-6, 1e-3, 1e3, 1e5)
    ]
    found_images = zip(cases, image_at_scales(cases), strict=True)
    rows = [[f"{metres:g}", f"{radiance:g}", *errors] for (metres, radiance), errors in found_images]
    header = ["metres to a metre", "radiance", "largest relative difference", "median"]
    print(table("Rendering", header, rows))
    halves = [(value, stored_as_half(value)) for value in HALF_VALUES]
    rows = [[f"{v:g}", f"{stored:g}", relative(stored, v)] for v, stored in halves]
    print(table("Radiance in a file", ["value", "stored", "relative error"], rows))
    rows = [[kind.__name__, log_round_trip(kind)] for kind in (np.float64, np.float32)]
    print(table("Log encoding and back, [0, 1]", ["input", "largest error"], rows))
    rows = [[count, spread_of_alike_views(count)] for count in (1, 2, 12, 300)]
    print(table("Identical views", ["views", "largest (maximum - minimum) / own colour"], rows))


if __name__ == "__main__":
    main()
