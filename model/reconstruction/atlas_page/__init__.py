# SPDX-License-Identifier: MIT
"""Writes the 3D page of ``materials view``, which shows an asset and opens from disk.

``textures`` makes the images and ``writing`` the folder. ``page/`` contains the page, whose shader evaluates
the project's BSDF (docs/bsdf.md); its ``three.js`` is built from npm by ``make three``.
"""
