# SPDX-License-Identifier: MIT
"""Importers convert files of other programs to asset packages; entry point: ``dispatch.import_asset``."""
