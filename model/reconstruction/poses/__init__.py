# SPDX-License-Identifier: MIT
"""Correction of camera poses: ``mending`` finds the poses, ``stage`` applies them to a capture."""
