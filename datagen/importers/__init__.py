# SPDX-License-Identifier: MIT
"""Importers convert files of other programs to asset packages. ``dispatch.import_asset`` is the entry
point.
"""
