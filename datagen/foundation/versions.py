# SPDX-License-Identifier: MIT
"""Versions of the software that affects pixels, recorded with results and hashed in each unit's key."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

DISTRIBUTION = "scene-materials"
RESULT_REVISION = 19
"""Incremented whenever a change of the code changes the bytes of a dataset but not its configurations."""
LIGHT_REVISION = 6
"""Incremented whenever a change of the code changes only the buffers of ``statistics: {light: true}``."""
PLAN_REVISION = 2
"""Incremented whenever a change of the code changes the configurations or generated rooms of a recipe."""
_PACKAGES = ("mitsuba", "drjit", "numpy", "OpenEXR", "pyoidn")


def pixel_versions(*, has_light: bool = False) -> dict[str, str]:
    """Return versions, by name, of the software that affects views and, if ``has_light``, light buffers."""
    found = {"result_revision": str(RESULT_REVISION), "plan_revision": str(PLAN_REVISION)}
    if has_light:
        found["light_revision"] = str(LIGHT_REVISION)
    for name in (DISTRIBUTION, *_PACKAGES):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found
