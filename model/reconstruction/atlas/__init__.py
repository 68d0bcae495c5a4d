# SPDX-License-Identifier: MIT
"""The atlas that views are merged into, its texels, and the loops over them."""
