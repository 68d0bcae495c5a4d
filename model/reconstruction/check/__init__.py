# SPDX-License-Identifier: MIT
"""Does the mesh project onto the photographs? Looked at before minutes are spent on a capture."""
