# SPDX-License-Identifier: MIT
"""Parsers of untrusted JSON and XML that limit the number of values and the nesting, and checks of zips."""

from __future__ import annotations

import json
import re
import stat
import struct
import xml.etree.ElementTree as ElementTree
import zipfile
import zlib
from itertools import accumulate
from pathlib import Path
from typing import Any

from datagen.foundation.budget import Budget
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems

_OPENING = re.compile(r'"(?:[^"\\]|\\.)*"|[\[{\]}]', re.S)
# exceptions that zipfile raises for damaged archives, found by fuzzing
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError, ValueError, OSError)
_REMEDY = "get the archive from a trusted source, or pack it again as a plain zip"


def parse_json(text: str, where: str | Path, budget: Budget, remedy: str = "export it again") -> Any:
    """Parse JSON. Raises :class:`InputError` for invalid JSON, too many values or too many levels."""
    # an upper bound: a comma or bracket precedes every value but the first; strings may contain more of them
    count = 1 + text.count(",") + text.count("[") + text.count("{")
    budget.spend("values", count, "document")
    try:
        return json.loads(text)
    except RecursionError:
        raise budget.exceeded("depth", _depth(text), "document") from None
    except ValueError as error:
        raise input_error(where, "", str(error)[:200], "valid JSON", remedy) from None


def _depth(text: str) -> int:
    steps = ({"[": 1, "{": 1, "]": -1, "}": -1}.get(match[0], 0) for match in _OPENING.finditer(text))
    return max(accumulate(steps, initial=0))


class _Counter(ElementTree.TreeBuilder):
    """Tree builder that charges each element to a budget and checks its depth while parsing."""

    def __init__(self, budget: Budget):
        super().__init__()
        self._budget, self._depth = budget, 0

    def start(self, tag: Any, attrs: Any) -> ElementTree.Element:
        self._depth += 1
        self._budget.check_depth(self._depth, f"<{tag}>"[:40])
        self._budget.spend("nodes", 1, f"<{tag}>"[:40])
        return super().start(tag, attrs)

    def end(self, tag: Any) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)


def parse_xml(
    text: str, where: str | Path, budget: Budget, remedy: str = "export it again"
) -> ElementTree.Element:
    """Parse an XML document to its root element.

    Raises :class:`InputError` for invalid XML, a DOCTYPE or entities, too many elements or levels.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities can read other files or fill the memory
        raise input_error(where, "", "a DOCTYPE or ENTITY", "plain XML", "remove it")
    try:
        root: ElementTree.Element = ElementTree.fromstring(
            text, ElementTree.XMLParser(target=_Counter(budget))
        )
        return root
    except (ElementTree.ParseError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise input_error(where, "", str(error)[:200], "well-formed XML", remedy) from None


def check_archive(archive: zipfile.ZipFile, path: Path, budget: Budget) -> None:
    """Raise :class:`InputError` if the open zip file ``path`` is unsafe to unpack.

    An archive is unsafe if it contains duplicate names, paths that lead out of it, links, devices, encrypted
    members, compression other than deflate, or more members or bytes than the ``budget`` allows.
    """
    budget.hold_file(path)
    members = archive.infolist()
    budget.spend("nodes", len(members), "members")
    budget.spend("bytes", sum(member.file_size for member in members), "unpacked members")
    problems, seen = [], set()
    for member in members:
        fault = "occurs twice" if member.filename in seen else _fault_of(member)
        seen.add(member.filename)
        if fault:
            expected = "plain files inside the archive"
            problems.append(Problem(path, f"member {member.filename!r}", fault, expected, _REMEDY))
    raise_problems(problems)


def _fault_of(member: zipfile.ZipInfo) -> str:
    name, mode = member.filename, member.external_attr >> 16
    parts = name.replace("\\", "/").rstrip("/").split("/")
    if name.startswith("/") or ":" in name or "\\" in name or any(p in ("", ".", "..") for p in parts):
        return "points outside the archive"
    if stat.S_ISLNK(mode):
        return "is a symbolic link"
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
        return "is a device or another special file"
    if member.flag_bits & 1:
        return "is encrypted"
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return f"is compressed by method {member.compress_type}"
    return ""
