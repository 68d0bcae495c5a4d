# SPDX-License-Identifier: GPL-3.0-or-later
"""Formats the fidelity report as one HTML page with embedded images. Uses no bpy."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..problems import Problem
from ..write import png_bytes, quantize, srgb_encoded

_DIFFERENCE_GAIN = 4.0
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem;
  color: #222; background: #fff; }
table { border-collapse: collapse; width: 100%; margin: 1rem 0 2rem; }
th, td { text-align: left; vertical-align: top; padding: .45rem .7rem; border-bottom: 1px solid #ddd; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
img { display: block; image-rendering: auto; }
.over { color: #a40000; font-weight: 600; }
.quiet { color: #666; }
"""


@dataclass(frozen=True)
class Comparison:
    """A material or light as rendered by Cycles and, if available, by Mitsuba: linear images (H, W, 3).

    ``detail``: text shown under the name; ``limit``: acceptable relative error.
    """

    name: str
    detail: str
    cycles: NDArray[np.float32]
    mitsuba: NDArray[np.float32] | None
    limit: float

    @property
    def relative_error(self) -> float:
        """Mean absolute difference divided by the mean radiance of Cycles' image."""
        assert self.mitsuba is not None
        return float(np.abs(self.mitsuba - self.cycles).mean() / max(float(self.cycles.mean()), 1e-9))

    @property
    def mean_ratio(self) -> float:
        """Mean radiance of Mitsuba's image divided by that of Cycles' image."""
        assert self.mitsuba is not None
        return float(self.mitsuba.mean() / max(float(self.cycles.mean()), 1e-9))


@dataclass(frozen=True)
class CameraCheck:
    """Largest distance [px] between projections of the same points in Blender and by the exported camera."""

    name: str
    error_px: float


def picture(comparison: Comparison) -> bytes:
    """PNG of Cycles' image and, if rendered, of Mitsuba's and 4 times the difference, side by side."""
    exposure = 0.8 / max(float(np.percentile(comparison.cycles, 95)), 1e-9)
    images = [comparison.cycles * exposure]
    if comparison.mitsuba is not None:
        images.append(comparison.mitsuba * exposure)
        images.append(np.abs(images[1] - images[0]) * _DIFFERENCE_GAIN)
    strip = np.concatenate(images, axis=1)
    return png_bytes(quantize(srgb_encoded(np.clip(strip, 0, 1)), 8))


def _image(comparison: Comparison) -> str:
    data = base64.b64encode(picture(comparison)).decode()
    alt = html.escape(f"{comparison.name}: original, exported, difference")
    return f'<img alt="{alt}" src="data:image/png;base64,{data}">'


def _rows(comparisons: Sequence[Comparison]) -> str:
    rows = []
    for entry in comparisons:
        if entry.mitsuba is None:
            numbers = '<td class="quiet" colspan="2">not rendered a second time</td>'
        else:
            error = entry.relative_error
            mark = "number over" if error > entry.limit else "number"
            numbers = f'<td class="{mark}">{error:.1%}</td><td class="number">{entry.mean_ratio:.3f}</td>'
        rows.append(
            f"<tr><td><b>{html.escape(entry.name)}</b><br>"
            f'<span class="quiet">{html.escape(entry.detail)}</span></td>'
            f"{numbers}<td>{_image(entry)}</td></tr>"
        )
    return "\n".join(rows)


def _table(title: str, comparisons: Sequence[Comparison], explanation: str) -> str:
    if not comparisons:
        return ""
    return (
        f"<h2>{title}</h2><p>{explanation}</p><table><tr><th>Name</th><th>Relative error</th>"
        f"<th>Mean ratio</th><th>Cycles, Mitsuba, difference &times; 4</th></tr>{_rows(comparisons)}</table>"
    )


def page(
    title: str,
    materials: Sequence[Comparison],
    lights: Sequence[Comparison],
    cameras: Sequence[CameraCheck],
    problems: Sequence[Problem],
    remark: str,
) -> str:
    """Format the page as HTML; ``remark`` is the sentence about Mitsuba's rendering or its failure."""
    listed = "".join(
        f"<tr><td>{problem.severity}</td><td>{html.escape(problem.place)}</td>"
        f"<td>{html.escape(problem.message)}</td><td>{html.escape(problem.remedy)}</td></tr>"
        for problem in problems
    )
    camera_rows = "".join(
        f'<tr><td>{html.escape(check.name)}</td><td class="number">{check.error_px:.4f} px</td></tr>'
        for check in cameras
    )
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}: fidelity</title>
<style>{_STYLE}</style></head><body>
<h1>{html.escape(title)}: fidelity of the export</h1>
<p>{html.escape(remark)}</p>
{
        _table(
            "Materials",
            materials,
            "The original graph in Cycles and the exported channels in Mitsuba, on a sphere"
            " and a plane under a sun and a uniform sky. Noise alone causes an error of about 3 %.",
        )
    }
{_table("Lights", lights, "A grey square lit by each light alone; a grey sphere lit by the world.")}
{
        "<h2>Cameras</h2><table><tr><th>Name</th><th>Largest reprojection error</th></tr>"
        + camera_rows
        + "</table>"
        if cameras
        else ""
    }
<h2>Approximations and notes</h2>
{
        "<table><tr><th>Kind</th><th>Where</th><th>What</th><th>Remedy</th></tr>" + listed + "</table>"
        if problems
        else "<p>Nothing.</p>"
    }
</body></html>
"""
