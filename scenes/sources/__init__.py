# SPDX-License-Identifier: GPL-3.0-or-later
"""The sources of the bundled library: Blender scripts that model every asset and export it with the add-on.

``python -m scenes.sources build --out scenes/library`` rebuilds the library with the same content.
"""
