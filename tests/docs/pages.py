# SPDX-License-Identifier: MIT
"""Finds the commands of the README and the documentation, and the notes on how to test them.

A fenced block of commands or Python is preceded by an HTML comment: ``<!-- test: run -->`` runs it, ``run;
needs rooms, sofa`` runs it with these stand-ins (stand_ins.py), ``run slow`` runs it only in the slow tests,
``not run; REASON`` excludes it, ``file NAME`` writes it to a file that later blocks use, and ``patch``
applies it to the stand-in `source`.

The blocks of a page run one after another in one folder.
"""

from __future__ import annotations

import re
import shlex
import textwrap
from dataclasses import dataclass, field
from pathlib import Path

from tests.conftest import REPOSITORY

PAGES = (
    REPOSITORY / "README.md",
    REPOSITORY / "CONTRIBUTING.md",
    *sorted(p for p in (REPOSITORY / "docs").rglob("*.md") if "decisions" not in p.parts),
)
DECISIONS = tuple(sorted((REPOSITORY / "docs" / "decisions").glob("*.md")))
PROGRAMS = (
    "datagen", "materials", "make", "python", "python3", "pip", "pytest", "torchrun", "tensorboard", "source",
    "apt-get", "git", "curl", "unzip", "cd", "docker", "sbatch", "blender", "mkdocs",
)  # fmt: skip
SHELLS = ("", "sh", "bash", "console", "shell")
_FENCE = re.compile(r"^(?P<indent> *)(?P<ticks>```+|~~~+) *(?P<language>[\w.+-]*)(?P<rest>.*)$")
_NOTE = re.compile(r"^ *<!-- test: (?P<text>.+?) -->$")
_SPAN = re.compile(r"(?<!`)`([^`\n]+(?:\n[^`\n]+)?)`(?!`)")


@dataclass(frozen=True)
class Block:
    """A fenced block: ``line`` is the line number of its fence, ``note`` the comment before it, or ""."""

    page: Path
    line: int
    language: str
    text: str
    note: str = ""

    def __str__(self) -> str:
        return f"{self.page.relative_to(REPOSITORY)}:{self.line}"

    @property
    def action(self) -> str:
        """Action in the note: ``run``, ``run slow``, ``not run``, ``file``, ``patch`` or ""."""
        words = self.note.partition(";")[0].split()
        return words[0] if words[:1] in (["file"], ["patch"]) else " ".join(words)

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the required stand-ins."""
        rest = self.note.partition(";")[2].strip()
        return tuple(re.split(r", *", rest.removeprefix("needs "))) if rest.startswith("needs ") else ()

    @property
    def reason(self) -> str:
        """Text after the semicolon: why the block is not run."""
        return self.note.partition(";")[2].strip()

    @property
    def is_python(self) -> bool:
        return self.language == "python"

    @property
    def is_command(self) -> bool:
        """True if the block needs a note: Python, a shell language, or lines that begin with a program."""
        if self.is_python or self.language in SHELLS[1:]:
            return True
        return self.language == "" and any(_program(line) for line in self.text.splitlines())


@dataclass
class Page:
    """Blocks of a page, and the commands within its sentences."""

    path: Path
    blocks: list[Block] = field(default_factory=list)
    spans: list[tuple[int, str]] = field(default_factory=list)
    indented: list[int] = field(default_factory=list)


def _program(line: str) -> str:
    words = line.split()
    return words[0] if words and words[0] in PROGRAMS and len(words) > 1 else ""


def read_page(path: Path) -> Page:
    """Blocks and inline commands of a page, in order."""
    page = Page(path)
    prose: list[str] = []
    note, lines, number = "", path.read_text(encoding="utf-8").splitlines(), 0
    while number < len(lines):
        line = lines[number]
        opened = _FENCE.match(line)
        if opened:
            closing = next(
                (
                    i
                    for i in range(number + 1, len(lines))
                    if lines[i].strip().startswith(opened["ticks"]) and not lines[i].strip(" `~")
                ),
                len(lines),
            )
            text = textwrap.dedent("\n".join(lines[number + 1 : closing]))
            page.blocks.append(Block(path, number + 1, opened["language"], text, note))
            prose += [""] * (closing - number + 1)
            note, number = "", closing + 1
            continue
        found = _NOTE.match(line)
        if found:
            note = found["text"]
        elif line.strip():
            note = ""
        if re.match(r" {4,}\S", line) and prose and not prose[-1].strip() and _program(line):
            page.indented.append(number + 1)
        prose.append(line)
        number += 1
    text = "\n".join(prose)
    for match in _SPAN.finditer(text):
        page.spans.append((text.count("\n", 0, match.start()) + 1, " ".join(match[1].split())))
    return page


def commands_of(text: str) -> list[list[str]]:
    """Words of each simple command of a shell block; comments, continuations and ``&&`` are resolved."""
    joined = re.sub(r"\\\n\s*", " ", text)
    found: list[list[str]] = []
    for line in joined.splitlines():
        line = line.removeprefix("$ ")
        lexer = shlex.shlex(line, posix=True, punctuation_chars="|&;<>")
        lexer.whitespace_split = True
        command: list[str] = []
        for word in lexer:
            if set(word) <= set("|&;<>"):
                found.append(command)
                command = []
            elif not (not command and re.match(r"^[A-Z_]+=", word)):
                command.append(word)
        found.append(command)
    return [command for command in found if command]
