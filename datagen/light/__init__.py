# SPDX-License-Identifier: MIT
"""The light that views of a room record: surfels, the radiance that rays meet, irradiance and mirror
images."""
