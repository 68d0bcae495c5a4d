# SPDX-License-Identifier: MIT
"""Self-contained HTML page of a suite: a chart of all methods; for every scene the best and the worst view
of each method with a slider between truth and estimate, errors of D, S and R in one view on a common scale, a
chart of errors by kind of surface, all pictures; and the tables.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.color import cividis
from datagen.foundation.images import data_url, encode_jpeg
from model.evaluation.charts import confidence_svg, hue, overview_svg
from model.evaluation.metrics import shown
from model.evaluation.pictures import COLUMNS, TRUTH, Row, map_pixels, rendered_views, small
from model.evaluation.rendering import JudgedView
from model.evaluation.results import MethodResult, SceneResult, SuiteResult
from model.evaluation.surface_kinds import KINDS
from model.evaluation.tables import LETTERS, LIGHTS, VIEW_SETS, Table, image_noise

_JPEG_QUALITY = 88
_BOUNDS = ("oracle", "truth")  # kinds of methods that are upper bounds of all others
_WIDTH_PX = 480
LARGEST_ERROR = 0.5
"""Error with the last colour of the error maps' scale; larger errors have the same colour."""
NOTHING = 0.88
"""Grey in [0, 1] of pixels that are not compared; lighter than any colour of the scale."""
_BAR_PX, _NAME_PX, _GROUP_GAP_PX, _LABEL_PX, _CHART_PX = 9, 27, 12, 92, 430


def page_html(
    result: SuiteResult,
    notes: Sequence[str],
    tables: Sequence[Table],
    rows: Mapping[str, list[Row]],
    truths: Mapping[str, Mapping[str, JudgedView]],
) -> str:
    """The page as HTML; ``rows`` and ``truths`` (true views under the scene's own light) are by scene."""
    title = f"Suite {result.suite}"
    items = "".join(f"<li>{html.escape(note)}</li>" for note in notes)
    sections = [
        (", ".join(filter(None, (scene.name, camera))), part)
        for scene in result.scenes
        for camera, part in scene.by_camera()
    ]
    links = "".join(f'<a href="#{_anchor(name)}">{html.escape(name)}</a>' for name, _ in sections)
    scenes = [scene_html(name, part, rows[part.name], truths[part.name]) for name, part in sections]
    parts = [
        f"<h1>{html.escape(title)}</h1>"
        "<p>Each method recovers the materials of rooms from rendered photographs; the recovered rooms are "
        "rendered again and compared with the truth.</p>"
        f'<nav>{links}<a href="#tables">tables</a></nav>',
        f'<div class="wide overview">{overview_svg(result)}</div>',
        f'<div class="overview">{confidence_svg(result)}</div>',
        *scenes,
        f'<section id="tables"><ul class="notes">{items}</ul>{"".join(t.html() for t in tables)}</section>',
    ]
    return (
        "<!doctype html><html lang=en><head><meta charset=utf-8>"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_bundled('page.css')}</style></head>"
        f"<body><main>{''.join(parts)}</main><script>{_bundled('page.js')}</script></body></html>\n"
    )


def _bundled(name: str) -> str:
    """Text of a file next to this module, without its first line, the licence."""
    return "\n" + Path(__file__).with_name(name).read_text("utf-8").partition("\n")[2]


def scene_html(title: str, scene: SceneResult, rows: Sequence[Row], truth: Mapping[str, JudgedView]) -> str:
    """HTML section of a scene with one set of camera faults; ``truth``: its true views by name."""
    methods = [m for m in scene.methods if not m.skipped and m.kind != "truth"]
    views = {method.label: rendered_views(method) for method in methods}
    cards = "".join(_cards(scene, method, views[method.label], truth) for method in methods)
    rows = [row for row in rows if row.label in (TRUTH, *views)]
    return (
        f'<section id="{_anchor(title)}"><h2>{html.escape(title)}</h2>{_summary(scene)}'
        "<h3>Best and worst view of each method</h3><p>Truth on the left, the recovered room on the right, "
        f'under the scene\'s own light; drag the line.</p><div class="cards">{cards}</div>'
        f"{_error_maps(scene, methods, views, truth)}{_charts(methods)}"
        f"<details><summary>All pictures</summary>{_all_pictures(scene, rows)}</details></section>"
    )


def _anchor(title: str) -> str:
    return title.replace(", ", "-")


def _summary(scene: SceneResult) -> str:
    """HTML table of a scene's main figures; the best value per column, except upper bounds, is bold."""
    judged = [method for method in scene.methods if not method.skipped]
    heads = [f"{letter} (MSE)" for letter in LETTERS.values()]
    heads += [f"{light} light, {views} (dB)" for light in LIGHTS for views in VIEW_SETS]
    values: list[list[float | None]] = []
    texts: list[list[str]] = []
    for method in judged:
        maps = [method.maps_merged.get(name) for name in MATERIAL_MAPS]
        noise = {(light, views): found for light, views, found in image_noise(method)}
        images = [noise.get((light, views)) for light in LIGHTS for views in VIEW_SETS]
        values.append([*maps, *(None if found is None else -found.mean for found in images)])
        texts.append(
            [*("" if v is None else f"{v:.4f}" for v in maps), *(f.text if f else "" for f in images)]
        )
    lines = []
    for method, row, numbers in zip(judged, texts, values, strict=True):
        cells = []
        for k, text in enumerate(row):
            rivals = [v[k] for m, v in zip(judged, values, strict=True) if m.kind not in _BOUNDS]
            known = [value for value in rivals if value is not None]
            is_best = method.kind not in _BOUNDS and bool(known) and numbers[k] == min(known)
            cells.append(f"<td>{'<b>' if is_best else ''}{text}{'</b>' if is_best else ''}</td>")
        lines.append(f"<tr><td>{html.escape(method.label)}</td>{''.join(cells)}</tr>")
    head = "".join(f"<th>{head}</th>" for head in heads)
    return (
        f'<div class="wide"><table class="summary"><thead><tr><th>method</th>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


# ---- sliders


def best_and_worst(method: MethodResult) -> list[tuple[str, str, float]]:
    """Views of highest and lowest PSNR under the scene's own light, as ("best" or "worst", view, PSNR in dB);
    a single view is listed only as best.
    """
    rows = {
        name: row["psnr_srgb_db"] or 0.0
        for views in method.image_views.get("own", {}).values()
        for name, row in views.items()
    }
    if not rows:
        return []
    order = sorted(rows, key=lambda name: rows[name])
    chosen = [("best", order[-1]), *([("worst", order[0])] if len(order) > 1 else [])]
    return [(which, name, rows[name]) for which, name in chosen]


def _cards(
    scene: SceneResult, method: MethodResult, views: Mapping[str, JudgedView], truth: Mapping[str, JudgedView]
) -> str:
    cards = []
    for which, name, psnr in best_and_worst(method):
        pair = [_picture(shown(source[name].color, scene.exposures["own"])) for source in (truth, views)]
        text = html.escape(f"{scene.name}, {name}: truth and {method.label}", quote=True)
        label = html.escape(method.label)
        cards.append(
            f'<figure><div class="pair"><img alt="" src="{pair[1]}"><img class="over" alt="{text}" '
            f'src="{pair[0]}"><span class="tag left">truth</span><span class="tag right">'
            f'{label}</span><input type="range" value="50" aria-label="{text}"></div>'
            f"<figcaption><b>{label}</b>, {which} view ({name}): {psnr:.1f} dB</figcaption>"
            "</figure>"
        )
    return "".join(cards)


# ---- error maps


def error_picture(error: NDArray) -> NDArray[np.float64]:
    """Colours (H, W, 3) in [0, 1] of errors (H, W), which are NaN at pixels that are not compared."""
    scale = np.array(cividis()) / 255
    colors = scale[
        np.rint(np.clip(np.nan_to_num(error) / LARGEST_ERROR, 0, 1) * (len(scale) - 1)).astype(int)
    ]
    return np.where(np.isnan(error)[..., None], NOTHING, colors)


def _error_maps(
    scene: SceneResult,
    methods: Sequence[MethodResult],
    views: Mapping[str, Mapping[str, JudgedView]],
    truth: Mapping[str, JudgedView],
) -> str:
    """HTML grid with a row for each map: the true map, then the error of every method."""
    name = scene.figure_views["input"]
    judged = [method for method in methods if name in views[method.label]]
    heads = ("", "truth", *(method.label for method in judged))
    cells = [f'<span class="head">{html.escape(head)}</span>' for head in heads]
    for map_name, letter in LETTERS.items():
        cells.append(f'<span class="row">{letter}</span>')
        true_map = _picture(map_pixels(truth[name], map_name))
        cells.append(f'<img alt="truth: {letter}" title="truth: {letter}" src="{true_map}">')
        for method in judged:
            view = views[method.label][name]
            squared = (view.maps[map_name] - truth[name].maps[map_name]).astype(np.float64) ** 2
            mask = truth[name].surface_mask & view.surface_mask
            error = np.where(mask, np.sqrt(squared.mean(axis=2)), np.nan)
            text = html.escape(f"{method.label}: error of {letter}", quote=True)
            cells.append(f'<img alt="{text}" title="{text}" src="{_picture(error_picture(error))}">')
    bar = error_picture(np.linspace(0, LARGEST_ERROR, 256)[None].repeat(8, 0))
    return (
        "<h3>Errors of the maps</h3><p>The true maps in "
        f"{name}, D and S sRGB-encoded, and the root mean square error over channels of every "
        "method's merged ones; grey: not compared.</p>"
        f'<div class="wide"><div class="errors" style="--methods:{len(judged) + 1}">{"".join(cells)}</div>'
        '</div><div class="scale">0<img alt="" '
        f'src="{_picture(bar)}">{LARGEST_ERROR:g} and more</div>'
    )


# ---- charts


def _charts(methods: Sequence[MethodResult]) -> str:
    judged = [method for method in methods if method.by_kind.get("merged")]
    if not judged:
        return ""
    kinds = [k for k in ("all", *KINDS) if any(k in method.by_kind["merged"] for method in judged)]
    legend = "".join(
        f'<span><i style="background:{hue(k)}"></i>{html.escape(m.label)}</span>'
        for k, m in enumerate(judged)
    )
    charts = "".join(_chart(name, kinds, judged) for name in MATERIAL_MAPS)
    return (
        "<h3>Errors by kind of surface</h3><p>Root mean square error of the merged maps on all surfaces and "
        "on each kind; below its name is its share of the judged pixels.</p>"
        f'<div class="legend">{legend}</div><div class="chart">{charts}</div>'
    )


def _chart(name: str, kinds: Sequence[str], methods: Sequence[MethodResult]) -> str:
    """SVG chart of the errors of the map ``name``: a group of bars for each kind, a bar for each method."""
    errors = {
        (kind, k): float(np.sqrt(method.by_kind["merged"][kind][name]))
        for kind in kinds
        for k, method in enumerate(methods)
        if kind in method.by_kind["merged"]
    }
    largest = max([*errors.values(), 1e-6])
    group = max(_BAR_PX * len(methods), _NAME_PX) + _GROUP_GAP_PX
    height = 26 + group * len(kinds)
    longest = _CHART_PX - _LABEL_PX - 44
    parts = [f'<text x="0" y="13" font-weight="600">{LETTERS[name]}, {name.replace("_", " ")}</text>']
    parts.append(f'<line class="axis" x1="{_LABEL_PX}" x2="{_LABEL_PX}" y1="22" y2="{height}"/>')
    for row, kind in enumerate(kinds):
        top = 26 + row * group
        share = next(
            (m.by_kind["merged"][kind]["share"] for m in methods if kind in m.by_kind["merged"]), 0.0
        )
        parts.append(f'<text x="0" y="{top + 11}">{html.escape(kind)}</text>')
        parts.append(f'<text class="quiet" x="0" y="{top + 25}">{share:.1%}</text>')
        for k in range(len(methods)):
            if (kind, k) not in errors:
                continue
            y, length = top + k * _BAR_PX, longest * errors[kind, k] / largest
            parts.append(
                f'<rect x="{_LABEL_PX}" y="{y}" width="{length:.1f}" height="{_BAR_PX - 2}" rx="2" '
                f'fill="{hue(k)}"/><text class="quiet" x="{_LABEL_PX + length + 4:.1f}" y="{y + 7.5}" '
                f'style="font-size:8.5px">{errors[kind, k]:.3f}</text>'
            )
    return f'<svg viewBox="0 0 {_CHART_PX} {height}" role="img">{"".join(parts)}</svg>'


# ---- all pictures


def _all_pictures(scene: SceneResult, rows: Sequence[Row]) -> str:
    head = "".join(f"<th>{html.escape(column)}</th>" for column in COLUMNS)
    lines = []
    for row in rows:
        cells = []
        for column in COLUMNS:
            picture = row.pictures[column]
            if picture is None:
                cells.append("<td>none</td>")
                continue
            text = html.escape(f"{scene.name}, {row.label}: {column}", quote=True)
            url = data_url(encode_jpeg(picture.pixels, _JPEG_QUALITY), "jpeg")
            cells.append(f'<td><img alt="{text}" title="{text}" src="{url}"></td>')
        lines.append(f"<tr><th>{html.escape(row.label)}</th>{''.join(cells)}</tr>")
    views = ", ".join(f"{kind} {name}" for kind, name in scene.figure_views.items())
    return (
        f"<p>Views: {html.escape(views)}. D and S sRGB-encoded, R linear; images under the exposure of the "
        f'tables.</p><div class="wide"><table class="pictures"><tr><th></th>{head}</tr>{"".join(lines)}'
        "</table></div>"
    )


def _picture(values: NDArray) -> str:
    """Data URL of an image of ``values`` (H, W, 3) in [0, 1]."""
    return data_url(encode_jpeg(small(values, _WIDTH_PX), _JPEG_QUALITY), "jpeg")
