# SPDX-License-Identifier: MIT
"""The error for a configuration with too few objects or views, which another draw may avoid."""

from __future__ import annotations

from datagen.foundation.errors import InputError, Problem


class Shortfall(InputError):
    """Raised for too few objects or views; :func:`datagen.assembly.plan.assemble` draws them again."""


def shortfall(where: str, field: str, got: str, expected: str, remedy: str) -> Shortfall:
    """Make a :class:`Shortfall` with a single problem."""
    return Shortfall(Problem(where, field, got, expected, remedy))
