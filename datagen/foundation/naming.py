# SPDX-License-Identifier: MIT
"""Ids and file names derived from foreign names."""

from __future__ import annotations

import re

from datagen.foundation.transliteration import transliterated


def slug(text: str) -> str:
    """A name that is valid as an id and as a file name: lower-case letters, digits, '_' and '-'.

    Other alphabets are transliterated.
    """
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", transliterated(text))
    cleaned = re.sub(r"[^a-z0-9_-]+", "-", words.lower()).strip("-_")
    return cleaned or "unnamed"


def unique(name: str, taken: set[str] | dict[str, object]) -> str:
    """``name``, or ``name_2``, ``name_3``, ... if it is taken."""
    if name not in taken:
        return name
    last, step = 1, 1  # a search by bisection: trying every number is quadratic in the names
    while f"{name}_{last + step}" in taken:
        last, step = last + step, 2 * step
    while step > 1:
        step //= 2
        if f"{name}_{last + step}" in taken:
            last += step
    return f"{name}_{last + 1}"
