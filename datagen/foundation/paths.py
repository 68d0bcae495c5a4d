# SPDX-License-Identifier: MIT
"""Checks that file names in untrusted files refer to permitted files, and checks of output folders.

A name is relative to the folder of the file that contains it and must stay inside, even when links are
followed. Absolute names and ``..`` may only lead into folders that the user allows explicitly.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Sequence
from pathlib import Path

from datagen.foundation.errors import InputError, Problem

_URI = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/|file:", re.I)
_DRIVE = re.compile(r"[A-Za-z]:(/|$)")
_SHORT = 200


def fault_of(
    folder: Path, name: str, allowed: Sequence[Path] = (), *, is_folder: bool = False
) -> tuple[Path | None, str]:
    """Resolve a name in an untrusted file; return (real path, "") or, if it is refused, (None, reason).

    The name is relative to ``folder`` and must lead into it or into one of ``allowed``. The target may be
    missing; otherwise it must be a regular file, or a folder if ``is_folder``.
    """
    name = name.replace("\\", "/")
    if not name:
        return None, "no name"
    if not name.isprintable():  # the operating system ends a name at a NUL, Python does not
        return None, "not a valid file name"
    if _URI.match(name):
        return None, "a URI"
    if _DRIVE.match(name):
        return None, "a path of another system"
    is_absolute = name.startswith("/")
    if is_absolute and not allowed:
        return None, "an absolute path"
    roots = [*([] if is_absolute else [folder]), *allowed]
    try:
        real = (folder / name).resolve()
        if not any(real.is_relative_to(root.resolve()) for root in roots):
            is_link = ".." not in name and not is_absolute
            return None, f"a symbolic link that leads to {real}" if is_link else "outside the folder"
        mode = real.stat().st_mode if real.exists() else None
    except (OSError, RuntimeError, ValueError) as error:
        return None, getattr(error, "strerror", None) or str(error)[:_SHORT]
    if mode is not None and not (stat.S_ISDIR(mode) if is_folder else stat.S_ISREG(mode)):
        # a pipe would block for ever, a device never ends
        return None, "no folder" if is_folder else "not a regular file"
    return real, ""


def named_file(
    folder: Path,
    name: str,
    where: str | Path,
    field: str,
    allowed: Sequence[Path] = (),
    remedy: str = "copy the file there",
) -> Path:
    """Return the path of the file ``name``, resolved as by :func:`fault_of`; it may be missing.

    Raises :class:`InputError` if the name, found in ``field`` of the file ``where``, is refused.
    """
    real, fault = fault_of(folder, name, allowed)
    if real is None:
        expected = f"a file inside {folder}"
        raise InputError(Problem(where, field, f"{name[:_SHORT]!r} ({fault})", expected, remedy))
    return real


def inside(root: Path, path: Path) -> Path:
    """Return ``path`` if, with links followed, it is a regular or missing file inside ``root``.

    Raises :class:`InputError` for any other path.
    """
    try:
        name = str(path.relative_to(root))
    except ValueError:
        name = str(path)
    real, fault = fault_of(root, name)
    if real is None:
        expected = "a regular file" if fault == "not a regular file" else f"a file in {root}"
        raise InputError(Problem(path, "", fault, expected, "copy the file there"))
    return path


def output_problems(out: Path, is_earlier: bool, earlier: str) -> list[Problem]:
    """List the problems of the output folder ``out``, which must be missing, empty or an earlier output.

    ``is_earlier``: whether it is an earlier output; ``earlier`` describes such a folder in messages.
    """
    if out.exists() and not out.is_dir():
        return [Problem(out, "--out", "a file", "a folder", "choose another --out")]
    if out.is_dir() and any(out.iterdir()) and not is_earlier:
        got, expected = "a folder with other files", f"an empty folder, or {earlier}"
        return [Problem(out, "--out", got, expected, "choose another --out")]
    return []
