# SPDX-License-Identifier: MIT
"""The ground floor: modules that every package may import and that import nothing of the project."""
