# SPDX-License-Identifier: MIT
"""Console for tables: as wide as the terminal, and as wide as the tables need elsewhere."""

from __future__ import annotations

from rich.console import Console

_UNBOUNDED = 100_000  # characters; tables and lines take what they need of it


def table_console() -> Console:
    """A console on standard output. Into a pipe or a file nothing is cut or wrapped, so that ids stay ids;
    square brackets are text, not styles."""
    console = Console(markup=False)
    return console if console.is_terminal else Console(width=_UNBOUNDED, markup=False)
