# SPDX-License-Identifier: MIT
"""Pure functions that check a view's buffers, arrays (H, W, C) by name, and return faults.

``where`` names the view in faults. The functions never raise on invalid pixels. Their limits accept every
sound dataset and reject pixels that would impair training.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from datagen.formats.configuration import GLOSSY_ROUGHNESS, METAL_SPECULAR
from datagen.foundation.buffers import BUFFERS
from datagen.foundation.cameras import Camera
from datagen.foundation.color import luminance
from datagen.inspection.findings import Fault, Severity

RANGE_TOLERANCE = 2e-3  # adjacent half floats below 1 differ by 5e-4, and averages are rounded
UNIT_TOLERANCE = 5e-3  # three half floats, each rounded by up to 2.5e-4
MAX_SHARE_OF_BAD_NORMALS = 1e-3  # opposite sides of a thin sheet may cancel within a pixel
FIREFLY_FACTOR, FIREFLY_MAX_SIZE = 20.0, 4
MAX_FIREFLIES, MAX_SHARE_OF_FIREFLIES = 4, 2e-4
BLACK_LUMINANCE, BLACK_EXPOSED, OVEREXPOSED = 1e-5, 0.01, 4.0
MAX_SHARE_CLIPPED = 0.01
_HALF_MAX = 65504.0
MIN_ROUGHNESS_PIXELS, MIN_ROUGHNESS_RANGE = 500, 2e-3
SOLID_COVERAGE = 0.999  # minimum surface coverage of pixels without lamp, opening or background


View = Mapping[str, NDArray]


def _first(mask: NDArray) -> str:
    row, column = np.argwhere(mask)[0][:2]
    return f"first at row {row}, column {column}"


def check_buffers(view: View, expected: Sequence[str], camera: Camera, where: str) -> Iterator[Fault]:
    """Find expected buffers that are missing, and buffers whose shape does not fit the camera."""
    yield from (Fault("buffer", where, f"no {name}", "this buffer") for name in expected if name not in view)
    for name, array in view.items():
        shape = (camera.height_px, camera.width_px, BUFFERS[name].num_channels)
        if array.shape != shape:
            yield Fault("buffer", where, f"{name} of shape {array.shape}", f"{shape}")


def check_finite(view: View, where: str) -> Iterator[Fault]:
    """Find NaN and infinity in any floating-point buffer."""
    for name, array in view.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            bad = ~np.isfinite(array).all(axis=-1)
            got = f"{int(bad.sum())} pixels of {name} are NaN or Inf, {_first(bad)}"
            yield Fault("finite", where, got, "finite values")


def check_range(view: View, where: str) -> Iterator[Fault]:
    """Find finite values outside the range of their buffer in ``BUFFERS``."""
    for name, array in view.items():
        buffer = BUFFERS[name]
        if array.dtype.kind != "f":
            continue
        with np.errstate(invalid="ignore"):
            bad = (array < buffer.minimum - RANGE_TOLERANCE) | (array > buffer.maximum + RANGE_TOLERANCE)
        bad &= np.isfinite(array)
        if bad.any():
            low, high = float(array[bad].min()), float(array[bad].max())
            pixels = bad.any(axis=-1)
            got = f"{int(pixels.sum())} pixels of {name} are {low:.4g} to {high:.4g}, {_first(pixels)}"
            yield Fault("range", where, got, f"[{buffer.minimum:g}, {buffer.maximum:g}]")


def check_normals(view: View, where: str) -> list[Fault]:
    """Find surface pixels whose normal does not have unit length."""
    surface = view["surface_mask"][..., 0] > 0
    normal = view["normal_world"].astype(np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        bad = surface & (np.abs(np.linalg.norm(normal, axis=-1) - 1) > UNIT_TOLERANCE)
    if not bad.any():
        return []
    severity: Severity = "error" if bad.sum() > MAX_SHARE_OF_BAD_NORMALS * surface.sum() else "warning"
    lengths = np.linalg.norm(normal[bad], axis=-1)
    got = f"{int(bad.sum())} pixels with normals of length {lengths.min():.3g} to {lengths.max():.3g}"
    return [Fault("normal", where, f"{got}, {_first(bad)}", "length 1", severity)]


def firefly_mask(view: View) -> NDArray[np.bool_]:
    """Mask (H, W) of isolated pixels 20 times as bright as the medians of their 5x5 window and of the frame.

    A firefly has at most 4 pixels, none within 2 pixels of lamps, openings or background.
    """
    import cv2

    light = luminance(np.nan_to_num(view["beauty"].astype(np.float32), posinf=_HALF_MAX))
    surroundings = cv2.medianBlur(np.ascontiguousarray(light), 5)
    is_bright = light > FIREFLY_FACTOR * np.maximum(surroundings, max(float(np.median(light)), 1e-6))
    num_near = cv2.boxFilter(is_bright.astype(np.float32), -1, (5, 5), normalize=False)
    if "surface_mask" in view:  # lamps, windows and adjacent pixels may be this bright
        other = (np.nan_to_num(view["surface_mask"][..., 0]) < SOLID_COVERAGE).astype(np.uint8)
        is_bright &= cv2.dilate(other, np.ones((5, 5), np.uint8)) == 0
    return is_bright & (num_near <= FIREFLY_MAX_SIZE + 0.5)


def _shows_highlights(view: View) -> NDArray[np.bool_]:
    """Mask (H, W) of metal and glossy pixels; all False without the buffers of S and R."""
    if not {"specular_albedo", "roughness"} <= view.keys():
        return np.zeros(view["beauty"].shape[:2], bool)
    is_metal = view["specular_albedo"].max(axis=-1) > METAL_SPECULAR
    return is_metal | (view["roughness"][..., 0] < GLOSSY_ROUGHNESS)


def check_fireflies(view: View, where: str) -> list[Fault]:
    """Report fireflies: an error if too many; else a warning, but none if all are on metal or gloss."""
    mask = firefly_mask(view)
    count = int(mask.sum())
    limit = max(MAX_FIREFLIES, MAX_SHARE_OF_FIREFLIES * mask.size)
    if count == 0 or (count <= limit and _shows_highlights(view)[mask].all()):
        return []
    peak = float(luminance(view["beauty"][mask].astype(np.float32)).max())
    noun = "firefly" if count == 1 else "fireflies"
    got = f"{count} {noun} of luminance up to {peak:.4g}, {_first(mask)}"
    expected = f"none; up to {limit:.0f} may be highlights"
    return [Fault("firefly", where, got, expected, "error" if count > limit else "warning")]


def check_exposure(view: View, exposure: float, where: str) -> list[Fault]:
    """Report a view that is black, flat or overexposed at the configuration's median ``exposure`` factor."""
    light = luminance(np.nan_to_num(view["beauty"].astype(np.float32), posinf=_HALF_MAX))
    bright, middle = np.percentile(light, [95, 50])
    expected = "a visible scene"
    if bright < BLACK_LUMINANCE or bright * exposure < BLACK_EXPOSED:
        got = f"black: 95 % of the luminance is below {bright:.3g}, {bright * exposure:.3g} when exposed"
        return [Fault("exposure", where, got, expected)]
    if light.std() < 1e-4 * bright:
        return [Fault("exposure", where, f"flat: luminance is {middle:.4g} everywhere", expected)]
    clipped = float((view["beauty"].max(axis=-1) >= _HALF_MAX).mean())
    if clipped > MAX_SHARE_CLIPPED:
        got = f"overexposed: {clipped:.1%} of the pixels are clipped to the largest half float"
        return [Fault("exposure", where, got, f"at most {MAX_SHARE_CLIPPED:.0%}")]
    if middle * exposure > OVEREXPOSED:
        got = f"overexposed: half of the frame is above {middle * exposure:.3g} at the other views' exposure"
        return [Fault("exposure", where, got, f"at most {OVEREXPOSED:g}")]
    return []


def check_statistics(view: View, max_views: int, has_own: bool, where: str) -> Iterator[Fault]:
    """Find statistics out of order, wrong counts, and wrong statistics of pixels with count 0.

    Counts must be 0 on background, at most ``max_views``, and, if ``has_own`` (the statistics of a pixel
    include the pixel itself), above 0 on surfaces. With count 0, the statistics must be the pixel's colour.
    """
    low, middle, high = (view[f"color_{n}"].astype(np.float32) for n in ("min", "median", "max"))
    count = view["observation_count"][..., 0]
    own = view["beauty"].astype(np.float32)
    with np.errstate(invalid="ignore"):
        is_surface = (view["depth_z_m"][..., 0] > 0) & (view["surface_mask"][..., 0] >= 0.5)
        is_empty = view["depth_z_m"][..., 0] == 0
        differs = (np.abs(low - own) + np.abs(high - own)).max(axis=-1) > 1e-3 * np.abs(own).max(axis=-1)
        disorder = ((low > middle) | (middle > high)).any(axis=-1)
        masks = (
            (disorder, "out of order", "min <= median <= max"),
            (has_own & is_surface & ~(count > 0), "of surface with count 0", "at least the view itself"),
            (is_empty & (count > 0), "of background with a count", "count 0"),
            (count > max_views, f"with a count over {max_views}", f"at most {max_views}"),
            ((count == 0) & differs, "without observations differ from their own colour", "their own colour"),
        )
    for bad, what, expected in masks:
        if bad.any():
            yield Fault("statistics", where, f"{int(bad.sum())} pixels {what}, {_first(bad)}", expected)


def roughness_ranges(view: View) -> dict[int, tuple[int, float, float]]:
    """Number of pixels, minimum and maximum of R by material id, over pixels fully covered by surface."""
    ids = view["material_id"][..., 0]
    rough = view["roughness"][..., 0].astype(np.float32)
    is_solid = (view["surface_mask"][..., 0] >= SOLID_COVERAGE) & np.isfinite(rough) & (ids > 0)
    ranges = {}
    for material in np.unique(ids[is_solid]):
        values = rough[is_solid & (ids == material)]
        ranges[int(material)] = (len(values), float(values.min()), float(values.max()))
    return ranges


def check_roughness(
    ranges: Mapping[int, Sequence[tuple[int, float, float]]],
    names: Mapping[str, str],
    textured: Mapping[str, float],
    where: str,
) -> Iterator[Fault]:
    """Find materials whose roughness is constant in the views although their texture varies.

    ``ranges`` maps ids to results of :func:`roughness_ranges`, one per view, ``names`` ids (as text) to
    material names, ``textured`` names to the range (maximum - minimum) of their texture. Materials with few
    pixels, or with a nearly constant texture, are ignored.
    """
    for material, found in sorted(ranges.items()):
        counts, lows, highs = zip(*found, strict=True)
        count, low, high = sum(counts), min(lows), max(highs)
        name = names.get(str(material), "").partition("#")[0]
        expected = textured.get(name, 0.0)
        is_shown = count >= MIN_ROUGHNESS_PIXELS and expected > 10 * MIN_ROUGHNESS_RANGE
        if is_shown and high - low < MIN_ROUGHNESS_RANGE:
            got = f"roughness of {name} is {low:.4g} on all {count} pixels"
            yield Fault("roughness", where, got, f"values that vary by {expected:.2g}")
