# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m scenes.sources build --out scenes/library`` and ``preview``."""

import sys

from scenes.sources.command import main

sys.exit(main())
