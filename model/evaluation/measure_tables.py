# SPDX-License-Identifier: MIT
"""Further tables of a suite: albedo scale, kinds of surface, other measures, noise, confidence, cameras."""

from __future__ import annotations

import numpy as np

from datagen.foundation.buffers import MATERIAL_MAPS
from model.evaluation.map_measures import QUARTERS
from model.evaluation.noise import Figure, figure_of
from model.evaluation.results import MethodResult, SceneResult, SuiteResult
from model.evaluation.surface_kinds import KINDS
from model.evaluation.tables import LETTERS, LIGHTS, MAP_STAGES, PAPER, VIEW_SETS, Cell, Table

_LEVELS = {
    "diffuse_gain": "best gain of D",
    "diffuse_mse_gain": "D after best gain (MSE)",
    "diffuse_mse_region_gain": "D after each part's gain (MSE)",
    "level_error": "level error (median of |ln ratio|)",
}
_OTHERS = {
    "kd_db": "kd where rough (dB)",
    "a_prime_db": "a' (dB)",
    "roughness_db": "roughness in [0.2, 1] (dB)",
    "emission_iou": "emission (IoU)",
    "emission_log_l2": "emission (log L2)",
}
PUBLISHED_OTHERS = (
    ("FIPT", "HDR photographs", 29.95, 25.98, 26.37),
    ("FIPT", "8 bits", 15.5, 9.7, 5.0),
    ("IRIS", "8 bits", 22.3, 17.9, 21.4),
)
"""Means over the four rooms of FIPT as published by IRIS: kd, a' and roughness in dB."""


def measure_tables(result: SuiteResult) -> list[Table]:
    """Further tables of a suite's result; empty ones are omitted, except that of the kinds of surface."""
    tables = [_levels(result), _kinds(result), _others(result), _noise(result)]
    tables += [_calibration(result), _cameras(result)]
    return [table for table in tables if table.rows or table.name == "kinds"]


def _judged(result: SuiteResult) -> list[tuple[SceneResult, MethodResult]]:
    return [(s, method) for s in result.scenes for method in s.methods if not method.skipped]


def _levels(result: SuiteResult) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scene, method in _judged(result):
        for stage, words in MAP_STAGES.items():
            found = method.map_figures.get(stage)
            if found is not None:
                psnr = (found[f"{name}_psnr_db"] for name in MATERIAL_MAPS)
                rows.append((scene.name, method.label, words, *psnr, *(found[key] for key in _LEVELS)))
    letters = (f"{LETTERS[name]} (PSNR, dB)" for name in MATERIAL_MAPS)
    columns = ("scene", "method", "maps", *letters, *_LEVELS.values())
    caption = (
        "Errors of linear values with a range of 1. The best gain for the whole scene leaves errors of D "
        "in the levels of parts and in patterns; the best gain for each part, in patterns alone."
    )
    return Table(
        "levels", "Levels and patterns", caption, columns, tuple(rows), (0, 0, 0, 1, 1, 1, 2, 4, 4, 3)
    )


def _kinds(result: SuiteResult) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scene, method in _judged(result):
        for kind in ("all", *KINDS):
            found = method.by_kind.get("merged", {}).get(kind)
            if found is not None:
                roots = (float(np.sqrt(found[name])) for name in MATERIAL_MAPS)
                rows.append((scene.name, method.label, kind, 100 * found["share"], *roots))
    columns = ("scene", "method", "surfaces", "of all (%)", *(f"{LETTERS[n]} (RMSE)" for n in MATERIAL_MAPS))
    caption = (
        "Root mean square errors of merged maps. Metal: S > 0.2; of the rest white: D > 0.7, glossy: "
        "R < 0.4, matt: R >= 0.4; small: pieces less than 0.3 m across; seldom seen: in fewer than 4 views; "
        "sunlit: in direct sun."
    )
    return Table("kinds", "Errors by kind of surface", caption, columns, tuple(rows), (0, 0, 0, 1, 3, 3, 3))


def _others(result: SuiteResult) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scene, method in _judged(result):
        found = method.map_figures.get("merged")
        if found is not None:
            rows.append((scene.name, method.label, "merged", *(found.get(key) for key in _OTHERS)))
    if rows:
        for name, how, *decibels in PUBLISHED_OTHERS:
            rows.append(("FIPT's rooms", f"{PAPER}{name}", how, *decibels, None, None))
    caption = (
        "As in the public evaluation of IRIS: 8-bit values, whole views with excluded pixels set to zero in "
        "both images, mean of the views' decibels. Published figures are for other rooms, views and "
        "photographs, and for Disney's lobe; they are for orientation. Our emitters are given as geometry."
    )
    columns = ("scene", "method", "maps", *_OTHERS.values())
    return Table(
        "others", "Measures of FIPT and IRIS", caption, columns, tuple(rows), (0, 0, 0, 2, 2, 2, 3, 4)
    )


def _noise(result: SuiteResult) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scene, method in _judged(result):
        for light, views, found in image_noise(method):
            figures = (found.mean, found.by_views, found.by_seed, found.error)
            known = (None if np.isnan(figure) else figure for figure in figures)
            rows.append((scene.name, method.label, light, views, *known))
    columns = ("scene", "method", "light", "views", "PSNR sRGB (dB)", "by views", "by seed", "together")
    caption = (
        "Standard errors of the mean over views: by bootstrap over views, and from another seed of the "
        "renderer (0 if no view was rendered with a second seed). The difference of two methods on the same "
        "views has a smaller standard error, which --compare gives."
    )
    return Table("noise", "Noise of the figures", caption, columns, tuple(rows), (0, 0, 0, 0, 2, 2, 2, 2))


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
    rows: list[tuple[Cell, ...]] = []
    for scene, method in _judged(result):
        for name in MATERIAL_MAPS:
            if name in method.calibration:
                rows.append((scene.name, method.label, LETTERS[name], *method.calibration[name]))
    quarters = ("least confident (RMSE)", *(f"quarter {k}" for k in range(2, QUARTERS)), "most confident")
    columns = ("scene", "method", "map", "rank correlation", *quarters)
    caption = "RMSE by quarter of the pixels. Rank correlation with small errors: 1 for the same order."
    return Table("confidence", "Confidence", caption, columns, tuple(rows), (0, 0, 0, 2, 3, 3, 3, 3))


def _cameras(result: SuiteResult) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scene in result.scenes:
        judged = [method for method in scene.methods if not method.skipped and method.kind != "truth"]
        if not any(method.camera for method in judged):
            continue
        for method in sorted(judged, key=lambda m: [other.method for other in judged].index(m.method)):
            maps = (method.maps_merged.get(name) for name in MATERIAL_MAPS)
            psnr = (
                method.images.get(light, {}).get(views, {}).get("psnr_srgb_db")
                for light in ("own", "modified")
                for views in ("input", "novel")
            )
            rows.append((scene.name, method.method, method.camera or "as rendered", *maps, *psnr))
    columns = (
        "scene",
        "method",
        "photographs",
        *(f"{LETTERS[name]} merged (MSE)" for name in MATERIAL_MAPS),
        *(f"{light}, {views} (PSNR, dB)" for light in ("own", "modified") for views in ("input", "novel")),
    )
    caption = "The same methods on photographs with camera faults; docs/evaluation.md explains their names."
    return Table("cameras", "Cameras", caption, columns, tuple(rows), (0, 0, 0, 4, 4, 4, 2, 2, 2, 2))
