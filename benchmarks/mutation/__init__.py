# SPDX-License-Identifier: MIT
"""Mutates modules and asks which of their tests notice."""
