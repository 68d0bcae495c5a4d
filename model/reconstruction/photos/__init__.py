# SPDX-License-Identifier: MIT
"""Makes an asset from a folder of photographs in one command."""
