# SPDX-License-Identifier: MIT
"""The notebook runs from top to bottom: reduced in the fast tests, unchanged in the slow ones."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import REPOSITORY

nbformat = pytest.importorskip("nbformat", reason="needs the extra notebook")
NOTEBOOK = REPOSITORY / "docs" / "tutorials" / "round-trip.ipynb"
SMALL = {"SIZE": (48, 36), "VIEWS": 3, "STEPS": 2, "ATLAS": 128}
HANGS_S = 1800
"""Limit of a cell's time in seconds; a busy machine may be many times slower than an idle one."""
PROCESSOR_S = 300
"""Limit of the notebook's processor seconds; unchanged, it takes 168 s on two shared cores."""


def _parameters(out: Path, library: Path | None) -> str:
    given: dict[str, Any] = {"LIBRARY": str(library), **SMALL} if library else {}
    return "\n".join([f"OUT = Path({str(out)!r})", *(f"{name} = {value!r}" for name, value in given.items())])


def _processor_s() -> float:
    """Processor seconds of ended child processes and their descendants."""
    times = os.times()
    return times.children_user + times.children_system


def execute(out: Path, library: Path | None = None) -> Any:
    """Run the notebook with changed parameters in a separate process and return it with its outputs."""
    from nbclient import NotebookClient

    book = nbformat.read(NOTEBOOK, as_version=4)
    cell = next(c for c in book.cells if "parameters" in c.metadata.get("tags", ()))
    cell.source += "\n" + _parameters(out, library)
    size = "small" if library else "as it is"
    before = _processor_s()
    NotebookClient(book, timeout=HANGS_S, resources={"metadata": {"path": str(out.parent)}}).execute()
    spent = _processor_s() - before
    print(f"the notebook, {size}: {spent:.0f} s of processor time")
    assert 5 < spent < PROCESSOR_S
    return book


def _num_pictures(book: Any) -> int:
    outputs = [output for cell in book.cells for output in cell.get("outputs", ())]
    assert not [output for output in outputs if output.output_type == "error"]
    return sum("image/png" in output.get("data", {}) for output in outputs)


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the notebook's kernel with this Python and this repository."""
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")


def test_no_outputs_are_stored() -> None:
    """The stored notebook has neither outputs nor execution counts."""
    for cell in nbformat.read(NOTEBOOK, as_version=4).cells:
        if cell.cell_type == "code":
            assert cell.outputs == [] and cell.execution_count is None


@pytest.mark.usefixtures("kernel")
def test_notebook_runs_with_a_small_library(tmp_path: Path) -> None:
    from tests.datagen.small_library import write_small_library

    library = tmp_path / "library"
    write_small_library(library, num_rooms=2)
    out = tmp_path / "round-trip"
    assert _num_pictures(execute(out, library)) == 3
    assert len(list((out / "night").glob("*.png"))) == 3


@pytest.mark.slow
@pytest.mark.usefixtures("kernel")
def test_notebook_runs_unchanged(tmp_path: Path) -> None:
    assert _num_pictures(execute(tmp_path / "round-trip")) == 3
