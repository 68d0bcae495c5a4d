# SPDX-License-Identifier: MIT
"""Light transport: path integrator, irradiance cache, light sampler and sky guide."""
