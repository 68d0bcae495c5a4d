# SPDX-License-Identifier: MIT
"""Custom code by name, ``MODULE:NAME``, also found in the working directory."""

from __future__ import annotations

import importlib
import sys
from typing import Any


def load_named(name: str) -> Any:
    """Object named by ``MODULE:NAME``. Raises ImportError, AttributeError or ValueError if it is missing."""
    module, colon, attribute = name.partition(":")
    if not (colon and module and attribute):
        raise ValueError("no MODULE:NAME")
    if "" not in sys.path:
        sys.path.append("")
    return getattr(importlib.import_module(module), attribute)
