# SPDX-License-Identifier: MIT
"""Files that are whole or absent, even after a power failure: content, name and folder are synced in order.

A rename alone survives a crash of the process, not of the machine: a file system may keep the new name and
lose the content, or lose the name although a later file that depends on it exists.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

_CANNOT_SYNC_FOLDERS = {errno.EINVAL, errno.ENOTSUP}  # some network and FUSE file systems
_IS_WINDOWS = os.name == "nt"  # Windows flushes only files open for writing, and no folders


def sync_file(path: Path) -> None:
    """Wait until a file's content is on disk, whichever process wrote it."""
    descriptor = os.open(path, os.O_RDWR if _IS_WINDOWS else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Wait until a folder's names are on disk, if the file system can."""
    if _IS_WINDOWS:
        return
    try:
        sync_file(folder)
    except OSError as error:
        if error.errno not in _CANNOT_SYNC_FOLDERS:
            raise


def sync_tree(root: Path) -> None:
    """Wait until everything below a folder, and the folder itself, is on disk."""
    for folder, _, names in os.walk(root):
        for name in names:
            sync_file(Path(folder, name))
        sync_folder(Path(folder))


def make_folder(folder: Path) -> None:
    """Create a folder and its missing parents, and wait until their names are on disk."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    sync_folder(folder.parent)


def publish(partial: Path, target: Path) -> None:
    """Rename a finished file or folder, replacing an existing file, and wait until it is on disk."""
    if partial.is_dir():
        sync_tree(partial)
    else:
        sync_file(partial)
    partial.replace(target)
    sync_folder(target.parent)


def publish_first(partial: Path, target: Path) -> None:
    """Publish a finished file as a hard link. Raises ``FileExistsError`` if ``target`` exists."""
    sync_file(partial)
    os.link(partial, target)
    sync_folder(target.parent)
