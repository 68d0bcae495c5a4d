# SPDX-License-Identifier: MIT
"""Readers with the faults that :mod:`tests.hostile` is there to find."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np

from tests.hostile import Case, CaseMaker, set_traps


def opens_outside(folder: Path) -> Case:
    """Reads a file that is not in the folder."""
    return Case(lambda rng: Path("/etc/hostname"), lambda path: path.read_bytes())


def follows_links(folder: Path) -> Case:
    """Reads what a link in the folder leads to."""
    set_traps(folder)
    return Case(lambda rng: folder / "link.png", lambda path: path.read_bytes())


def unpickles(folder: Path) -> Case:
    """Loads a pickle."""
    data = pickle.dumps(Path)
    return Case(lambda rng: folder, lambda path: pickle.loads(data))


def aborts(folder: Path) -> Case:
    """Ends the process as native code does."""
    return Case(lambda rng: folder, lambda path: os.abort())


def waits(folder: Path) -> Case:
    """Opens a pipe that nobody writes to."""
    set_traps(folder)
    return Case(lambda rng: folder / "fifo", lambda path: path.read_bytes())


def eats(folder: Path) -> Case:
    """Takes over two gigabytes."""
    return Case(lambda rng: folder, lambda path: np.ones(9 << 28, np.uint8).sum())


def raises(folder: Path) -> Case:
    """Lets an error through that is not an InputError."""
    return Case(lambda rng: folder, lambda path: {}["missing"])


CASES: dict[str, CaseMaker] = {
    made.__name__: made for made in (opens_outside, follows_links, unpickles, aborts, waits, eats, raises)
}
