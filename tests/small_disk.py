# SPDX-License-Identifier: MIT
"""A small real file system for tests, which can be filled or mounted read-only, even for root."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


class SmallDisk:
    """A mounted tmpfs at ``root``."""

    def __init__(self, root: Path):
        self.root = root
        self._ballast = root / ".ballast"

    def fill(self, leave: int) -> None:
        """Fill the disk up to ``leave`` free bytes."""
        status = os.statvfs(self.root)
        with self._ballast.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, status.f_bavail * status.f_frsize - leave)

    def make_room(self) -> None:
        """Free the space used by :meth:`fill`."""
        self._ballast.unlink()

    def remount(self, options: str) -> None:
        """Mount the disk read-only (``ro``) or writable (``rw``)."""
        subprocess.run(["mount", "-o", f"remount,{options}", str(self.root)], check=True, capture_output=True)


@contextmanager
def small_disk(root: Path, megabytes: int) -> Iterator[SmallDisk]:
    """Mount a file system of this size at ``root`` within the context; skip the test if that is forbidden."""
    root.mkdir(parents=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(root)]
    try:
        result = subprocess.run(mount, capture_output=True, text=True)
    except OSError as error:
        pytest.skip(f"no mount command: {error}")
    if result.returncode != 0:
        pytest.skip(f"needs the right to mount a small file system: {result.stderr.strip()}")
    try:
        yield SmallDisk(root)
    finally:
        subprocess.run(["umount", "--lazy", str(root)], check=True, capture_output=True)
