# SPDX-License-Identifier: MIT
"""Maps of views from a checkpoint."""
