# SPDX-License-Identifier: MIT
"""Progress of imports, and the summary table of imported furniture catalogues."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.foundation.progress import Bars

if TYPE_CHECKING:
    from datagen.importers.common import ImportedAsset
    from datagen.importers.sweet_home import Step


class ImportWatch:
    """Context that shows a progress bar of the sources, on a terminal, and of each catalogue.

    At the end or after an error, it prints the records of assets and a summary of the catalogues.
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
        """Print the record of an asset to standard output, after the bars if there are any."""
        from datagen.importers.summary import summary_lines

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
