# SPDX-License-Identifier: MIT
"""Maps of views: predictions of a checkpoint, ground truth, or given maps."""
