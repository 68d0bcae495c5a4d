# SPDX-License-Identifier: MIT
"""Terminal output of imports: progress bars, summaries of assets, and tables of furniture catalogues."""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.foundation.progress import Bars

if TYPE_CHECKING:
    from datagen.importers.common import ImportedAsset
    from datagen.importers.sweet_home import Step

_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_NAMED, _LINES = 3, 6  # maximum numbers of names per line, and of lines per kind of remark


class ImportWatch:
    """Context manager that shows progress bars: one for all sources, if on a terminal, and one per catalogue.

    On exit, also after an error, it prints summaries of the assets and of the catalogues.
    """

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self._bars: Bars | None = None
        self._done: Counter[Path] = Counter()
        self._lines: list[str] = []

    def __enter__(self) -> ImportWatch:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bars is None:
            return
        self._bars.__exit__(*exception)
        for line in self._lines:
            print(line)
        if self.steps:
            self._print_summary()
            if exception[0] is KeyboardInterrupt:
                print("interrupted; run the same command again to continue")

    def begin(self, path: Path, done: int, total: int) -> None:
        """Show that the import of the source at ``path`` begins, after ``done`` of ``total`` sources."""
        if sys.stderr.isatty():
            self._shown_bars().tell("import", done, total, path.name)

    def show(self, asset: ImportedAsset) -> None:
        """Print the summary of an asset to standard output, after the bars if there are any."""
        lines = summary_lines(asset)
        if self._bars is None:
            print("\n".join(lines))
        else:
            self._lines += lines

    def step(self, path: Path, step: Step, total: int) -> None:
        """Show one finished piece of the catalogue at ``path``, which has ``total`` pieces."""
        self._done[path] += 1
        self._shown_bars().tell(path.stem, self._done[path], total, step.name)
        self.steps.append(step)

    def _shown_bars(self) -> Bars:
        if self._bars is None:
            self._bars = Bars().__enter__()
        return self._bars

    def _print_summary(self) -> None:
        from rich.table import Table

        from datagen.foundation.progress import table_console

        table = Table("category", "imported", "already present", "refused")
        by_category: dict[str, Counter[str]] = {}
        for step in self.steps:
            by_category.setdefault(step.category or "unknown", Counter())[step.outcome] += 1
        total: Counter[str] = Counter()
        for category, counts in sorted(by_category.items(), key=lambda item: (-item[1].total(), item[0])):
            table.add_row(category, *(str(counts[k] or "") for k in ("imported", "kept", "refused")))
            total.update(counts)
        table.add_section()
        table.add_row("all", *(str(total[k]) for k in ("imported", "kept", "refused")))
        console = table_console()
        console.print(table)
        reasons = Counter(
            f"{' '.join(p.field.split()[:1]) or 'model'}: {p.got}" if len(p.got) < 60 else p.field or "model"
            for step in self.steps
            if step.outcome == "refused"
            for p in step.problems[:1]
        )
        if reasons:
            refused = Table("refused because", "pieces")
            for reason, count in reasons.most_common():
                refused.add_row(reason, str(count))
            console.print(refused)


def summary_lines(asset: ImportedAsset) -> list[str]:
    """Return an asset's summary; ``import.json`` lists all its remarks except warnings of its check."""
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
    """Merge sentences ``name: text`` whose texts differ only in numbers, and sort them by frequency.

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
