# SPDX-License-Identifier: MIT
"""The HTML report of ``materials infer``, a self-contained page: summary, recovered lights, confidence of the
maps, cost of the stages."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from datagen.foundation.color import cividis, srgb_from_linear
from datagen.foundation.images import data_url, encode_png
from model.reconstruction.found_lights import light_cells
from model.reconstruction.infer_options import InferReport
from model.reconstruction.stages import ViewPicture

KINDS = {"lamp": "lamp surface", "window": "window opening", "sky": "sky background", "sun": "sun"}
_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.55 system-ui, sans-serif; max-width: 66rem; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.8rem; margin: 0 0 .3rem; } h2 { font-size: 1.2rem; margin: 2.4rem 0 .4rem; }
p { max-width: 70ch; } .wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13.5px; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid #8884; white-space: pre; }
th:first-child, td:first-child { text-align: left; }
.views { display: grid; grid-template-columns: repeat(3, 1fr); gap: .4rem; max-width: 62rem; }
.views img { width: 100%; display: block; border-radius: 4px; image-rendering: auto; }
.scale { display: flex; gap: .5rem; align-items: center; margin: .5rem 0; }
.scale img { width: 12rem; height: .8rem; } i { display: inline-block; width: 1.6rem; height: .9em;
  vertical-align: -.1em; border-radius: 3px; border: 1px solid #8886; }
"""


def report_html(report: InferReport, pictures: Sequence[ViewPicture]) -> str:
    """Format the report and ``pictures`` of views as an HTML page."""
    title = html.escape(f"{report.name}: materials")
    done = (
        f"{report.num_views} views, {report.num_triangles} triangles, an atlas of {report.atlas_size} x "
        f"{report.atlas_size} texels; {report.seen_of_visible:.0%} of the visible surface was observed."
    )
    parts = _remarks(report), _lights(report.light), _confidence(report.light, pictures), _costs(report)
    return (
        f"<!doctype html><html lang=en><head><meta charset=utf-8><title>{title}</title>"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style></head><body><h1>{title}</h1><p>{done}</p>{''.join(parts)}</body></html>\n"
    )


def _remarks(report: InferReport) -> str:
    texts = [*(f"warning: {text}" for text in report.warnings), *(f"note: {text}" for text in report.notes)]
    items = "".join(f"<li>{html.escape(text)}</li>" for text in texts)
    return f"<ul>{items}</ul>" if items else ""


def _lights(light: dict[str, Any]) -> str:
    if "lights" not in light:
        return ""
    rows = []
    for row in light["lights"]:
        color = np.array(row.get("radiance") or row["irradiance"])
        shown = np.round(255 * srgb_from_linear(color / max(float(color.max()), 1e-12))).astype(int)
        swatch = f'<i style="background:rgb({",".join(map(str, shown))})"></i>'
        name = f"{html.escape(row['slot'])} {swatch}"
        rows.append((name, KINDS[row["kind"]], *light_cells(row)))
    heads = ("light", "kind", "middle x y z (m)", "area (m2)", "radiance R G B", "power R G B", "gain R G B")
    found = _table(heads, rows) if rows else "<p>No light was found.</p>"
    return (
        "<h2>Lights</h2><p>Lamps and windows with their recovered radiance, in the photographs' unit; power "
        "is pi times area and radiance, in W if radiance is in W/(m2 sr); the sun has the irradiance of a "
        "surface that faces it instead of radiance. The exports contain these lights "
        f"times the gain, which makes the asset as bright as the photographs.</p>{found}"
    )


def _confidence(light: dict[str, Any], pictures: Sequence[ViewPicture]) -> str:
    if not pictures:
        return ""
    means = " ".join(f"{name} {value:.2f}" for name, value in zip("DSR", light["confidence"], strict=True))
    bar = np.array(cividis(), np.uint8)[None].repeat(8, axis=0)
    cells = "".join(
        f'<img alt="{html.escape(f"{picture.name}: {text}")}" src="{data_url(encode_png(pixels))}">'
        for picture in pictures
        for text, pixels in (
            ("photograph", picture.photograph),
            ("diffuse albedo", picture.diffuse_albedo),
            ("confidence of D", picture.confidence),
        )
    )
    return (
        "<h2>Confidence</h2><p>How far the photographed light, rather than the network, determines the "
        f"materials; means over the surface: {means}. Below: photograph, diffuse albedo, confidence of D; "
        "<code>atlas/confidence.png</code> has D, S and R by texel.</p>"
        f'<div class="scale">0, unknown <img alt="" src="{data_url(encode_png(bar))}"> 1, determined</div>'
        f'<div class="views">{cells}</div>'
    )


def _costs(report: InferReport) -> str:
    rows = [
        (html.escape(name), f"{seconds:.1f}", f"{share:.0%}", f"{memory:.0f}")
        for name, seconds, share, memory in report.costs()
    ]
    heads = ("step", "seconds", "share", "peak memory so far (MB)")
    return f"<h2>Cost</h2>{_table(heads, rows)}"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format an HTML table; ``rows`` are HTML, ``heads`` plain text."""
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'
