# SPDX-License-Identifier: MIT
"""Summary of an import for the terminal, with similar sentences merged."""

from __future__ import annotations

import re
from collections.abc import Sequence

from datagen.importers.common import ImportedAsset

_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_NAMED, _LINES = 3, 6


def summary_lines(asset: ImportedAsset) -> list[str]:
    """Return the lines of a terminal summary of an imported asset; ``import.json`` has all but warnings."""
    lines = [f"{asset.kind} {asset.asset_id} ({asset.license}): {asset.contents}; {asset.path}"]
    for label, sentences in (("approximated", asset.approximations), ("note", asset.notes)):
        grouped = group_sentences(sentences)
        lines += [f"  {label}: {sentence}" for sentence in grouped[:_LINES]]
        if len(grouped) > _LINES:
            where = f"{asset.path}: import.json"
            if label == "note":
                where += f" or, if warnings, `datagen library {asset.path} --check`"
            lines.append(f"  {label}: {len(grouped) - _LINES} more kinds, all of them in {where}")
    return lines


def group_sentences(sentences: Sequence[str]) -> list[str]:
    """Merge sentences ``name: text`` whose texts differ only in numbers; the most frequent are first.

    If numbers differ, those of the first sentence are shown, with a remark.
    """
    groups: dict[tuple[bool, str], list[tuple[str, str]]] = {}
    for sentence in sentences:
        name, colon, what = sentence.partition(": ")
        if not colon:
            name, what = "", sentence
        groups.setdefault((bool(colon), _NUMBER.sub("#", what)), []).append((name, what))
    lines = []
    for (has_name, _), found in sorted(groups.items(), key=lambda item: -len(item[1])):
        names = list(dict.fromkeys(name for name, _ in found))
        shown = ", ".join(names[:_NAMED])
        if len(names) > _NAMED:
            shown += f" and {len(names) - _NAMED} more"
        what = found[0][1]
        if len({text for _, text in found}) > 1:
            what += " (figures differ)"
        lines.append(f"{shown}: {what}" if has_name else what)
    return lines
