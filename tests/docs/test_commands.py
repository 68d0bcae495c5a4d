# SPDX-License-Identifier: MIT
"""The commands of the README and of every page are classified, exist and work."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.docs.cli_check import check_command
from tests.docs.pages import DECISIONS, PAGES, Block, Page, commands_of, read_page
from tests.docs.stand_ins import STAND_INS, StandIns

READ = {path: read_page(path) for path in (*PAGES, *DECISIONS)}
ACTIONS = ("run", "run slow", "not run", "file", "patch")
HOW = "put `<!-- test: run -->` or another of the notes in tests/docs/pages.py before it"


def _names(pages: list[Path]) -> list[str]:
    return [str(path.relative_to(REPOSITORY)) for path in pages]


def test_every_command_is_classified() -> None:
    problems = []
    for page in READ.values():
        problems += [f"{page.path.name}:{line}: commands without a fence" for line in page.indented]
        for block in page.blocks:
            if block.is_command and block.action not in ACTIONS:
                problems.append(f"{block}: {block.text.splitlines()[0]!r} is not classified: {HOW}")
            if block.action == "not run" and len(block.reason) < 8:
                problems.append(f"{block}: say why it is not run")
            problems += [f"{block}: no stand-in {name!r}" for name in block.needs if name not in STAND_INS]
    assert problems == []


@pytest.mark.parametrize("path", list(READ), ids=_names(list(READ)))
def test_every_command_exists(path: Path) -> None:
    page, problems = READ[path], []
    for block in page.blocks:
        if block.is_command and not block.is_python:
            for words in commands_of(block.text):
                problems.append((block.line, words, check_command(words, is_whole=True)))
    for line, span in page.spans:
        if span.split()[0] in ("datagen", "materials", "make", "python", "pytest", "torchrun"):
            for words in commands_of(span):
                problems.append((line, words, check_command(words, is_whole=False)))
    assert [f"{path.name}:{line}: {' '.join(w)}: {p}" for line, w, p in problems if p] == []


def test_a_command_that_does_not_exist_is_found() -> None:
    """Injected fault: unknown commands are found."""
    wrong = (
        "datagen rnu recipe.yaml --out x",
        "datagen run recipe.yaml --out x --wrokers 2",
        "datagen run --out x",
        "datagen farm submit x --cpus none",
        "materials train rooms",
        "make demos",
        "make demo OTU=x",
        "python -m benchmarks.bench_nothing",
        "python -m datagen.tradeoff rooms --out x --swep samples",
        "python -m benchmarks.bench_solver --nothing",
        "python benchmarks/bench_nothing.py",
        "pytest tests/nothing.py",
        "pytest tests/docs -k no_such_test",
        "torchrun --nproc-per-node 4 -m model.cli train rooms --otu x",
    )
    assert [line for line in wrong if not check_command(commands_of(line)[0], is_whole=True)] == []


@pytest.fixture(scope="session")
def stand_ins(tmp_path_factory: pytest.TempPathFactory) -> StandIns:
    return StandIns(tmp_path_factory.mktemp("stand-ins"))


def _run_page(page: Page, actions: tuple[str, ...], folder: Path, stand_ins: StandIns) -> None:
    stand_ins.begin(folder)
    for block in page.blocks:
        if block.action not in actions:
            continue
        for name in block.needs:
            stand_ins.bring(name, folder)
        _run_block(block, folder)


def _run_block(block: Block, folder: Path) -> None:
    if block.action == "file":
        path = folder / block.note.removeprefix("file").partition(";")[0].strip()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(block.text + "\n")
        return
    if block.action == "patch":
        command, given = ["git", "apply", "--recount", "-C1", "-"], block.text + "\n"
    elif block.is_python:
        command, given = [sys.executable, "-"], block.text
    else:
        command, given = ["bash", "-euo", "pipefail"], block.text
    source = folder if (folder / "datagen").is_dir() else REPOSITORY
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(source),
        "MPLBACKEND": "agg",
    }
    done = subprocess.run(command, input=given, cwd=folder, env=environment, capture_output=True, text=True)
    output = f"{done.stdout[-2000:]}{done.stderr[-4000:]}"
    assert done.returncode == 0, f"{block}: ended with {done.returncode}\n{block.text}\n{output}"


FAST = [p for p, page in READ.items() if any(b.action == "run" for b in page.blocks)]
SLOW = [p for p, page in READ.items() if any(b.action == "run slow" for b in page.blocks)]


@pytest.mark.parametrize("path", FAST, ids=_names(FAST))
def test_the_commands_of_a_page_work(path: Path, tmp_path: Path, stand_ins: StandIns) -> None:
    """Blocks must not depend on files written by slow blocks, which are not run here."""
    _run_page(READ[path], ("run", "file", "patch"), tmp_path, stand_ins)


@pytest.mark.slow
@pytest.mark.parametrize("path", SLOW, ids=_names(SLOW))
def test_the_long_commands_of_a_page_work(path: Path, tmp_path: Path, stand_ins: StandIns) -> None:
    _run_page(READ[path], ("run", "run slow", "file", "patch"), tmp_path, stand_ins)
