# SPDX-License-Identifier: MIT
"""Renders a reconstruction from its cameras, under other light, or as an animation."""
