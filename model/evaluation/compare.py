# SPDX-License-Identifier: MIT
"""Comparison of two runs of a suite: differences of the figures, and whether they exceed the noise.

Scenes, methods and views are matched by name. For every figure the table lists the means over the views
judged in both runs, their difference and its standard error (``noise``); a difference below two standard
errors is not significant.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from datagen.formats.base import read_json
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.errors import input_error
from model.evaluation.noise import Difference, difference
from model.evaluation.results import MethodResult, SuiteResult
from model.evaluation.tables import LETTERS, LIGHTS, MAP_STAGES, VIEW_SETS, Row, Table

_IMAGES = {"psnr_srgb_db": ("PSNR (dB)", True), "dssim": ("DSSIM", False), "lpips_vgg": ("LPIPS", False)}
"""Compared image metrics, by name: (title, whether a higher value is better)."""
NONE = "none"


def read_other(path: Path) -> SuiteResult:
    """Read ``evaluation.json`` of a run from its path or folder. Raises :class:`InputError` if invalid."""
    file = path / "evaluation.json" if path.is_dir() else path
    if not file.is_file():
        expected = "evaluation.json of another run, or its folder"
        raise input_error(file, "", "no such file", expected, "give the --out of a finished run")
    return read_json(SuiteResult, file)


def comparison(this: SuiteResult, other: SuiteResult) -> Table:
    """Table of the differences between two runs.

    Raises :class:`InputError` unless, for a scene and method, the runs share at least two judged views.
    """
    rows: list[Row] = []
    earlier = {scene.name: scene for scene in other.scenes}
    for scene in this.scenes:
        if scene.name not in earlier:
            continue
        known = {
            (method.method, method.camera): method
            for method in earlier[scene.name].methods
            if not method.skipped
        }
        for method in scene.methods:
            key = (method.method, method.camera)
            if method.skipped or key not in known:
                continue
            for figure, found, more_is_better in _differences(known[key], method):
                rows.append((scene.name, method.label, figure, *_cells(found, more_is_better)))
    if not rows:
        got, expected = "no method on the same views of the same scene", "another run of the same suite"
        raise input_error("--compare", "", got, expected)
    caption = (
        "Means over the views that both runs judged. The noise is the standard error of the difference: a "
        "paired bootstrap over views and, where views were rendered with a second seed, the renderer's "
        "noise. A difference below two standard errors counts as none."
    )
    numbers = dict.fromkeys(("other", "this", "difference", "noise"), 4)
    columns = {**dict.fromkeys(("scene", "method", "figure"), 0), **numbers, "verdict": 0}
    return Table("comparison", "Differences", caption, columns, rows)


def _cells(found: Difference, more_is_better: bool) -> Row:
    change = found.this - found.other
    verdict = NONE if found.is_insignificant else "better" if (change > 0) == more_is_better else "worse"
    return (found.other, found.this, change, found.error, verdict)


def _differences(other: MethodResult, this: MethodResult) -> Iterator[tuple[str, Difference, bool]]:
    """Yield each figure's name, its difference between the runs, and whether a higher value is better."""
    for stage, words in MAP_STAGES.items():
        rows = [result.map_views.get(stage, {}) for result in (other, this)]
        weights = {view: row["pixels"] for view, row in rows[1].items()}
        for name in MATERIAL_MAPS:
            values = [{view: row[name] for view, row in part.items()} for part in rows]
            found = difference(values[0], values[1], weights=weights)
            if found is not None:
                yield f"{LETTERS[name]} {words} (MSE)", found, False
    for light in LIGHTS:
        for views in VIEW_SETS:
            parts = [result.image_views.get(light, {}).get(views, {}) for result in (other, this)]
            for key, (title, more_is_better) in _IMAGES.items():
                spreads = tuple(result.seed_spread.get(light, {}).get(key, 0.0) for result in (other, this))
                found = difference(_known(parts[0], key), _known(parts[1], key), (spreads[0], spreads[1]))
                if found is not None:
                    yield f"{light} light, {views} views: {title}", found, more_is_better


def _known(rows: Mapping[str, Mapping[str, float | None]], key: str) -> dict[str, float]:
    return {view: value for view, row in rows.items() if (value := row.get(key)) is not None}
