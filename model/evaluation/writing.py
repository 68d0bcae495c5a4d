# SPDX-License-Identifier: MIT
"""Results of a suite as files: Markdown, JSON, one CSV per table, pictures, and a self-contained page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from datagen.formats.base import (
    RelativePath,
    StrictModel,
    canonical_json,
    read_json,
    sha256_hex,
    write_bytes_atomically,
)
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png
from model.evaluation.charts import confidence_svg, overview_svg, standalone
from model.evaluation.page import page_html
from model.evaluation.pictures import COLUMNS, RELIGHTING, scene_rows, sheet
from model.evaluation.rendering import JudgedView
from model.evaluation.results import SuiteResult
from model.evaluation.tables import Table, tables_of

STATE_FILE = "state.json"
KNOWN_WARNING = (
    "Checkpoints may have been trained on these scenes: the figures test the program, not the checkpoints."
)


class _State(StrictModel):
    """Content of ``state.json``: hash of the result that is written, '' while writing, and its files."""

    revision: Literal[6] = 6
    result: str
    files: tuple[RelativePath, ...]


def _read_state(out: Path) -> _State:
    try:
        return read_json(_State, out / STATE_FILE)
    except InputError:
        return _State(result="", files=())  # nothing was written yet, or by another version


def _hash_of(result: SuiteResult) -> str:
    return sha256_hex(canonical_json(result))


def is_written(result: SuiteResult, out: Path) -> bool:
    """Return whether the folder ``out`` contains all files of ``result``."""
    state = _read_state(out)
    return state.result == _hash_of(result) and all((out / file).is_file() for file in state.files)


def write_results(result: SuiteResult, stored: dict[str, dict[str, JudgedView]], out: Path) -> list[Path]:
    """Write the results to the folder ``out``, in place of earlier ones, and return the paths; ``stored``
    contains the true views under the scenes' own light, by scene and view."""
    tables = tables_of(result)
    rows = {scene.name: scene_rows(scene, stored[scene.name]) for scene in result.scenes}
    content = {
        "evaluation.md": _markdown(result, tables).encode(),
        "evaluation.json": canonical_json(result),
        "index.html": page_html(result, _notes(result), tables, rows, stored).encode(),
        **{f"{table.name}.csv": table.csv().encode() for table in tables},
    }
    content["figures/overview.svg"] = standalone(overview_svg(result)).encode()
    if chart := confidence_svg(result):
        content["figures/confidence.svg"] = standalone(chart).encode()
    for name, scene in rows.items():
        content[f"figures/{name}-all.png"] = encode_png(sheet(scene, COLUMNS, is_turned=False))
        content[f"figures/{name}-relighting.png"] = encode_png(sheet(scene, RELIGHTING, is_turned=True))
    (out / "figures").mkdir(parents=True, exist_ok=True)
    earlier = _read_state(out).files
    begun = _State(result="", files=tuple(dict.fromkeys((*earlier, *content))))
    write_bytes_atomically(out / STATE_FILE, canonical_json(begun))
    for file in set(earlier) - content.keys():
        (out / file).unlink(missing_ok=True)
    for file, data in content.items():
        write_bytes_atomically(out / file, data)
    done = _State(result=_hash_of(result), files=tuple(content))
    write_bytes_atomically(out / STATE_FILE, canonical_json(done))
    return [out / file for file in content]


def _notes(result: SuiteResult) -> list[str]:
    """Notes on a suite's result that accompany the tables."""
    notes = [KNOWN_WARNING] if result.may_be_known else []
    notes += [f"{scene}: no figures, {' '.join(why.split())}." for scene, why in result.failures.items()]
    for scene in result.scenes:
        width, height = scene.resolution
        notes.append(
            f"{scene.name}: {scene.num_views} photographs and {scene.num_novel} novel views of {width} x "
            f"{height}, {scene.path_samples:.0f} light paths per pixel on average; judged on "
            f"{len(scene.judged_views)} and {len(scene.novel_views)} of them."
        )
        for method in scene.methods:
            if method.skipped:
                notes.append(f"{scene.name}, {method.label}: left out, {method.skipped}.")
            elif method.checkpoint:
                notes.append(
                    f"{scene.name}, {method.label}: checkpoint {method.checkpoint}, atlas of "
                    f"{method.atlas_size} texels per side."
                )
    return notes


def _markdown(result: SuiteResult, tables: Sequence[Table]) -> str:
    notes = "\n".join(f"- {note}" for note in _notes(result))
    return "\n".join([f"# Suite {result.suite}", "", notes, "", *(table.markdown() for table in tables)])
