# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources of objects; importing this package fills :data:`OBJECTS`."""

from scenes.sources.objects import (  # noqa: F401
    books_and_paper,
    crockery,
    devices,
    fruit,
    kitchenware,
    lamps_frames_clocks,
    living,
    ornaments,
    play,
    shoes,
    tools,
    vases_and_bottles,
)
from scenes.sources.objects.registry import OBJECTS

__all__ = ["OBJECTS"]
