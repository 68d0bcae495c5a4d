# SPDX-License-Identifier: MIT
"""Maps of views from a checkpoint's predictions, the ground truth, or other sources."""
