# SPDX-License-Identifier: MIT
"""Correction of camera poses: ``mending`` estimates the poses, ``stage`` applies them to a capture."""
