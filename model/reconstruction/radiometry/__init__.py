# SPDX-License-Identifier: MIT
"""What cameras do to radiance, found from photographs that overlap, and undone."""
