# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m blender_addon file.blend --out DIR``: exports a file without Blender's user interface."""

from __future__ import annotations

from .command import leave, main

if __name__ == "__main__":
    leave(main())
