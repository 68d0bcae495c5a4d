# SPDX-License-Identifier: MIT
"""Runs the command ``python -m datagen.tradeoff``."""

from datagen.foundation.command_line import run_function
from datagen.tradeoff.command import tradeoff

if __name__ == "__main__":
    run_function(tradeoff)
