# SPDX-License-Identifier: MIT
"""Estimates the albedo scale from interreflection."""
