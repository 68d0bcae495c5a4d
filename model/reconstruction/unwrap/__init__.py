# SPDX-License-Identifier: MIT
"""UVs for an atlas."""
