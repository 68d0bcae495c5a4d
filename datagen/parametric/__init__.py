# SPDX-License-Identifier: MIT
"""Generates rooms by rules from a seed: shapes, furniture, layout and checks; no file is read."""
