# SPDX-License-Identifier: GPL-3.0-or-later
"""Registry of environment sources."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import bpy

Build = Callable[[bpy.types.Collection], None]


@dataclass(frozen=True)
class EnvironmentSource:
    """The source of a room: ``build`` adds it to a collection that is tagged as an environment."""

    title: str
    build: Build


ENVIRONMENTS: dict[str, EnvironmentSource] = {}


def environment(name: str, title: str) -> Callable[[Build], Build]:
    """Decorator that registers the builder of a room as ``name``."""

    def register(build: Build) -> Build:
        ENVIRONMENTS[name] = EnvironmentSource(title, build)
        return build

    return register
