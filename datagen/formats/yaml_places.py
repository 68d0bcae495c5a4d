# SPDX-License-Identifier: MIT
"""Positions of fields in a YAML file as line and column."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import yaml
from yaml.nodes import MappingNode, Node, SequenceNode

_MERGE = "<<"


class YamlPlaces:
    """Callable that maps a field's location in a validation error to its position in a YAML document."""

    def __init__(self, path: Path, text: str):
        self.path = path
        self._root: Node | None = yaml.compose(text, Loader=yaml.SafeLoader)

    def __call__(self, location: tuple[int | str, ...]) -> str:
        """Return ``FILE:LINE:COLUMN`` of a field, or of its parent if the field is missing.

        Parts of a location that are not keys are skipped, since pydantic inserts the type chosen in a union.
        """
        mark, node = (self._root.start_mark if self._root is not None else None), self._root
        for part in location:
            found = _entry(node, part)
            if found is not None:
                mark, node = found
        return f"{self.path}:{mark.line + 1}:{mark.column + 1}" if mark is not None else str(self.path)


def syntax_error(path: Path, error: yaml.YAMLError) -> tuple[str, str]:
    """Return the position and description of a YAML syntax error."""
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None)
    if mark is None or problem is None:
        return str(path), " ".join(str(error).split())
    context = getattr(error, "context", None)
    return f"{path}:{mark.line + 1}:{mark.column + 1}", f"{problem} {context}" if context else problem


def _entry(node: Node | None, part: int | str) -> tuple[yaml.Mark, Node] | None:
    """Return the start and value of a node's entry ``part`` (key or index), or None if there is none."""
    if isinstance(node, SequenceNode):
        if isinstance(part, int) and 0 <= part < len(node.value):
            return node.value[part].start_mark, node.value[part]
        return None
    if not isinstance(node, MappingNode):
        return None
    for key, value in node.value:
        if key.value == str(part):
            return key.start_mark, value
    for merged in _merged(node):
        found = _entry(merged, part)
        if found is not None:
            return found
    return None


def _merged(node: MappingNode) -> Iterator[Node]:
    """Yield the mappings that ``<<`` merges into ``node``."""
    for key, value in node.value:
        if key.value == _MERGE:
            yield from value.value if isinstance(value, SequenceNode) else (value,)
