# SPDX-License-Identifier: MIT
"""How the project's commands end, whichever of them runs."""

from __future__ import annotations

import sys
from collections.abc import Callable


def run_command(app: Callable[[], object]) -> None:
    """Run a command: bad input ends with its message and code 2, a broken pipe in silence."""
    from datagen.errors import InputError

    try:
        app()
    except InputError as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:
        sys.stderr.close()
        raise SystemExit(1) from None
