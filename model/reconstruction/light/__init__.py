# SPDX-License-Identifier: MIT
"""Estimates D, S and R from the radiance in photographs of a whole room (docs/light.md)."""
