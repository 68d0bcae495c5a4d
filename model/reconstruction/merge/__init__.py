# SPDX-License-Identifier: MIT
"""The maps of all views merged into one atlas, and what no view has seen filled in."""
