# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources of environments; importing this package fills :data:`ENVIRONMENTS`."""

from scenes.sources.environments import bathroom, dining_room, kitchen, living_room, study  # noqa: F401
from scenes.sources.environments.registry import ENVIRONMENTS

__all__ = ["ENVIRONMENTS"]
