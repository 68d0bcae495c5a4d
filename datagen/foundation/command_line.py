# SPDX-License-Identifier: MIT
"""How the project's commands end, whichever of them runs."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable
from typing import Annotated

import typer

_REMEDIES = {
    errno.ENOENT: "check the path",
    errno.EACCES: "choose a place that you may read and write, or ask for the rights",
    errno.EPERM: "choose a place that you may read and write, or ask for the rights",
    errno.EROFS: "choose a place that can be written to",
    errno.EEXIST: "choose another name, or remove what is there",
    errno.ENOTDIR: "a part of the path is a file; choose a folder",
    errno.EISDIR: "name a file",
    errno.ENAMETOOLONG: "choose a shorter name",
}


def _tell_version(is_asked: bool) -> None:
    if is_asked:
        from datagen.foundation.versions import DISTRIBUTION, pixel_versions

        typer.echo(f"{DISTRIBUTION} {pixel_versions()[DISTRIBUTION]}")
        raise typer.Exit


VersionOption = Annotated[
    bool,
    typer.Option("--version", callback=_tell_version, is_eager=True, help="Print the version and stop."),
]
"""Of the commands themselves."""


def run_command(app: Callable[[], object]) -> None:
    """Run a command. Bad input ends with its message and code 2, a full disk with code 1, a broken pipe in
    silence; files and folders that the system refuses count as bad input."""
    from datagen.foundation.errors import DISK_FULL, InputError, Problem

    try:
        app()
    except InputError as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:
        sys.stderr.close()
        raise SystemExit(1) from None
    except OSError as error:
        is_full = error.errno in DISK_FULL
        if not is_full and (error.filename is None or error.errno not in _REMEDIES):
            raise
        remedy = _REMEDIES.get(error.errno or 0, "make room; what is finished is kept")
        print(
            Problem(error.filename or "disk", "", (error.strerror or "").lower(), "", remedy), file=sys.stderr
        )
        raise SystemExit(1 if is_full else 2) from None


def check_choices(choices: dict[str, tuple[str, tuple[str, ...]]]) -> None:
    """Option -> (its value, what is allowed). Raises ``BadParameter`` for another value."""
    for option, (value, allowed) in choices.items():
        if value not in allowed:
            raise typer.BadParameter(f"{value!r}; expected {', '.join(allowed)}", param_hint=option)
