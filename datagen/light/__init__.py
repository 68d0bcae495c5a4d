# SPDX-License-Identifier: MIT
"""Light recorded by the views of a room: surfels, radiance field, irradiance and mirror reflections."""
