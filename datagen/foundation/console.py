# SPDX-License-Identifier: MIT
"""Console for tables: as wide as the terminal or, elsewhere, as wide as the tables need."""

from __future__ import annotations

from rich.console import Console

_UNBOUNDED = 100_000  # characters; tables and lines use as much of it as they need


def table_console() -> Console:
    """A console on standard output.

    In a pipe or a file nothing is cut or wrapped, so that ids stay complete; square brackets are text, not
    styles.
    """
    console = Console(markup=False)
    return console if console.is_terminal else Console(width=_UNBOUNDED, markup=False)
