# SPDX-License-Identifier: MIT
"""Chart of all methods in all scenes: errors of the merged maps, and PSNR of re-renderings."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from datagen.foundation.buffers import MATERIAL_MAPS
from model.evaluation.measure_tables import image_noise
from model.evaluation.page_style import GRID, hue, legend
from model.evaluation.results import MethodResult, SuiteResult
from model.evaluation.tables import LETTERS

PSNR_DB = (10.0, 45.0)
"""Range of the panels of re-renderings; values outside are drawn at its ends."""
MSE = (1e-4, 1.0)
"""Range of the logarithmic panels of maps."""
_LABEL_PX, _PANEL_PX, _GAP_PX, _LINE_PX, _TOP_PX = 104, 148, 36, 9, 52
_LABEL_LINES_PX = 28  # name of the scene and of the camera
_INK = "#1d2127"


@dataclass(frozen=True)
class Mark:
    """A value with its standard error; ``is_filled`` for input views and maps, not for novel views."""

    value: float
    error: float = 0.0
    is_filled: bool = True


@dataclass(frozen=True)
class Panel:
    """A column of the chart. ``marks`` returns the marks of a method in a scene."""

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
    """SVG with a block per scene and camera, in it a line per method, and a column per measure.

    Text is in the current colour, so the chart follows the theme of a page that embeds it.
    """
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
    parts = _legend(labels, width)
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
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" '
        'font-family="system-ui, sans-serif" font-size="11" fill="currentColor"><title>Errors of maps and '
        f"PSNR of re-renderings of every method in every scene</title>{''.join(parts)}</svg>"
    )


def standalone(svg: str) -> str:
    """The chart as a file of its own, on white."""
    head, rest = svg.split(">", 1)
    namespace = 'xmlns="http://www.w3.org/2000/svg"'
    return f'{head} {namespace} color="{_INK}"><rect width="100%" height="100%" fill="#fff"/>{rest}\n'


def _legend(labels: Sequence[str], width: int) -> list[str]:
    parts, _ = legend(labels)
    note = "filled: maps and input views; hollow: novel views; bars: standard errors"
    parts.append(f'<text x="{width - _GAP_PX}" y="13" text-anchor="end" opacity=".65">{note}</text>')
    return parts


def _mark(mark: Mark, panel: Panel, left: float, y: float, color: str) -> str:
    x = left + panel.x(mark.value)
    low, high = (left + panel.x(mark.value + sign * mark.error) for sign in (-1, 1))
    bar = f'<line x1="{low:.1f}" x2="{high:.1f}" y1="{y}" y2="{y}" stroke="{color}"/>' if mark.error else ""
    fill = color if mark.is_filled else "none"
    return f'{bar}<circle cx="{x:.1f}" cy="{y}" r="3.2" fill="{fill}" stroke="{color}" stroke-width="1.4"/>'
