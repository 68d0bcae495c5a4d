# SPDX-License-Identifier: MIT
"""Checks documented commands against the real command lines: verb, options and choices."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import typer

from datagen.cli import app as datagen
from datagen.formats.schemas import main as schemas
from datagen.inspection.render_package import main as render_package
from datagen.tradeoff.command import tradeoff
from model.cli import app as materials
from model.publish import main as publish
from model.schemas import main as schemas_of_model
from model.training.fetch_weights import main as fetch_weights
from tests.conftest import REPOSITORY

_TARGETS = set(re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.M))
_APPS = {"datagen": datagen, "materials": materials}
MODULES = {
    "datagen.formats.schemas": schemas,
    "datagen.inspection.render_package": render_package,
    "datagen.tradeoff": tradeoff,
    "model.publish": publish,
    "model.schemas": schemas_of_model,
    "model.training.fetch_weights": fetch_weights,
}
"""Function of each command that is run by ``python -m``."""
_STANDARD = {"venv", "pip", "http.server", "pytest", "ensurepip", "zipfile"}


def check_command(words: list[str], is_whole: bool) -> str:
    """Return the fault of a command line, or "" if it has none or belongs to another project.

    ``is_whole`` requires all arguments; a mention in a sentence may omit them.
    """
    words = [w for w in words if w not in ("...", "…")]
    if words[0] in ("nice", "time", "env"):
        words = words[1:]
    if words[0] == "torchrun":
        words = ["python", *words[words.index("-m") :]] if "-m" in words else words[:1]
    program = Path(words[0]).name
    if program in _APPS:
        return _check_typer(_APPS[program], program, words[1:], is_whole)
    if program == "make":
        return _check_make(words[1:])
    if program in ("python", "python3", "python3.11"):
        return _check_python(words[1:], is_whole)
    if program == "pytest":
        return _check_pytest(words[1:])
    return ""


def _check_typer(app: typer.Typer, name: str, words: list[str], is_whole: bool) -> str:
    command: Any = typer.main.get_command(app)
    while hasattr(command, "commands"):
        own = {option for parameter in command.params for option in (*parameter.opts, "--help")}
        if not words or (len(words) == 1 and words[0] in own):
            return ""
        if words[0] not in command.commands:
            return f"{name} has no verb {words[0]!r}"
        name, command, words = f"{name} {words[0]}", command.commands[words[0]], words[1:]
    if "--help" in words:
        return ""
    for parameter in command.params:
        parameter.prompt = None  # a check asks for no values
    try:
        command.make_context(name, list(words))
    except Exception as error:
        if type(error).__name__ == "MissingParameter" and not is_whole:
            return ""
        # A mention such as `--workers N` names an option, not a value.
        if type(error).__name__ == "BadParameter" and not is_whole:
            return ""
        return f"{name}: {getattr(error, 'message', '') or type(error).__name__}"
    return ""


def _check_make(words: list[str]) -> str:
    makefile = (REPOSITORY / "Makefile").read_text()
    for word in words:
        variable = word.partition("=")[0]
        if "=" in word and not re.search(rf"\b{variable}\b", makefile):
            return f"the Makefile knows no variable {variable}"
        if "=" not in word and not word.startswith("-") and word not in _TARGETS:
            return f"the Makefile has no target {word!r}"
    return ""


def _check_python(words: list[str], is_whole: bool) -> str:
    if words[:1] == ["-m"] and len(words) > 1:
        module = words[1]
        if module == "pytest":
            return _check_pytest(words[2:])
        if module == "datagen":
            return _check_typer(datagen, "datagen", words[2:], is_whole)
        if module == "model.cli":
            return _check_typer(materials, "materials", words[2:], is_whole)
        if module in MODULES:
            alone = typer.Typer(add_completion=False)
            alone.command()(MODULES[module])
            return _check_typer(alone, module, words[2:], is_whole)
        if module in _STANDARD:
            return ""
        path = REPOSITORY.joinpath(*module.split("."))
        if path.is_dir():
            sources = sorted(path.glob("*.py"))
            if not (path / "__main__.py").exists():
                return f"{module} cannot be run"
        elif path.with_suffix(".py").is_file():
            sources = [path.with_suffix(".py")]
        else:
            return f"no module {module}"
    elif words and words[0].endswith(".py"):
        path = REPOSITORY / words[0]
        if not path.is_file():
            return "" if "/" not in words[0] else f"no file {words[0]}"
        sources = [path]
    else:
        return ""
    text = "".join(source.read_text() for source in sources)
    for word in words[1:]:
        option = word.partition("=")[0]
        if option.startswith("--") and f'"{option}"' not in text:
            return f"{words[1] if words[0] == '-m' else words[0]} has no option {option}"
    return ""


def _check_pytest(words: list[str]) -> str:
    paths = [REPOSITORY / w.partition("::")[0] for w in words if w.startswith("tests")]
    for path in paths:
        if not path.exists():
            return f"no tests at {path.relative_to(REPOSITORY)}"
    if "-k" in words:
        names = _test_names(paths or [REPOSITORY / "tests"])
        for word in re.findall(r"\w+", words[words.index("-k") + 1]):
            if word not in ("and", "or", "not") and not any(word.lower() in n.lower() for n in names):
                return f"-k {word} selects no test"
    return ""


def _test_names(paths: list[Path]) -> list[str]:
    files = [f for p in paths for f in ([p] if p.is_file() else sorted(p.rglob("test_*.py")))]
    names: list[str] = []
    for file in files:
        names.append(file.name)
        names += [n.name for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, ast.FunctionDef)]
        names += re.findall(r"id=\"([^\"]+)\"", file.read_text())
    return names
