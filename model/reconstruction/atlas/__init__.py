# SPDX-License-Identifier: MIT
"""The merged atlas and its texels."""
