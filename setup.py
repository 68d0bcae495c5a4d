# SPDX-License-Identifier: MIT
"""Lists the packages; everything else is in pyproject.toml.

The bundled library, recipes and small suite lie in ``scenes/`` of the repository and are installed inside the
package ``datagen``, as ``datagen/scenes``: pyproject.toml cannot express that for discovered packages.
"""

from setuptools import find_packages, setup

FOUND = find_packages(include=["datagen*", "mitsuba_plugins*", "model*", "blender_addon*"])
setup(packages=[*FOUND, "datagen.scenes"], package_dir={"datagen.scenes": "scenes"})
