# SPDX-License-Identifier: MIT
"""Code of one's own by name, ``MODULE:NAME``, looked for beside the working directory, too."""

from __future__ import annotations

import importlib
import sys
from typing import Any


def load_named(name: str) -> Any:
    """Object named by ``MODULE:NAME``. Raises ImportError, AttributeError or ValueError where it is not
    there."""
    module, colon, attribute = name.partition(":")
    if not (colon and module and attribute):
        raise ValueError("no MODULE:NAME")
    if "" not in sys.path:
        sys.path.append("")
    return getattr(importlib.import_module(module), attribute)
