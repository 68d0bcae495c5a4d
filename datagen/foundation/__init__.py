# SPDX-License-Identifier: MIT
"""Base modules: every package may import them, and they import nothing else of the project."""
