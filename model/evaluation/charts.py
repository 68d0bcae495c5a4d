# SPDX-License-Identifier: MIT
"""SVG charts of a suite: errors of maps and PSNR of re-renderings of all methods in all scenes, and errors of
the maps by quartile of confidence. Text is in CSS's currentColor, so charts follow the theme of a page.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from datagen.foundation.buffers import MATERIAL_MAPS
from model.evaluation.map_measures import QUARTERS
from model.evaluation.results import MethodResult, SuiteResult
from model.evaluation.tables import LETTERS, image_noise

GRID = "#dfe3e8"
"""Colour of the lines of charts."""
PSNR_DB = (10.0, 45.0)
"""Range of the panels of re-renderings; values outside are drawn at its ends."""
MSE = (1e-4, 1.0)
"""Range of the logarithmic panels of maps."""
RMSE = (5e-3, 1.0)
"""Range of the logarithmic axes of the confidence chart."""
_LABEL_PX, _PANEL_PX, _GAP_PX, _LINE_PX, _TOP_PX = 104, 148, 36, 9, 52
_LABEL_LINES_PX = 28  # height of the names of scene and camera
_INK = "#1d2127"
_TICKS = (0.01, 0.1, 1.0)  # of the confidence chart, like the sizes below
_AXES_PX, _AXES_HEIGHT_PX, _AXES_GAP_PX, _LEFT_PX, _AXES_TOP_PX, _BOTTOM_PX = 290, 140, 40, 34, 48, 26


def hue(index: int) -> str:
    """Colour of the method at ``index`` in charts."""
    hues = ("#2f6f8f", "#d08a2e", "#5a8f4e", "#8a5a9c", "#b5483f", "#7a7f87", "#3d9c94", "#c06c9a")
    return hues[index % len(hues)]


def _legend(labels: Sequence[str]) -> tuple[list[str], float]:
    """Elements of a legend in one line, and its width in pixels."""
    parts, x = [], 0.0
    for place, label in enumerate(labels):
        parts.append(f'<circle cx="{x + 5:.0f}" cy="9" r="4" fill="{hue(place)}"/>')
        parts.append(f'<text x="{x + 13:.0f}" y="13">{html.escape(label)}</text>')
        x += 26 + 6.2 * len(label)
    return parts, x


def _svg(width: int, height: int, title: str, parts: Sequence[str]) -> str:
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" font-family="system-ui, sans-serif" font-size="11" '
        f'fill="currentColor"><title>{title}</title>{"".join(parts)}</svg>'
    )


@dataclass(frozen=True)
class Mark:
    """Mark of a value and its standard error; filled for maps and input views, hollow for novel views."""

    value: float
    error: float = 0.0
    is_filled: bool = True


@dataclass(frozen=True)
class Panel:
    """A column of the chart. ``span``: range of values; ``marks`` returns a method's marks in a scene."""

    title: str
    span: tuple[float, float]
    ticks: tuple[float, ...]
    marks: Callable[[MethodResult], list[Mark]]
    is_log: bool = False

    def x(self, value: float) -> float:
        """Horizontal position in pixels in the panel, clipped to its range."""
        low, high = np.log10(self.span) if self.is_log else self.span
        number = np.log10(max(value, self.span[0])) if self.is_log else value
        return float(np.clip((number - low) / (high - low), 0, 1)) * _PANEL_PX


def _panels() -> list[Panel]:
    def of_map(name: str) -> Callable[[MethodResult], list[Mark]]:
        return lambda method: [Mark(method.maps_merged[name])] if name in method.maps_merged else []

    def of_light(chosen: str) -> Callable[[MethodResult], list[Mark]]:
        return lambda method: [
            Mark(found.mean, float(np.nan_to_num(found.error)), views == "input")
            for light, views, found in image_noise(method)
            if light == chosen
        ]

    maps = [
        Panel(f"{letter}, MSE", MSE, (1e-4, 1e-2, 1), of_map(name), is_log=True)
        for name, letter in zip(MATERIAL_MAPS, LETTERS.values(), strict=True)
    ]
    lights = [
        Panel(f"{light} light, dB", PSNR_DB, (10, 20, 30, 40), of_light(light))
        for light in ("own", "modified")
    ]
    return maps + lights


def overview_svg(result: SuiteResult) -> str:
    """SVG with a block per scene and camera, a line per method in each block, and a column per measure."""
    judged = [
        (scene.name, camera, [m.model_copy(update={"camera": ""}) for m in part.methods if not m.skipped])
        for scene in result.scenes
        for camera, part in scene.by_camera()
    ]
    labels = list(dict.fromkeys(m.label for _, _, methods in judged for m in methods))
    panels = _panels()
    width = _LABEL_PX + len(panels) * (_PANEL_PX + _GAP_PX)
    block = max(_LINE_PX * len(labels), _LABEL_LINES_PX) + 14
    height = _TOP_PX + block * len(judged) + 6
    parts, _ = _legend(labels)
    note = "filled: maps and input views; hollow: novel views; bars: standard errors"
    parts.append(f'<text x="{width - _GAP_PX}" y="13" text-anchor="end" opacity=".65">{note}</text>')
    for column, panel in enumerate(panels):
        left = _LABEL_PX + column * (_PANEL_PX + _GAP_PX)
        parts.append(f'<text x="{left}" y="34" font-weight="600">{panel.title}</text>')
        for tick in panel.ticks:
            x = left + panel.x(tick)
            parts.append(
                f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP_PX}" y2="{height - 6}" stroke="{GRID}"/>'
            )
            parts.append(
                f'<text x="{x:.1f}" y="{_TOP_PX - 4}" text-anchor="middle" opacity=".65">{tick:g}</text>'
            )
        for row, (_, _, methods) in enumerate(judged):
            for method in methods:
                place = labels.index(method.label)
                y = _TOP_PX + row * block + 12 + place * _LINE_PX
                parts += [_mark(mark, panel, left, y, hue(place)) for mark in panel.marks(method)]
    for row, (name, camera, _) in enumerate(judged):
        y = _TOP_PX + row * block
        parts.append(f'<line x1="0" x2="{width}" y1="{y}" y2="{y}" stroke="{GRID}"/>')
        parts.append(f'<text x="0" y="{y + block / 2 + 4}" font-weight="600">{html.escape(name)}</text>')
        parts.append(f'<text x="0" y="{y + block / 2 + 18}" opacity=".65">{html.escape(camera)}</text>')
    return _svg(
        width, height, "Errors of maps and PSNR of re-renderings of every method in every scene", parts
    )


def standalone(svg: str) -> str:
    """The chart as text of a standalone SVG file with a white background."""
    head, rest = svg.split(">", 1)
    namespace = 'xmlns="http://www.w3.org/2000/svg"'
    return f'{head} {namespace} color="{_INK}"><rect width="100%" height="100%" fill="#fff"/>{rest}\n'


def _mark(mark: Mark, panel: Panel, left: float, y: float, color: str) -> str:
    x = left + panel.x(mark.value)
    low, high = (left + panel.x(mark.value + sign * mark.error) for sign in (-1, 1))
    bar = f'<line x1="{low:.1f}" x2="{high:.1f}" y1="{y}" y2="{y}" stroke="{color}"/>' if mark.error else ""
    fill = color if mark.is_filled else "none"
    return f'{bar}<circle cx="{x:.1f}" cy="{y}" r="3.2" fill="{fill}" stroke="{color}" stroke-width="1.4"/>'


def confidence_svg(result: SuiteResult) -> str:
    """SVG with a panel per map and a line per scene and method; '' if no method outputs a confidence."""
    lines = [
        (f"{scene.name}, {method.label}", method.calibration)
        for scene in result.scenes
        for method in scene.methods
        if method.calibration
    ]
    if not lines:
        return ""
    width = _LEFT_PX + len(MATERIAL_MAPS) * (_AXES_PX + _AXES_GAP_PX)
    height = _AXES_TOP_PX + _AXES_HEIGHT_PX + _BOTTOM_PX
    parts, legend_px = _legend([label for label, _ in lines])
    for column, (name, letter) in enumerate(zip(MATERIAL_MAPS, LETTERS.values(), strict=True)):
        left = _LEFT_PX + column * (_AXES_PX + _AXES_GAP_PX)
        parts += _axes(left, f"RMSE of {letter}")
        for place, (_, calibration) in enumerate(lines):
            parts += _line(left, calibration[name][1:], hue(place))
    title = "Errors of the maps by quarter of the pixels in order of confidence"
    return _svg(max(width, int(legend_px)), height, title, parts)


def _y(rmse: float) -> float:
    low, high = np.log10(RMSE)
    share = (np.log10(np.clip(rmse, *RMSE)) - low) / (high - low)
    return float(_AXES_TOP_PX + _AXES_HEIGHT_PX * (1 - share))


def _x(left: float, quarter: int) -> float:
    return left + _AXES_PX * (quarter + 0.5) / QUARTERS


def _axes(left: float, title: str) -> list[str]:
    parts = [f'<text x="{left}" y="{_AXES_TOP_PX - 10}" font-weight="600">{title}</text>']
    for tick in _TICKS:
        y = _y(tick)
        ends = f'x1="{left}" x2="{left + _AXES_PX}" y1="{y:.1f}" y2="{y:.1f}"'
        parts.append(f'<line {ends} stroke="{GRID}"/>')
        parts.append(f'<text x="{left - 4}" y="{y + 4:.1f}" text-anchor="end" opacity=".65">{tick:g}</text>')
    for x, anchor, label in (
        (left, "start", "least confident"),
        (left + _AXES_PX, "end", "most confident"),
    ):
        place = f'x="{x}" y="{_AXES_TOP_PX + _AXES_HEIGHT_PX + 16}" text-anchor="{anchor}"'
        parts.append(f'<text {place} opacity=".65">{label}</text>')
    return parts


def _line(left: float, rmse: Sequence[float], color: str) -> list[str]:
    points = [(_x(left, quarter), _y(value)) for quarter, value in enumerate(rmse)]
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dots = [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{color}"/>' for x, y in points]
    return [f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.6"/>', *dots]
