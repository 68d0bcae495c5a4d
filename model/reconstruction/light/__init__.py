# SPDX-License-Identifier: MIT
"""Materials from light: D, S and R from the radiance in photographs of a whole room (docs/light.md)."""
