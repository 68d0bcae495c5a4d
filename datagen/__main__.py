# SPDX-License-Identifier: MIT
"""Runs the command line as ``python -m datagen``."""

from datagen.cli import main

if __name__ == "__main__":
    main()
