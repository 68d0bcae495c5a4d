# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m scenes.sources``: builds, previews and lists the assets of the bundled library."""

import sys

from scenes.sources.command import main

sys.exit(main())
