# SPDX-License-Identifier: GPL-3.0-or-later
"""Environment sources; importing this package fills :data:`ENVIRONMENTS`."""

from scenes.sources.environments import kitchen, living_room  # noqa: F401
from scenes.sources.environments.registry import ENVIRONMENTS, EnvironmentSource

__all__ = ["ENVIRONMENTS", "EnvironmentSource"]
