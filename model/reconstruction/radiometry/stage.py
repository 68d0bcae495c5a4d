# SPDX-License-Identifier: MIT
"""The stage of ``materials infer`` that equalises exposures and estimates clipped pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from datagen.geometry.traced import smooth_regions
from datagen.geometry.views import TracedCapture
from model.reconstruction.radiometry.completed import Completed, completed_views
from model.reconstruction.stages import DoubtAt, Run


def completed(traced: TracedCapture, run: Run) -> tuple[TracedCapture, DoubtAt | None]:
    """The capture with its views at one exposure and clipped pixels completed, and the uncertainty of light.

    It is unchanged if an image has no clipping limit, as in renderings.
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
    """Return exposures, vignetting, response and recovered sources as data for the report."""
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
        unsure = int((found.spread > 0.5).sum())
        if len(found.radiance):
            text += f"; the radiance of {len(found.radiance)} lamps, sunlit patches and parts of the sky "
            text += "is estimated from illuminated surfaces"
        if unsure:
            text += f"; {unsure} of them are uncertain: photograph lamps and more sky with a shorter exposure"
        notes.append(text)
    return notes
