# SPDX-License-Identifier: MIT
"""From a folder of photographs to an asset in one command."""
