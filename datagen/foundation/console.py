# SPDX-License-Identifier: MIT
"""Console for tables: as wide as the terminal or, elsewhere, as wide as the tables need."""

from __future__ import annotations

from rich.console import Console

_UNBOUNDED = 100_000  # characters; tables and lines use only the width that they need


def table_console() -> Console:
    """Return a console on standard output that prints square brackets as text, not as styles.

    Lines to a pipe or a file are neither cut nor wrapped, so ids stay complete.
    """
    console = Console(markup=False)
    return console if console.is_terminal else Console(width=_UNBOUNDED, markup=False)
