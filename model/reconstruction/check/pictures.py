# SPDX-License-Identifier: MIT
"""Draws contact sheets of a check: each photograph with the mesh's edges, its name and the result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import write_bytes_atomically
from datagen.foundation.color import luminance, srgb_from_linear
from datagen.foundation.images import encode_png
from model.reconstruction.check.views import CheckReport, ViewCheck

COLUMNS, ROWS = 4, 5
_TILE_PX, _LABEL_PX, _GAP_PX = 400, 42, 6
_FINE, _DOUBTFUL, _WRONG = (80, 255, 80), (255, 210, 60), (255, 70, 70)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def write_contact_sheets(
    out: Path, report: CheckReport, colors: Sequence[NDArray[np.float32]], edges: Sequence[NDArray[np.bool_]]
) -> list[Path]:
    """Write ``sheet-01.png`` etc. with all views, from linear ``colors`` (H, W, 3); return the paths.

    The masks ``edges`` (H, W) are drawn green if they fit, red if there is a warning, else yellow.
    """
    tiles = [
        _tile(view, color, lines) for view, color, lines in zip(report.views, colors, edges, strict=True)
    ]
    paths = []
    for number, first in enumerate(range(0, len(tiles), COLUMNS * ROWS), start=1):
        page = tiles[first : first + COLUMNS * ROWS]
        height = max(tile.shape[0] for tile in page)
        rows = -(-len(page) // COLUMNS)
        sheet = np.full((rows * (height + _GAP_PX), COLUMNS * (_TILE_PX + _GAP_PX), 3), 24, np.uint8)
        for index, tile in enumerate(page):
            top, left = index // COLUMNS * (height + _GAP_PX), index % COLUMNS * (_TILE_PX + _GAP_PX)
            sheet[top : top + tile.shape[0], left : left + _TILE_PX] = tile
        path = out / f"sheet-{number:02d}.png"
        write_bytes_atomically(path, encode_png(sheet))
        paths.append(path)
    return paths


def _tile(view: ViewCheck, color: NDArray[np.float32], edges: NDArray[np.bool_]) -> NDArray[np.uint8]:
    line = _WRONG if view.warnings else _FINE if view.is_judged else _DOUBTFUL
    level = max(float(np.quantile(luminance(color), 0.9)), 1e-6)
    shown = srgb_from_linear(np.clip(color * (0.6 / level), 0, 1))
    pixels = np.round(shown * 255).astype(np.uint8)
    height = max(1, round(_TILE_PX * color.shape[0] / color.shape[1]))
    pixels = cv2.resize(pixels, (_TILE_PX, height), interpolation=cv2.INTER_AREA)
    drawn = cv2.resize(edges.astype(np.float32), (_TILE_PX, height), interpolation=cv2.INTER_AREA)[..., None]
    cover = np.clip(drawn * 1.2, 0, 0.85)
    pixels = np.round(pixels * (1 - cover) + np.array(line) * cover).astype(np.uint8)
    label = np.full((_LABEL_PX, _TILE_PX, 3), 24, np.uint8)
    cv2.putText(label, view.name[:44], (4, 16), _FONT, 0.45, (235, 235, 235), 1, cv2.LINE_AA)
    cv2.putText(label, _verdict(view)[:60], (4, 34), _FONT, 0.4, line, 1, cv2.LINE_AA)
    return np.concatenate([pixels, label])


def _verdict(view: ViewCheck) -> str:
    if view.warnings:
        return view.warnings[0].removeprefix(f"{view.name}: ").split(";")[0]
    if view.edges is None:
        return "too few edges to compare"
    if not view.is_judged:
        return f"ambiguous edges ({view.edges.at_peak:.1f} sigma)"
    return f"fits: {view.edges.surely_px(view.edges.peak_px):.0f} px off, {view.edges.at_zero:.0f} sigma"
