# SPDX-License-Identifier: MIT
"""The merged atlas, its texels, and loops over them."""
