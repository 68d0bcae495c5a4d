# SPDX-License-Identifier: MIT
"""Writing of files that are complete or absent even after a power failure.

A file's content is synced before its directory entry, and the entry before any later file is written:
otherwise, a crash of the machine may leave a name without content, or a later file without an earlier one.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

_CANNOT_SYNC_FOLDERS = {errno.EINVAL, errno.ENOTSUP}  # some network and FUSE file systems
_IS_WINDOWS = os.name == "nt"  # Windows flushes only files open for writing, and no folders


def sync_file(path: Path) -> None:
    """Wait until a file's content is on disk, even if another process wrote it."""
    descriptor = os.open(path, os.O_RDWR if _IS_WINDOWS else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Wait until a folder's entries are on disk; some file systems do not support this."""
    if _IS_WINDOWS:
        return
    try:
        sync_file(folder)
    except OSError as error:
        if error.errno not in _CANNOT_SYNC_FOLDERS:
            raise


def sync_tree(root: Path) -> None:
    """Wait until a folder and all its files and subfolders are on disk."""
    for folder, _, names in os.walk(root):
        for name in names:
            sync_file(Path(folder, name))
        sync_folder(Path(folder))


def make_folder(folder: Path) -> None:
    """Create a folder and its missing parents, and wait until their entries are on disk."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    sync_folder(folder.parent)


def publish(partial: Path, target: Path) -> None:
    """Sync a file or folder, rename it to ``target`` (replacing a file), and sync the directory entry."""
    if partial.is_dir():
        sync_tree(partial)
    else:
        sync_file(partial)
    partial.replace(target)
    sync_folder(target.parent)


def publish_first(partial: Path, target: Path) -> None:
    """Sync a file and hard-link it as ``target``. Raises ``FileExistsError`` if ``target`` exists."""
    sync_file(partial)
    os.link(partial, target)
    sync_folder(target.parent)
