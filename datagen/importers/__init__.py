# SPDX-License-Identifier: MIT
"""Importers: other people's files become asset packages. ``dispatch.import_asset`` is the door."""
