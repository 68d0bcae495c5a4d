# SPDX-License-Identifier: MIT
"""An asset on its mesh in 3D, as a page that opens from disk: ``materials view``.

``textures`` makes the images, ``writing`` the folder; ``page/`` is the page: its shader is the project's
BSDF (docs/bsdf.md), ``three.js`` is built from npm by ``make three``.
"""
