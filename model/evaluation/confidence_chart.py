# SPDX-License-Identifier: MIT
"""Reliability diagram: errors of the maps by quarter of confidence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datagen.foundation.buffers import MATERIAL_MAPS
from model.evaluation.map_measures import QUARTERS
from model.evaluation.page_style import GRID, hue, legend
from model.evaluation.results import SuiteResult
from model.evaluation.tables import LETTERS

RMSE = (5e-3, 1.0)
"""Range of the logarithmic axis; values outside are drawn at its ends."""
_TICKS = (0.01, 0.1, 1.0)
_PANEL_PX, _HEIGHT_PX, _GAP_PX, _LEFT_PX, _TOP_PX, _BOTTOM_PX = 290, 140, 40, 34, 48, 26


def confidence_svg(result: SuiteResult) -> str:
    """SVG with a panel per map and a line per scene and method; '' if no method states its confidence.

    Text is in the current colour, so the chart follows the theme of a page that embeds it.
    """
    lines = [
        (f"{scene.name}, {method.label}", method.calibration)
        for scene in result.scenes
        for method in scene.methods
        if method.calibration
    ]
    if not lines:
        return ""
    width = _LEFT_PX + len(MATERIAL_MAPS) * (_PANEL_PX + _GAP_PX)
    height = _TOP_PX + _HEIGHT_PX + _BOTTOM_PX
    parts, legend_px = legend([label for label, _ in lines])
    for column, (name, letter) in enumerate(zip(MATERIAL_MAPS, LETTERS.values(), strict=True)):
        left = _LEFT_PX + column * (_PANEL_PX + _GAP_PX)
        parts += _axes(left, f"RMSE of {letter}")
        for place, (_, calibration) in enumerate(lines):
            parts += _line(left, calibration[name][1:], hue(place))
    width = max(width, int(legend_px))
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" font-family="system-ui, sans-serif" font-size="11" '
        'fill="currentColor"><title>Errors of the maps by quarter of the pixels in order of confidence'
        f"</title>{''.join(parts)}</svg>"
    )


def _y(rmse: float) -> float:
    low, high = np.log10(RMSE)
    share = (np.log10(np.clip(rmse, *RMSE)) - low) / (high - low)
    return float(_TOP_PX + _HEIGHT_PX * (1 - share))


def _x(left: float, quarter: int) -> float:
    return left + _PANEL_PX * (quarter + 0.5) / QUARTERS


def _axes(left: float, title: str) -> list[str]:
    parts = [f'<text x="{left}" y="{_TOP_PX - 10}" font-weight="600">{title}</text>']
    for tick in _TICKS:
        y = _y(tick)
        ends = f'x1="{left}" x2="{left + _PANEL_PX}" y1="{y:.1f}" y2="{y:.1f}"'
        parts.append(f'<line {ends} stroke="{GRID}"/>')
        parts.append(f'<text x="{left - 4}" y="{y + 4:.1f}" text-anchor="end" opacity=".65">{tick:g}</text>')
    for x, anchor, label in (
        (left, "start", "least confident"),
        (left + _PANEL_PX, "end", "most confident"),
    ):
        place = f'x="{x}" y="{_TOP_PX + _HEIGHT_PX + 16}" text-anchor="{anchor}"'
        parts.append(f'<text {place} opacity=".65">{label}</text>')
    return parts


def _line(left: float, rmse: Sequence[float], color: str) -> list[str]:
    points = [(_x(left, quarter), _y(value)) for quarter, value in enumerate(rmse)]
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dots = [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{color}"/>' for x, y in points]
    return [f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.6"/>', *dots]
