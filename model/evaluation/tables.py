# SPDX-License-Identifier: MIT
"""Tables of a suite's figures: errors of maps and re-renderings, albedo scale, kinds of surface, noise,
confidence, cameras, time and memory.
"""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.tables import read_table
from model.evaluation.map_measures import QUARTERS
from model.evaluation.noise import Figure, figure_of
from model.evaluation.results import MethodResult, SceneResult, SuiteResult
from model.evaluation.surface_kinds import KINDS

Cell = str | float | None
Row = tuple[Cell, ...]
LETTERS = dict(zip(MATERIAL_MAPS, "DSR", strict=True))
PAPER = "paper: "
LIGHTS = ("own", "modified", "recovered")
"""Lights in the order of the tables: the scene's own, the modified, and those recovered by a method."""
VIEW_SETS = ("input", "novel")
MAP_STAGES = {"per_view": "per view", "merged": "merged"}
"""Title of each stage of maps."""
_PUBLISHED = read_table(__file__, "published.yaml", dict[str, Any])
_SHOWN = {"psnr_srgb_db": "PSNR sRGB (dB)", "dssim": "DSSIM = 1-SSIM"}
_ALL = {
    "psnr_srgb_db": ("PSNR, clipped sRGB, range 1 (dB)", 2),
    "psnr_linear_db": ("PSNR, clipped linear (dB)", 2),
    "ssim": ("SSIM, Gaussian 11x11 sigma 1.5", 3),
    "dssim": ("DSSIM = 1-SSIM", 3),
    "lpips_vgg": ("LPIPS-VGG 0.1", 3),
    "gain": ("fitted gain", 3),
    "psnr_gain_db": ("PSNR, clipped sRGB, with the gain (dB)", 2),
    "dssim_gain": ("DSSIM = 1-SSIM, with the gain", 3),
}
_LEVELS = {
    "diffuse_gain": ("best gain of D", 2),
    "diffuse_mse_gain": ("D after best gain (MSE)", 4),
    "diffuse_mse_region_gain": ("D after each part's gain (MSE)", 4),
    "level_error": ("level error (median of |ln ratio|)", 3),
}
_OTHERS = {
    "kd_db": ("kd where rough (dB)", 2),
    "a_prime_db": ("a' (dB)", 2),
    "roughness_db": ("roughness in [0.2, 1] (dB)", 2),
    "emission_iou": ("emission (IoU)", 3),
    "emission_log_l2": ("emission (log L2)", 4),
}
_METHOD = {"scene": 0, "method": 0}
_COMPARING = "render and compare"


@dataclass(frozen=True)
class Table:
    """A table. ``columns``: number of decimals by title; ``rows``: a cell per column, None if empty."""

    name: str
    title: str
    caption: str
    columns: dict[str, int]
    rows: Sequence[Row]

    def texts(self) -> list[list[str]]:
        """Rows as text, with rounded numbers."""
        digits = self.columns.values()
        return [[_text(cell, num) for cell, num in zip(row, digits, strict=True)] for row in self.rows]

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
    """Tables of a suite's result; tables of further measures are omitted if empty, except errors by kind."""
    further = [_levels, _kinds, _others, _noise, _calibration, _cameras]
    found = [table for make in further if (table := make(result)).rows or table.name == "kinds"]
    return [_maps(result), *found, _rerendering(result), _images(result), _cost(result)]


def _measured(scene: SceneResult) -> list[MethodResult]:
    return [method for method in scene.methods if not method.skipped]


def _judged(result: SuiteResult) -> list[tuple[SceneResult, MethodResult]]:
    return [(scene, method) for scene in result.scenes for method in _measured(scene)]


def _titled(names: dict[str, tuple[str, int]]) -> dict[str, int]:
    """Table columns, {title: decimals}, for the figures ``names``, {key: (title, decimals)}."""
    return dict(names.values())


def _lettered(template: str, digits: int) -> dict[str, int]:
    """A column for each map, whose title has the map's letter in place of ``{}``."""
    return {template.format(letter): digits for letter in LETTERS.values()}


def _published(scene: SceneResult) -> dict[str, Any]:
    """Figures of Prakash et al. 2022 for a scene; empty if there are none."""
    found: dict[str, Any] = _PUBLISHED["scenes"].get(scene.name, {})
    return found


def _maps(result: SuiteResult) -> Table:
    rows: list[Row] = []
    nothing = (None,) * len(MATERIAL_MAPS)
    for scene in result.scenes:
        for method in _measured(scene):
            stages = method.maps_per_view, method.maps_merged
            errors = (maps.get(name) for maps in stages for name in MATERIAL_MAPS)
            shares = _percent(method.covered_share), _percent(method.seen_share)
            rows.append((scene.name, method.label, *errors, *shares))
        paper = _published(scene)
        for name, mse in paper.get("merged", {}).items():
            rows.append((scene.name, PAPER + name, *nothing, *mse, None, None))
        for name, mse in paper.get("per_view", {}).items():
            rows.append((scene.name, PAPER + name, *mse, *nothing, None, None))
    stages_columns = _lettered("{} per view (MSE, linear)", 4) | _lettered("{} merged (MSE, linear)", 4)
    caption = (
        "D diffuse albedo, S specular albedo (F0), R roughness. Mean squared error of linear values over "
        "surface pixels and channels of the judged input views. Per view: the maps as predicted (the paper's "
        "Ours Im.). Merged: the atlas, rendered in the views."
    )
    columns = {**_METHOD, **stages_columns, "pixels covered (%)": 1, "atlas seen (%)": 1}
    return Table("maps", "Material maps", caption, columns, rows)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


def _levels(result: SuiteResult) -> Table:
    rows: list[Row] = []
    for scene, method in _judged(result):
        for stage, words in MAP_STAGES.items():
            found = method.map_figures.get(stage)
            if found is not None:
                psnr = (found[f"{name}_psnr_db"] for name in MATERIAL_MAPS)
                rows.append((scene.name, method.label, words, *psnr, *(found[key] for key in _LEVELS)))
    columns = {**_METHOD, "maps": 0, **_lettered("{} (PSNR, dB)", 1), **_titled(_LEVELS)}
    caption = (
        "Errors of linear values with a range of 1. The best gain for the whole scene leaves errors of D "
        "in the levels of parts and in patterns; the best gain for each part, in patterns alone."
    )
    return Table("levels", "Levels and patterns", caption, columns, rows)


def _kinds(result: SuiteResult) -> Table:
    rows: list[Row] = []
    for scene, method in _judged(result):
        for kind in ("all", *KINDS):
            found = method.by_kind.get("merged", {}).get(kind)
            if found is not None:
                roots = (float(np.sqrt(found[name])) for name in MATERIAL_MAPS)
                rows.append((scene.name, method.label, kind, 100 * found["share"], *roots))
    columns = {**_METHOD, "surfaces": 0, "of all (%)": 1, **_lettered("{} (RMSE)", 3)}
    caption = (
        "Root mean square errors of merged maps. Metal: S > 0.2; of the rest white: D > 0.7, glossy: "
        "R < 0.4, matt: R >= 0.4; small: pieces less than 0.3 m across; seldom seen: in fewer than 4 views; "
        "sunlit: in direct sun."
    )
    return Table("kinds", "Errors by kind of surface", caption, columns, rows)


def _others(result: SuiteResult) -> Table:
    rows: list[Row] = []
    for scene, method in _judged(result):
        found = method.map_figures.get("merged")
        if found is not None:
            rows.append((scene.name, method.label, "merged", *(found.get(key) for key in _OTHERS)))
    if rows:
        for name, how, *decibels in _PUBLISHED["others"]:
            rows.append(("FIPT's rooms", f"{PAPER}{name}", how, *decibels, None, None))
    caption = (
        "As in the public evaluation of IRIS: 8-bit values, whole views with excluded pixels set to zero in "
        "both images, mean of the views' decibels. Published figures are for other rooms, views and "
        "photographs, and for Disney's lobe; they are for orientation. Our emitters are given as geometry."
    )
    columns = {**_METHOD, "maps": 0, **_titled(_OTHERS)}
    return Table("others", "Measures of FIPT and IRIS", caption, columns, rows)


def _noise(result: SuiteResult) -> Table:
    rows: list[Row] = []
    for scene, method in _judged(result):
        for light, views, found in image_noise(method):
            figures = (found.mean, found.by_views, found.by_seed, found.error)
            known = (None if np.isnan(figure) else figure for figure in figures)
            rows.append((scene.name, method.label, light, views, *known))
    figures_columns = dict.fromkeys(("PSNR sRGB (dB)", "by views", "by seed", "together"), 2)
    caption = (
        "Standard errors of the mean over views: by bootstrap over views, and from another seed of the "
        "renderer (0 if no view was rendered with a second seed). The difference of two methods on the same "
        "views has a smaller standard error, which --compare gives."
    )
    columns = {**_METHOD, "light": 0, "views": 0, **figures_columns}
    return Table("noise", "Noise of the figures", caption, columns, rows)


def image_noise(method: MethodResult) -> list[tuple[str, str, Figure]]:
    """PSNR in dB and its noise, as (light, set, figure) for each light and set of views."""
    found = []
    for light in LIGHTS:
        for views in VIEW_SETS:
            rows = method.image_views.get(light, {}).get(views, {}).values()
            values = [value for row in rows if (value := row["psnr_srgb_db"]) is not None]
            if values:
                spread = method.seed_spread.get(light, {}).get("psnr_srgb_db", 0.0)
                found.append((light, views, figure_of(values, spread)))
    return found


def _calibration(result: SuiteResult) -> Table:
    rows: list[Row] = [
        (scene.name, method.label, LETTERS[name], *method.calibration[name])
        for scene, method in _judged(result)
        for name in MATERIAL_MAPS
        if name in method.calibration
    ]
    quarters = ("least confident (RMSE)", *(f"quarter {k}" for k in range(2, QUARTERS)), "most confident")
    columns = {**_METHOD, "map": 0, "rank correlation": 2, **dict.fromkeys(quarters, 3)}
    caption = "RMSE by quarter of the pixels. Rank correlation with small errors: 1 for the same order."
    return Table("confidence", "Confidence", caption, columns, rows)


def _cameras(result: SuiteResult) -> Table:
    rows: list[Row] = []
    shown = [(light, views) for light in ("own", "modified") for views in VIEW_SETS]
    for scene in result.scenes:
        judged = [method for method in _measured(scene) if method.kind != "truth"]
        if not any(method.camera for method in judged):
            continue
        for method in sorted(judged, key=lambda m: [other.method for other in judged].index(m.method)):
            maps = (method.maps_merged.get(name) for name in MATERIAL_MAPS)
            psnr = (method.figures(light, views).get("psnr_srgb_db") for light, views in shown)
            rows.append((scene.name, method.method, method.camera or "as rendered", *maps, *psnr))
    images = {f"{light}, {views} (PSNR, dB)": 2 for light, views in shown}
    caption = "The same methods on photographs with camera faults; docs/evaluation.md explains their names."
    columns = {**_METHOD, "photographs": 0, **_lettered("{} merged (MSE)", 4), **images}
    return Table("cameras", "Cameras", caption, columns, rows)


def _rerendering(result: SuiteResult) -> Table:
    """Table with one row per method: PSNR and DSSIM by light and set of views."""
    shown = [(light, views, key) for light in LIGHTS for views in VIEW_SETS for key in _SHOWN]
    rows: list[Row] = []
    for scene in result.scenes:
        for method in _measured(scene):
            cells = (method.figures(light, views).get(key) for light, views, key in shown)
            rows.append((scene.name, method.label, *cells))
        for name, figures in _published(scene).get("images", {}).items():
            rows.append((scene.name, PAPER + name, *figures, *(None,) * (len(shown) - len(figures))))
    caption = (
        "Path-traced images of the recovered atlas on the scene's geometry against the scene's: clipped, "
        "sRGB-encoded, data range 1; one exposure for all views of a light, none fitted. Means over views. "
        "Recovered light: recovered materials and lights, compared with the scene under its own light. "
        "The paper does not state the light and views of its figures; they are in the first columns."
    )
    images = {f"{light} light, {views} views: {_SHOWN[key]}": _ALL[key][1] for light, views, key in shown}
    return Table("rerendering", "Re-rendering", caption, _METHOD | images, rows)


def _images(result: SuiteResult) -> Table:
    rows: list[Row] = [
        (scene.name, method.label, light, views, *(figures.get(key) for key in _ALL))
        for scene, method in _judged(result)
        for light in LIGHTS
        for views in VIEW_SETS
        if (figures := method.figures(light, views))
    ]
    caption = (
        "All measures of the same images; in the last columns after one factor for all views, as if a light "
        "were dimmed or brightened by hand."
    )
    if result.lpips_absence:
        caption += f" LPIPS is left out: {result.lpips_absence}."
    columns = {**_METHOD, "light": 0, "views": 0, **_titled(_ALL)}
    return Table("images", "Re-rendering, all measures", caption, columns, rows)


def _cost(result: SuiteResult) -> Table:
    rows: list[Row] = []
    spent = [stage for _, method in _judged(result) for stage in method.seconds if stage != _COMPARING]
    names = tuple(dict.fromkeys((*spent, "statistics", "predict", "merge")))  # the last 3 are the paper's
    for scene in result.scenes:
        for method in _measured(scene):
            seconds = [method.seconds.get(stage) for stage in names]
            total = sum(value for value in seconds if value is not None)
            rest = (method.seconds.get(_COMPARING), method.processor_s, method.peak_memory_mb)
            rows.append((scene.name, method.label, *seconds, total, *rest))
        if paper := _published(scene):
            statistics, predict, texturing = (60.0 * m for m in paper["minutes"])
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
    timed = dict.fromkeys((f"{stage} (s)" for stage in (*names, "total", _COMPARING, "processor")), 1)
    return Table("cost", "Time and memory", caption, {**_METHOD, **timed, "peak memory (MB)": 0}, rows)
