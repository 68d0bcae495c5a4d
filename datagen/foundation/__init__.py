# SPDX-License-Identifier: MIT
"""The ground floor: what every package may import, and which imports nothing of the project itself."""
