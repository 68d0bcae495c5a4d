# SPDX-License-Identifier: MIT
"""A reconstruction rendered again: from its cameras, under other light, as an animation."""
