# SPDX-License-Identifier: MIT
"""Progress bar and summary table of an import of furniture catalogues."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.foundation.progress import Bars

if TYPE_CHECKING:
    from datagen.importers.sweet_home import Step


class ImportWatch:
    """Context manager that shows a progress bar per catalogue and, at the end or after an error, a summary.

    Nothing is shown, and rich is not loaded, until the first step is reported.
    """

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self._bars: Bars | None = None
        self._done: Counter[Path] = Counter()

    def __enter__(self) -> ImportWatch:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bars is None:
            return
        self._bars.__exit__(*exception)
        self._print_summary()
        if exception[0] is KeyboardInterrupt:
            print("interrupted; run the same command again to continue")

    def step(self, path: Path, step: Step, total: int) -> None:
        """Show one finished piece of the catalogue at ``path``, which has ``total`` pieces."""
        if self._bars is None:
            self._bars = Bars("pieces").__enter__()
        self._done[path] += 1
        self._bars.tell(path.stem, self._done[path], total, step.name)
        self.steps.append(step)

    def _print_summary(self) -> None:
        from rich.table import Table

        from datagen.foundation.console import table_console

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
