# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender extension that exports scenes, objects and materials as asset packages. Registration only."""

from __future__ import annotations


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from . import operators, panels

    operators.register()
    panels.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    from . import operators, panels

    panels.unregister()
    operators.unregister()
