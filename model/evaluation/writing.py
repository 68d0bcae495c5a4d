# SPDX-License-Identifier: MIT
"""A suite's results as files: ``evaluation.md``, ``.json``, a CSV a table, pictures, and one HTML page that
needs nothing beside it."""

from __future__ import annotations

import base64
import html
import io
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import canonical_json, sha256_hex, write_bytes_atomically
from datagen.foundation.images import encode_png
from model.evaluation.pictures import COLUMNS, RELIGHTING, Row, scene_rows, sheet
from model.evaluation.rendering import JudgedView
from model.evaluation.results import SceneResult, SuiteResult
from model.evaluation.tables import Table, tables_of

STATE_FILE = "state.json"
_REVISION = 1
_JPEG_QUALITY = 88
KNOWN_WARNING = (
    "Checkpoints may have been trained on these scenes: the figures test the programme, not the checkpoints."
)


def state_of(result: SuiteResult) -> bytes:
    """What a finished folder was written from."""
    return canonical_json({"revision": _REVISION, "result": sha256_hex(canonical_json(result))})


def is_written(result: SuiteResult, out: Path) -> bool:
    """Whether ``out`` holds this result already."""
    path = out / STATE_FILE
    return path.is_file() and path.read_bytes() == state_of(result)


def write_results(result: SuiteResult, stored: dict[str, dict[str, JudgedView]], out: Path) -> list[Path]:
    """Write everything into ``out``; ``stored`` are the scenes' own views as their captures have them."""
    out.mkdir(parents=True, exist_ok=True)
    (out / STATE_FILE).unlink(missing_ok=True)
    tables = tables_of(result)
    rows = {scene.name: scene_rows(scene, stored[scene.name]) for scene in result.scenes}
    content = {
        "evaluation.md": _markdown(result, tables).encode(),
        "evaluation.json": canonical_json(result),
        "index.html": _page(result, tables, rows).encode(),
        **{f"{table.name}.csv": table.csv().encode() for table in tables},
    }
    figures = out / "figures"
    shutil.rmtree(figures, ignore_errors=True)
    figures.mkdir()
    for name, scene in rows.items():
        content[f"figures/{name}-all.png"] = encode_png(sheet(scene, COLUMNS, is_turned=False))
        content[f"figures/{name}-relighting.png"] = encode_png(sheet(scene, RELIGHTING, is_turned=True))
    for file, data in content.items():
        write_bytes_atomically(out / file, data)
    write_bytes_atomically(out / STATE_FILE, state_of(result))
    return [out / file for file in content]


def _notes(result: SuiteResult) -> list[str]:
    """What a reader must know, beside the tables."""
    notes = [KNOWN_WARNING] if result.may_be_known else []
    for scene in result.scenes:
        width, height = scene.resolution
        notes.append(
            f"{scene.name}: {scene.num_views} photographs and {scene.num_novel} novel views of {width} x "
            f"{height}, {scene.path_samples:.0f} light paths a pixel on average; judged on "
            f"{len(scene.judged_views)} and {len(scene.novel_views)} of them."
        )
        for method in scene.methods:
            if method.skipped:
                notes.append(f"{scene.name}, {method.method}: left out, {method.skipped}.")
            elif method.checkpoint:
                notes.append(
                    f"{scene.name}, {method.method}: checkpoint {method.checkpoint}, atlas of "
                    f"{method.atlas_size} texels a side."
                )
    return notes


def _markdown(result: SuiteResult, tables: Sequence[Table]) -> str:
    notes = "\n".join(f"- {note}" for note in _notes(result))
    return "\n".join([f"# Suite {result.suite}", "", notes, "", *(table.markdown() for table in tables)])


_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 90rem; padding: 0 1rem;
       color: #1b1b1b; background: #fff; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 13px; }
th, td { border: 1px solid #ccc; padding: .2rem .5rem; text-align: right; } th { background: #f2f2f2; }
td:first-child, th:first-child, td:nth-child(2), th:nth-child(2) { text-align: left; }
tr.paper td { color: #555; font-style: italic; } .wide { overflow-x: auto; }
.pictures td { padding: 2px; border: 0; text-align: center; vertical-align: top; }
.pictures tr th, .pictures tr th:first-child { border: 0; background: none; text-align: center; }
td:first-child { white-space: nowrap; } .pictures img { display: block; min-width: 160px; }
"""


def _page(result: SuiteResult, tables: Sequence[Table], rows: dict[str, list[Row]]) -> str:
    title = f"Suite {result.suite}"
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in _notes(result))
    parts = [f"<h1>{html.escape(title)}</h1><ul>{notes}</ul>", *(table.html() for table in tables)]
    for scene in result.scenes:
        parts.append(_pictures(scene, rows[scene.name]))
    return (
        "<!doctype html><html lang=en><head><meta charset=utf-8>"
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def _jpeg(pixels: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", quality=_JPEG_QUALITY)
    return stream.getvalue()


def _pictures(scene: SceneResult, rows: Sequence[Row]) -> str:
    head = "".join(f"<th>{html.escape(column)}</th>" for column in COLUMNS)
    lines = []
    for row in rows:
        cells = []
        for column in COLUMNS:
            picture = row.pictures[column]
            if picture is None:
                cells.append("<td>none</td>")
                continue
            data = base64.b64encode(_jpeg(picture.pixels)).decode()
            text = html.escape(f"{scene.name}, {row.label}: {column}", quote=True)
            cells.append(f'<td><img alt="{text}" title="{text}" src="data:image/jpeg;base64,{data}"></td>')
        lines.append(f"<tr><th>{html.escape(row.label)}</th>{''.join(cells)}</tr>")
    views = ", ".join(f"{kind} {name}" for kind, name in scene.figure_views.items())
    return (
        f"<h2>{html.escape(scene.name)}</h2><p>Views: {html.escape(views)}. D and S sRGB-encoded, R as it "
        "is; images under the exposure of the tables.</p><div class=wide><table class=pictures>"
        f"<tr><th></th>{head}</tr>{''.join(lines)}</table></div>"
    )
