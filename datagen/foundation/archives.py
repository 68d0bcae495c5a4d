# SPDX-License-Identifier: MIT
"""Checks of untrusted zip files before any member is unpacked."""

from __future__ import annotations

import stat
import struct
import zipfile
import zlib
from pathlib import Path

from datagen.foundation.budget import Budget
from datagen.foundation.errors import Problem, raise_problems

# exceptions that zipfile raises for damaged archives, found by fuzzing
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError, ValueError, OSError)
_REMEDY = "do not use this file"


def check_archive(archive: zipfile.ZipFile, path: Path, budget: Budget) -> None:
    """Raise :class:`InputError` if the open zip file ``path`` is unsafe to unpack.

    It must not contain duplicate names, names that lead out of the archive, links, devices, encryption,
    compression other than deflate, or more members or bytes than the ``budget`` allows.
    """
    budget.hold_file(path)
    members = archive.infolist()
    budget.spend("nodes", len(members), "members")
    budget.spend("bytes", sum(member.file_size for member in members), "unpacked members")
    problems, seen = [], set()
    for member in members:
        fault = "occurs twice" if member.filename in seen else _fault_of(member)
        seen.add(member.filename)
        if fault:
            expected = "plain files inside the archive"
            problems.append(Problem(path, f"member {member.filename!r}", fault, expected, _REMEDY))
    raise_problems(problems)


def _fault_of(member: zipfile.ZipInfo) -> str:
    name, mode = member.filename, member.external_attr >> 16
    parts = name.replace("\\", "/").rstrip("/").split("/")
    if name.startswith("/") or ":" in name or "\\" in name or any(p in ("", ".", "..") for p in parts):
        return "leaves the archive"
    if stat.S_ISLNK(mode):
        return "is a symbolic link"
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
        return "is a device or another special file"
    if member.flag_bits & 1:
        return "is encrypted"
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return f"is compressed by method {member.compress_type}"
    return ""
