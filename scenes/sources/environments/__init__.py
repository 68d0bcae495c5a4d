# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources of environments; importing this package fills :data:`ENVIRONMENTS`."""

from scenes.sources.environments import (  # noqa: F401
    bathroom,
    dining_room,
    kitchen,
    living_room,
    study,
)
from scenes.sources.environments.registry import ENVIRONMENTS, EnvironmentSource

__all__ = ["ENVIRONMENTS", "EnvironmentSource"]
