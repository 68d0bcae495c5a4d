# SPDX-License-Identifier: MIT
"""Ids and file names derived from arbitrary names."""

from __future__ import annotations

import re

from datagen.foundation.transliteration import transliterated


def slug(text: str) -> str:
    """Convert ``text`` to a valid id and file name of lower-case ASCII letters, digits, '_' and '-'.

    Returns ``unnamed`` if no such characters remain.
    """
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", transliterated(text))
    cleaned = re.sub(r"[^a-z0-9_-]+", "-", words.lower()).strip("-_")
    return cleaned or "unnamed"


def unique(name: str, taken: set[str] | dict[str, object]) -> str:
    """Return ``name`` if it is not in ``taken``, else a free one of ``name_2``, ``name_3``, ..."""
    if name not in taken:
        return name
    last, step = 1, 1  # bisection, since trying every number is quadratic in the number of names
    while f"{name}_{last + step}" in taken:
        last, step = last + step, 2 * step
    while step > 1:
        step //= 2
        if f"{name}_{last + step}" in taken:
            last += step
    return f"{name}_{last + 1}"
