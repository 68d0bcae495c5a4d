# SPDX-License-Identifier: GPL-3.0-or-later
"""Registers the Blender extension that exports scenes, objects and materials as asset packages."""

from __future__ import annotations


def register() -> None:
    """Register the operators and panels. Blender calls this when the extension is enabled."""
    from . import operators, panels

    operators.register()
    panels.register()


def unregister() -> None:
    """Remove the panels and operators. Blender calls this when the extension is disabled."""
    from . import operators, panels

    panels.unregister()
    operators.unregister()
