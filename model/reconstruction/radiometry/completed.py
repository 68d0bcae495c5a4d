# SPDX-License-Identifier: MIT
"""Scales photographs to one exposure and estimates their clipped pixels.

The value of a clipped pixel is a lower bound. It is replaced by the median radiance of its surface over the
views in which the surface is not clipped. A surface that is clipped in all views is a source, whose radiance
is estimated from its illumination of other surfaces (``recovered``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.geometry.traced import TracedGeometry, smooth_regions
from datagen.geometry.views import TracedCapture, TracedView
from datagen.light.background import NEAR, photographed_background
from datagen.light.emitters import photographed_emitters
from datagen.light.surfels import Surfels, build_surfels
from datagen.light.unseen_surfaces import Regions
from model.reconstruction.radiometry.exposures import Radiometry, find_radiometry
from model.reconstruction.radiometry.recovered import Gatherer, SourceField, doubt_of, recovered
from model.reconstruction.radiometry.sources import Sources, find_sources, source_of_pixels
from model.reconstruction.stages import DoubtAt, Run

SOURCE_ROUNDS = 3
"""Number of estimates of the sources; each illuminates unphotographed surfaces for the next estimate."""


@dataclass(frozen=True)
class Completed:
    """Views at one exposure with estimated clipped pixels.

    ``radiometry`` is the cameras' calibration. ``sources`` are clipped in every view; ``radiance`` (S, 3) is
    their radiance, ``spread`` (S,) the standard deviation of its logarithm. ``clipped_share``: share of the
    pixels that are clipped; ``doubt_at``: see :data:`~model.reconstruction.stages.DoubtAt`.
    """

    views: list[TracedView]
    radiometry: Radiometry
    radiance: NDArray[np.float64]
    spread: NDArray[np.float64]
    clipped_share: float
    sources: Sources | None = None
    doubt_at: DoubtAt | None = None


def completed_views(
    views: Sequence[TracedView],
    traced: TracedGeometry,
    emits: NDArray[np.bool_],
    region_of_face: NDArray[np.int32],
    *,
    is_evened: bool = True,
) -> Completed:
    """Scale ``views`` to one exposure and estimate their clipped pixels.

    ``emits`` (M,): mask of triangles known to emit; ``region_of_face`` (M,): smooth region of each triangle;
    ``is_evened``: whether exposures are estimated. Raises ValueError if the views show no extended surface.
    """
    surfels = build_surfels(views)
    radiometry = find_radiometry(views, surfels) if is_evened else Radiometry(np.ones((len(views), 3)))
    found = list(views)
    if radiometry.changes:
        found = [radiometry.undone(view, index) for index, view in enumerate(views)]
        surfels = build_surfels(found)
    share = clipped_share(views)
    if not share:
        return Completed(found, radiometry, np.zeros((0, 3)), np.zeros(0), share)
    grid = surfels.grid
    emitters = photographed_emitters(found, traced, emits, region_of_face)
    background = photographed_background(found, grid.low, grid.high, NEAR)
    sources = find_sources(found, surfels, emitters, background, emits, region_of_face, traced)
    radiance, spread, doubt_at = sources.bound, np.zeros(len(sources)), None
    if len(sources):
        field = SourceField(traced.scene, surfels, emitters, background)
        gatherer = Gatherer(field, sources, Regions.of_mesh(traced.mesh, region_of_face))
        for _ in range(SOURCE_ROUNDS):
            estimate = recovered(gatherer.gathered(radiance), sources)
            radiance = estimate.radiance
        spread, doubt_at = estimate.spread, doubt_of(field, sources, estimate)
    for index, view in enumerate(found):
        if view.clipped_mask is None:
            continue
        source = source_of_pixels(view, sources, emitters, background, surfels.pixel_surfel[index])
        found[index] = _filled(view, source, radiance, surfels, surfels.pixel_surfel[index])
    return Completed(found, radiometry, radiance, spread, share, sources, doubt_at)


def clipped_share(views: Sequence[TracedView]) -> float:
    """Compute the share of the pixels of all photographs that are clipped in any channel."""
    masks = [view.clipped_mask for view in views if view.clipped_mask is not None]
    num_pixels = max(sum(view.valid_mask.size for view in views), 1)
    return sum(int(mask.any(axis=2).sum()) for mask in masks) / num_pixels


def _filled(
    view: TracedView, source: NDArray, radiance: NDArray, surfels: Surfels, surfel: NDArray
) -> TracedView:
    """Set the clipped pixels of a view to the radiance of their source or, without one, of their surfel."""
    assert view.clipped_mask is not None
    color, clipped = view.color.reshape(-1, 3).copy(), view.clipped_mask.reshape(-1, 3)
    pixel = np.flatnonzero(clipped.any(axis=1))
    estimate = color[pixel].astype(np.float64)
    on_surface = surfel[pixel] >= 0
    estimate[on_surface] = surfels.radiance[surfel[pixel][on_surface]]
    of_source = source[pixel] >= 0
    estimate[of_source] = radiance[source[pixel][of_source]]
    color[pixel] = np.where(clipped[pixel], np.maximum(color[pixel], estimate), color[pixel])
    return replace(view, color=color.reshape(view.color.shape).astype(np.float32))


def completed(traced: TracedCapture, run: Run) -> tuple[TracedCapture, DoubtAt | None]:
    """Scale the capture's views to one exposure and estimate clipped pixels; also return the uncertainty of
    the light (:data:`~model.reconstruction.stages.DoubtAt`), None without sources.

    The views are unchanged without clipping limits, as in renderings, or if they show no extended surface.
    """
    if any(view.limit is None for view in traced.views):
        return traced, None
    with run.stage("radiometry"):
        try:
            found = completed_views(
                traced.views,
                traced.geometry,
                traced.capture.geometry.emitter_mask(),
                smooth_regions(traced.geometry.mesh),
                is_evened=run.options.is_evened,
            )
        except ValueError as error:
            run.report.notes.append(f"exposures and clipped pixels are unchanged: {error}")
            return traced, None
    run.report.radiometry = described(found)
    run.report.notes += notes_of(found)
    return replace(traced, views=tuple(found.views)), found.doubt_at


def described(found: Completed) -> dict[str, Any]:
    """Return exposures and vignetting (in stops), response and recovered sources as data for the report."""
    stops = np.log2(found.radiometry.gain)
    return {
        "exposure_stops": [round(float(value), 3) for value in stops.mean(axis=1)],
        "balance_stops": round(float(np.sqrt((stops - stops.mean(axis=1, keepdims=True)).var())), 3),
        "vignetting_stops": round(found.radiometry.vignetting / float(np.log(2)), 3),
        "curve": round(found.radiometry.curve, 4),
        "clipped_share": round(found.clipped_share, 5),
        "sources": [
            {
                "radiance": [float(v) for v in radiance],
                "bound": [float(v) for v in bound],
                "spread": float(spread),
            }
            for radiance, bound, spread in zip(
                found.radiance, found.sources.bound if found.sources else (), found.spread, strict=True
            )
        ],
    }


def notes_of(found: Completed) -> list[str]:
    """Return messages for the user about equalised exposures and clipped pixels."""
    notes = []
    stops = np.log2(found.radiometry.gain).mean(axis=1)
    if found.radiometry.changes:
        low, high = float(stops.min()), float(stops.max())
        text = f"exposures that differ by {low:+.2f} to {high:+.2f} stops were equalised"
        if found.radiometry.vignetting:
            text += f", corners brightened by {found.radiometry.vignetting / np.log(2):.2f} stops"
        if found.radiometry.curve:
            text += ", and the response's deviation from sRGB was corrected"
        notes.append(text)
    if found.clipped_share > 0.001:
        text = f"{found.clipped_share:.1%} of the pixels are at the sensor's limit"
        num_uncertain = int((found.spread > 0.5).sum())
        if len(found.radiance):
            text += f"; the radiance of {len(found.radiance)} lamps, sunlit patches and parts of the sky "
            text += "is estimated from illuminated surfaces"
        if num_uncertain:
            text += f"; {num_uncertain} of them are uncertain: "
            text += "photograph lamps and more sky with a shorter exposure"
        notes.append(text)
    return notes
