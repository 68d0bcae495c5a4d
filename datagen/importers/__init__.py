# SPDX-License-Identifier: MIT
"""Importers of files of other programs as asset packages; ``dispatch.import_asset`` is the entry point."""
