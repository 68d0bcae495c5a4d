# SPDX-License-Identifier: MIT
"""Readers with the faults that :mod:`tests.hostile` must find."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np

from tests.hostile import Case, CaseMaker, set_traps


def opens_outside(folder: Path) -> Case:
    """Reader of a file outside the folder."""
    return Case(lambda rng: Path("/etc/hostname"), lambda path: path.read_bytes())


def follows_links(folder: Path) -> Case:
    """Reader that follows a link in the folder to a file outside."""
    set_traps(folder)
    return Case(lambda rng: folder / "link.png", lambda path: path.read_bytes())


def unpickles(folder: Path) -> Case:
    """Reader that loads a pickle."""
    data = pickle.dumps(Path)
    return Case(lambda rng: folder, lambda path: pickle.loads(data))


def aborts(folder: Path) -> Case:
    """Reader that aborts the process, as native code may."""
    return Case(lambda rng: folder, lambda path: os.abort())


def waits(folder: Path) -> Case:
    """Reader that blocks on a pipe without a writer."""
    set_traps(folder)
    return Case(lambda rng: folder / "fifo", lambda path: path.read_bytes())


def eats(folder: Path) -> Case:
    """Reader that allocates more than a gigabyte."""
    return Case(lambda rng: folder, lambda path: np.ones(9 << 27, np.uint8))


def raises(folder: Path) -> Case:
    """Reader that raises an error other than InputError."""
    return Case(lambda rng: folder, lambda path: {}["missing"])


CASES: dict[str, CaseMaker] = {
    made.__name__: made for made in (opens_outside, follows_links, unpickles, aborts, waits, eats, raises)
}
