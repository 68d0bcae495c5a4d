# SPDX-License-Identifier: MIT
"""Pictures of a scene in rows, for the page and for the figure of relighting and object insertion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.foundation.color import srgb_from_linear
from datagen.foundation.exr import decode_view
from model.evaluation.metrics import shown
from model.evaluation.rendering import BUFFERS, JudgedView, judged_view
from model.evaluation.results import MethodResult, SceneResult
from model.evaluation.tables import LETTERS

TRUTH = "truth"
MAX_WIDTH_PX = 320
_GAP_PX, _LABEL_PX, _LEFT_PX = 4, 22, 110
_INK = (40, 40, 40)


@dataclass(frozen=True)
class Picture:
    """An image of 8-bit sRGB pixels (H, W, 3), and its title."""

    title: str
    pixels: NDArray[np.uint8]


@dataclass(frozen=True)
class Row:
    """Pictures, by column, of the truth or of a method; a missing picture is None."""

    label: str
    pictures: dict[str, Picture | None]


COLUMNS = (
    "D",
    "S",
    "R",
    "original light",
    "modified light",
    "recovered light",
    "inserted object",
    "novel view",
    "novel view, modified light",
)
RELIGHTING = ("original light", "modified light", "inserted object", "novel view")
"""Rows of the figure of relighting and object insertion."""


def scene_rows(scene: SceneResult, stored: dict[str, JudgedView]) -> list[Row]:
    """Rows of the truth and of each method; ``stored``: true views under the scene's own light, by name."""
    truth = {light: _views(Path(folder)) for light, folder in scene.renders.items()}
    truth["own"] = stored
    if "recovered" in scene.exposures:
        truth["recovered"] = stored
    rows = [_row(TRUTH, scene, truth)]
    for method in scene.methods:
        if not method.skipped and method.kind != "truth":
            renders = {light: _views(Path(folder)) for light, folder in method.renders.items()}
            rows.append(_row(method.label, scene, renders))
    return rows


def rendered_views(method: MethodResult) -> dict[str, JudgedView]:
    """A method's rendered views under the scene's own light, by name; empty if there are none."""
    return _views(Path(method.renders["own"])) if "own" in method.renders else {}


def _views(folder: Path) -> dict[str, JudgedView]:
    return {path.stem: judged_view(decode_view(path, BUFFERS)) for path in sorted(folder.glob("*.exr"))}


def _row(label: str, scene: SceneResult, by_light: dict[str, dict[str, JudgedView]]) -> Row:
    view, novel = scene.figure_views["input"], scene.figure_views.get("novel", "")
    pictures: dict[str, Picture | None] = dict.fromkeys(COLUMNS)
    own = by_light.get("own", {})
    if view in own:
        for name, letter in LETTERS.items():
            pictures[letter] = Picture(letter, small(map_pixels(own[view], name)))
    sources = {
        "original light": ("own", view),
        "modified light": ("modified", view),
        "recovered light": ("recovered", view),
        "inserted object": ("inserted", view),
        "novel view": ("own", novel),
        "novel view, modified light": ("modified", novel),
    }
    for title, (light, name) in sources.items():
        found = by_light.get(light, {}).get(name)
        if found is not None:
            pixels = shown(found.color, scene.exposures[light])
            pictures[title] = Picture(f"{label}: {title}", small(pixels))
    return Row(label, pictures)


def map_pixels(view: JudgedView, name: str) -> NDArray[np.float64]:
    """The map ``name`` of a view as an image (H, W, 3): D and S in sRGB, R linear; black off surfaces."""
    values = view.maps[name]
    encoded = srgb_from_linear(values) if name != "roughness" else values
    pixels = np.where(view.surface_mask[..., None], encoded, 0.0)
    return np.broadcast_to(pixels, (*pixels.shape[:2], 3))


def small(pixels: NDArray, max_width_px: int = MAX_WIDTH_PX) -> NDArray[np.uint8]:
    """Convert an image (H, W, 3) in [0, 1] to 8 bits, reduced to at most ``max_width_px`` in width."""
    height, width = pixels.shape[:2]
    pixels = np.ascontiguousarray(pixels, np.float32)
    if width > max_width_px:
        size = (max_width_px, max(1, round(height * max_width_px / width)))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
    return (np.clip(pixels, 0, 1) * 255 + 0.5).astype(np.uint8)


def sheet(rows: list[Row], columns: tuple[str, ...], *, is_turned: bool) -> NDArray[np.uint8]:
    """Sheet (H, W, 3) of labelled pictures, with a line per row or, if ``is_turned``, per column."""
    table = [[row.pictures[column] for column in columns] for row in rows]
    across, down = list(columns), [row.label for row in rows]
    if is_turned:
        table = [list(line) for line in zip(*table, strict=True)]
        across, down = down, across
    sizes = [p.pixels.shape[:2] for line in table for p in line if p is not None]
    height, width = max(s[0] for s in sizes), max(s[1] for s in sizes)
    zoom = max(1, 240 // width)  # enlarges very small views by repeating pixels
    height, width = height * zoom, width * zoom
    canvas = np.full(
        (_LABEL_PX + len(down) * (height + _GAP_PX), _LEFT_PX + len(across) * (width + _GAP_PX), 3),
        255,
        np.uint8,
    )
    for c, text in enumerate(across):
        _write(canvas, text, (_LEFT_PX + c * (width + _GAP_PX), 15), width)
    for r, text in enumerate(down):
        top = _LABEL_PX + r * (height + _GAP_PX)
        _write(canvas, text, (4, top + height // 2), _LEFT_PX - 8)
        for c, picture in enumerate(table[r]):
            left = _LEFT_PX + c * (width + _GAP_PX)
            if picture is None:
                _write(canvas, "none", (left + 4, top + height // 2), width)
                continue
            pixels = picture.pixels.repeat(zoom, 0).repeat(zoom, 1)
            canvas[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels
    return canvas


def _write(canvas: NDArray[np.uint8], text: str, at: tuple[int, int], width: int) -> None:
    """Draw ``text`` at ``at`` (x, y) on a ``canvas`` (H, W, 3), reduced to at most ``width`` pixels."""
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.45
    (needed, _), _ = cv2.getTextSize(text, font, scale, 1)
    if needed > width:
        scale *= width / needed
    cv2.putText(canvas, text, at, font, scale, _INK, 1, cv2.LINE_AA)
