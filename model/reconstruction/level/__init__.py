# SPDX-License-Identifier: MIT
"""The albedo scale, from interreflection."""
