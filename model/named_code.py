# SPDX-License-Identifier: MIT
"""Import of custom code by name; modules may be in the working directory."""

from __future__ import annotations

import importlib
import sys
from typing import Any


def load_named(name: str) -> Any:
    """Import the object ``MODULE:NAME``. Raises ``ImportError`` or ``AttributeError`` if it does not exist,
    and ``ValueError`` if ``name`` does not have this form."""
    module, colon, attribute = name.partition(":")
    if not (colon and module and attribute) or module.startswith("."):
        raise ValueError("no MODULE:NAME")
    if "" not in sys.path:
        sys.path.append("")
    return getattr(importlib.import_module(module), attribute)
