# SPDX-License-Identifier: MIT
"""Materials from light: diffuse albedo, specular albedo and roughness out of the radiance that photographs
of a whole room record (docs/light.md)."""
