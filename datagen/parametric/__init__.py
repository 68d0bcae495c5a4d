# SPDX-License-Identifier: MIT
"""Generates furnished rooms by rules from a seed: shapes, furniture, layout and checks."""
