# SPDX-License-Identifier: GPL-3.0-or-later
"""Object sources by category; importing this package fills :data:`OBJECTS`."""

from scenes.sources.objects import (  # noqa: F401
    books_and_paper,
    crockery,
    devices,
    kitchen,
    living,
    play,
    tools_and_wear,
)
from scenes.sources.objects.registry import OBJECTS, ObjectSource

__all__ = ["OBJECTS", "ObjectSource"]
