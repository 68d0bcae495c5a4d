# SPDX-License-Identifier: MIT
"""Options as dataclasses, current and former verbs, completion, and runs of planned folders."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import typer
from typer.testing import CliRunner

from datagen import cli as datagen
from datagen.foundation.command_line import with_options
from datagen.foundation.errors import InputError
from model import cli as materials
from tests.datagen.small_plan import plan_small


def _double(text: str) -> int:
    return 2 * int(text)


@dataclass(frozen=True)
class Shared:
    """Options of several verbs."""

    size: Annotated[int, typer.Option(min=1, help="Side.")] = 4
    hidden: int = 7


@dataclass(frozen=True)
class Given(Shared):
    """Options of one verb."""

    names: Annotated[tuple[str, ...], typer.Option("--name", help="Repeatable.")] = ()
    way: Annotated[Literal["orbit", "cameras"], typer.Option(help="Choice.")] = "orbit"
    twice: Annotated[float | None, typer.Option(parser=_double, help="Parsed.")] = None
    is_fast: Annotated[bool, typer.Option("--fast/--no-fast", help="Switch.")] = True


def _call(*words: str) -> Any:
    found: list[Any] = []
    app = typer.Typer(rich_markup_mode=None)

    @app.command()
    @with_options
    def verb(
        path: Annotated[Path, typer.Argument(help="File.")],
        given: Given,
        tags: Annotated[tuple[int, ...], typer.Option("--tag")] = (),
    ) -> None:
        """A verb."""
        found.extend((path, given, tags))

    result = CliRunner().invoke(app, words)
    return found if result.exit_code == 0 and found else result


def test_options_of_a_dataclass() -> None:
    assert _call("a") == [Path("a"), Given(), ()]
    words = (
        "a",
        "--size",
        "5",
        "--name",
        "x",
        "--name",
        "y",
        "--way",
        "cameras",
        "--twice",
        "3",
        "--no-fast",
    )
    made = Given(5, 7, ("x", "y"), "cameras", 6, False)
    assert _call(*words, "--tag", "1", "--tag", "2") == [Path("a"), made, (1, 2)]


@pytest.mark.parametrize("words", [("--size", "0"), ("--way", "up"), ("--hidden", "3"), ("--twice", "x")])
def test_wrong_options_are_refused(words: tuple[str, ...]) -> None:
    assert _call("a", *words).exit_code == 2


def test_help_shows_types_choices_and_defaults() -> None:
    text = _call("--help").output
    for shown in ("--size", "[default: 4", "--name", "orbit|cameras", "--fast / --no-fast", "A verb."):
        assert shown in text, text
    assert "hidden" not in text


def _verbs(app: typer.Typer) -> set[str]:
    return set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]


def test_the_verbs_are_few() -> None:
    assert len(_verbs(datagen.app)) + len(_verbs(materials.app)) <= 19


MOVED = [
    *((datagen.app, "datagen", [verb], new) for verb, new in datagen.MOVED.items()),
    *((materials.app, "materials", [verb], new) for verb, new in materials.MOVED.items()),
    (datagen.app, "datagen", ["farm", "collect"], "datagen run FOLDER --only index"),
]


@pytest.mark.parametrize(("app", "program", "words", "new"), MOVED, ids=[" ".join(m[2]) for m in MOVED])
def test_a_former_verb_names_its_replacement(
    app: typer.Typer, program: str, words: list[str], new: str
) -> None:
    assert words[-1] not in _verbs(app)
    result = CliRunner().invoke(app, [*words, "room", "--out", "x"], prog_name=program)
    assert isinstance(result.exception, InputError)
    assert str(result.exception) == f"{program} {' '.join(words)}: is now `{new}`"


def test_a_former_verb_ends_with_code_2() -> None:
    command = [sys.executable, "-m", "datagen", "render", "rooms", "--workers", "2"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert "datagen run FOLDER --only render" in done.stderr


@pytest.mark.parametrize(
    ("program", "module", "words", "expected"),
    [
        ("datagen", "datagen.cli", "datagen ver", "verify"),
        ("datagen", "datagen.cli", "datagen run x --onl", "--only"),
        ("datagen", "datagen.cli", "datagen run x --only st", "stats"),
        ("materials", "model.cli", "materials inf", "infer"),
    ],
)
def test_shell_completion_works(program: str, module: str, words: str, expected: str) -> None:
    code = f"import sys; sys.argv = ['{program}']; from {module} import main; main()"
    asked = {
        f"_{program.upper()}_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **asked}, capture_output=True, text=True
    )
    assert done.stdout.split() == [expected], done.stderr


def test_a_dry_run_of_a_planned_folder_prints_the_remaining_work(tmp_path: Path) -> None:
    folder = plan_small(tmp_path / "set", tmp_path / "library", 2, 3)
    before = sorted(folder.root.rglob("*"))
    for words, expected in (
        ((), "2 of 2 units are not done: render, stats, pack"),
        (("--only", "pack", "--unit", "1"), "1 of 1 units are not done: pack"),
        (("--only", "index"), "2 of 2 units are not done: index"),
    ):
        done = CliRunner().invoke(datagen.app, ["run", str(folder.root), "--dry-run", *words])
        assert done.exit_code == 0 and expected in done.output, done.output
    assert sorted(folder.root.rglob("*")) == before


def test_the_index_alone_ends_with_1_while_units_are_missing(tmp_path: Path) -> None:
    folder = plan_small(tmp_path / "set", tmp_path / "library", 1, 3)
    done = CliRunner().invoke(datagen.app, ["run", str(folder.root), "--only", "index"])
    assert done.exit_code == 1 and "1 units are not done; the first is small-00000" in done.output
    assert folder.index_path.is_file()
