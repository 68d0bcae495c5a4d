# SPDX-License-Identifier: MIT
"""Writes the 3D page of ``materials view``, which shows an asset and opens from disk.

``sources`` approximates the lights, ``textures`` makes the images and ``writing`` the folder. ``page/``
contains HTML and scripts, whose shader evaluates the project's BSDF (docs/bsdf.md); ``make three`` builds its
``three.js`` from npm.
"""
