# SPDX-License-Identifier: MIT
"""Parsers of untrusted JSON and XML that limit the number of values and the depth of nesting."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from datagen.foundation.budget import Budget
from datagen.foundation.errors import InputError, input_error

_OPENING = re.compile(r'"(?:[^"\\]|\\.)*"|[\[{\]}]', re.S)


def parse_json(text: str, where: str | Path, budget: Budget, remedy: str = "export it again") -> Any:
    """Parse JSON. Raises :class:`InputError` for invalid JSON, too many values or too many levels."""
    # an upper bound: every value but the first follows one of these characters, which strings also contain
    count = 1 + text.count(",") + text.count("[") + text.count("{")
    budget.spend("values", count, "document")
    try:
        return json.loads(text)
    except RecursionError:
        raise budget.exceeded("depth", _depth(text), "document") from None
    except ValueError as error:
        raise input_error(where, "", str(error)[:200], "valid JSON", remedy) from None


def _depth(text: str) -> int:
    depth = deepest = 0
    for match in _OPENING.finditer(text):
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(match[0], 0)
        deepest = max(deepest, depth)
    return deepest


class _Counter(ElementTree.TreeBuilder):
    """Tree builder that charges elements to a budget and checks their depth."""

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
