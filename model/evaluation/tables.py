# SPDX-License-Identifier: MIT
"""Tables of a suite's figures: errors of maps and re-renderings, time and memory."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Iterable
from dataclasses import dataclass

from datagen.foundation.buffers import MATERIAL_MAPS
from model.evaluation.published import PUBLISHED
from model.evaluation.results import MethodResult, SceneResult, SuiteResult

Cell = str | float | None
LETTERS = dict(zip(MATERIAL_MAPS, "DSR", strict=True))
PAPER = "paper: "
LIGHTS = ("own", "modified", "recovered")
"""Lights in the order of the tables: the scene's own, the modified, and those recovered by a method."""
VIEW_SETS = ("input", "novel")
MAP_STAGES = {"per_view": "per view", "merged": "merged"}
"""Title of each stage of maps."""
_SHOWN = {"psnr_srgb_db": "PSNR sRGB (dB)", "dssim": "DSSIM = 1-SSIM", "lpips_vgg": "LPIPS-VGG"}
_ALL = {
    "psnr_srgb_db": "PSNR, clipped sRGB, range 1 (dB)",
    "psnr_linear_db": "PSNR, clipped linear (dB)",
    "ssim": "SSIM, Gaussian 11x11 sigma 1.5",
    "dssim": "DSSIM = 1-SSIM",
    "lpips_vgg": "LPIPS-VGG 0.1",
    "gain": "fitted gain",
    "psnr_gain_db": "PSNR, clipped sRGB, with the gain (dB)",
    "dssim_gain": "DSSIM = 1-SSIM, with the gain",
}


@dataclass(frozen=True)
class Table:
    """A table whose ``rows`` have a cell per column, None if empty; ``digits`` are decimals by column."""

    name: str
    title: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    digits: tuple[int, ...]

    def texts(self) -> list[list[str]]:
        """Rows as text, with numbers rounded to ``digits``."""
        return [
            [_text(cell, digits) for cell, digits in zip(row, self.digits, strict=True)] for row in self.rows
        ]

    def markdown(self) -> str:
        """Heading, caption and table in Markdown."""
        lines = [f"## {self.title}", "", self.caption, "", _line(self.columns)]
        lines.append(_line("---" if k < 2 else "---:" for k in range(len(self.columns))))
        lines += [_line(row) for row in self.texts()]
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """Header and rows in CSV, with all digits."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(["" if cell is None else cell for cell in row] for row in self.rows)
        return stream.getvalue()

    def html(self) -> str:
        head = "".join(f"<th>{html.escape(column)}</th>" for column in self.columns)
        body = "".join(
            f"<tr{' class=paper' if row[1].startswith(PAPER) else ''}>"
            + "".join(f"<td>{html.escape(cell)}</td>" for cell in row)
            + "</tr>"
            for row in self.texts()
        )
        caption = html.escape(self.caption)
        return (
            f"<h2>{html.escape(self.title)}</h2><p>{caption}</p><div class=wide><table><thead><tr>{head}</tr>"
            f"</thead><tbody>{body}</tbody></table></div>"
        )


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _text(cell: Cell, digits: int) -> str:
    if cell is None:
        return ""
    return cell if isinstance(cell, str) else f"{cell:.{digits}f}"


def tables_of(result: SuiteResult) -> list[Table]:
    """Tables of a suite's maps, re-renderings and cost; :func:`measure_tables` returns the others."""
    return [_maps_table(result), _summary_table(result), _images_table(result), _cost_table(result)]


def _measured(scene: SceneResult) -> list[MethodResult]:
    return [method for method in scene.methods if not method.skipped]


def _maps_table(result: SuiteResult) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scene in result.scenes:
        for method in _measured(scene):
            per_view = [method.maps_per_view.get(name) for name in MATERIAL_MAPS]
            merged = [method.maps_merged.get(name) for name in MATERIAL_MAPS]
            shares = _percent(method.covered_share), _percent(method.seen_share)
            rows.append((scene.name, method.label, *per_view, *merged, *shares))
        for row in PUBLISHED[scene.name].maps if scene.name in PUBLISHED else ():
            nothing = (None,) * len(MATERIAL_MAPS)
            cells = (*nothing, *row.mse) if row.is_merged else (*row.mse, *nothing)
            rows.append((scene.name, PAPER + row.method, *cells, None, None))
    columns = (
        "scene",
        "method",
        *(f"{LETTERS[name]} per view (MSE, linear)" for name in MATERIAL_MAPS),
        *(f"{LETTERS[name]} merged (MSE, linear)" for name in MATERIAL_MAPS),
        "pixels covered (%)",
        "atlas seen (%)",
    )
    caption = (
        "D diffuse albedo, S specular albedo (F0), R roughness. Mean squared error of linear values over "
        "surface pixels and channels of the judged input views. Per view: the maps as predicted (the paper's "
        "Ours Im.). Merged: the atlas, rendered in the views."
    )
    return Table("maps", "Material maps", caption, columns, tuple(rows), (0, 0, 4, 4, 4, 4, 4, 4, 1, 1))


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


def _summary_table(result: SuiteResult) -> Table:
    """Table with one row per method: PSNR and DSSIM by light and set of views."""
    columns = ["scene", "method"]
    digits = [0, 0]
    for light in LIGHTS:
        for views in VIEW_SETS:
            columns += [f"{light} light, {views} views: {_SHOWN[key]}" for key in ("psnr_srgb_db", "dssim")]
            digits += [2, 3]
    rows: list[tuple[Cell, ...]] = []
    for scene in result.scenes:
        for method in _measured(scene):
            cells = [
                method.images.get(light, {}).get(views, {}).get(key)
                for light in LIGHTS
                for views in VIEW_SETS
                for key in ("psnr_srgb_db", "dssim")
            ]
            rows.append((scene.name, method.label, *cells))
        if scene.name in PUBLISHED:
            for name, (psnr, dssim) in PUBLISHED[scene.name].images.items():
                rows.append(
                    (scene.name, PAPER + name, psnr, dssim, *(None,) * (2 * len(LIGHTS) * len(VIEW_SETS) - 2))
                )
    caption = (
        "Path-traced images of the recovered atlas on the scene's geometry against the scene's: clipped, "
        "sRGB-encoded, data range 1; one exposure for all views of a light, none fitted. Means over views. "
        "Recovered light: recovered materials and lights, compared with the scene under its own light. "
        "The paper does not state the light and views of its figures; they are in the first columns."
    )
    return Table("rerendering", "Re-rendering", caption, tuple(columns), tuple(rows), tuple(digits))


def _images_table(result: SuiteResult) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scene in result.scenes:
        for method in _measured(scene):
            for light in LIGHTS:
                for views in VIEW_SETS:
                    figures = method.images.get(light, {}).get(views, {})
                    if figures:
                        rows.append(
                            (scene.name, method.label, light, views, *(figures.get(key) for key in _ALL))
                        )
    caption = (
        "All measures of the same images; in the last columns after one factor for all views, as if a light "
        "were dimmed or brightened by hand."
    )
    if result.lpips_absence:
        caption += f" LPIPS is left out: {result.lpips_absence}."
    columns = ("scene", "method", "light", "views", *_ALL.values())
    digits = (0, 0, 0, 0, 2, 2, 3, 3, 3, 3, 2, 3)
    return Table("images", "Re-rendering, all measures", caption, columns, tuple(rows), digits)


_COMPARING = "render and compare"


def _cost_table(result: SuiteResult) -> Table:
    rows: list[tuple[Cell, ...]] = []
    methods = [method for scene in result.scenes for method in _measured(scene)]
    found = dict.fromkeys(stage for method in methods for stage in method.seconds if stage != _COMPARING)
    names = tuple(found | dict.fromkeys(("statistics", "predict", "merge")))  # those of the paper
    for scene in result.scenes:
        for method in _measured(scene):
            seconds = [method.seconds.get(stage) for stage in names]
            total = sum(value for value in seconds if value is not None)
            spent = (method.seconds.get(_COMPARING), method.processor_s, method.peak_memory_mb)
            rows.append((scene.name, method.label, *seconds, total, *spent))
        if scene.name in PUBLISHED:
            statistics, predict, texturing = (60.0 * m for m in PUBLISHED[scene.name].minutes)
            cells: dict[str, Cell] = {"statistics": statistics, "predict": predict, "merge": 3 * texturing}
            total = statistics + predict + 3 * texturing
            rows.append(
                (scene.name, f"{PAPER}Ours", *(cells.get(stage) for stage in names), total, *(None,) * 3)
            )
    caption = (
        "Wall seconds by stage from photographs to asset, and of rendering and comparing it; processor "
        "seconds of both, without cached results; and the peak of the process's resident memory from the "
        "method's start to its last figure. Unwrapping is done once per geometry and counted for each method "
        "that uses it. The paper's times are for a Xeon 5218 and a Quadro RTX 5000, with the texturing of "
        "three maps in the column merge."
    )
    stages = (f"{stage} (s)" for stage in names)
    last = ("total (s)", f"{_COMPARING} (s)", "processor (s)", "peak memory (MB)")
    digits = (0, 0, *(1,) * (len(names) + 3), 0)
    columns = ("scene", "method", *stages, *last)
    return Table("cost", "Time and memory", caption, columns, tuple(rows), digits)
