# SPDX-License-Identifier: MIT
"""The level of diffuse albedo, from the light between the surfaces."""
