# SPDX-License-Identifier: MIT
"""Rooms made by rules from a seed: shapes, furniture, layout and checks; no file is read."""
