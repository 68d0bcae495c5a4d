# SPDX-License-Identifier: MIT
"""Collects the recovered light sources of a room for export; distant light from outside becomes an image of
the sky (docs/light.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.formats.capture import CaptureGeometry
from datagen.foundation.color import luminance
from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from datagen.light.background import Background
from datagen.light.lighting import Lit
from datagen.light.sun import ANGULAR_DIAMETER_RAD
from datagen.light.surfels import camera_row
from model.reconstruction.found_lights import FoundLights, FoundSun, RadianceSamples, as_color
from model.reconstruction.light.lamps import found_lamps, found_panels
from model.reconstruction.light.openings import divide_openings, found_openings, leaving_rays

NUM_SAMPLES = 1600
"""Number of pixels to which the gains of exported lights are fitted."""
_SEED = 0x62616C
HEIGHT, WIDTH = 64, 128
"""Size of the sky image in pixels."""


def found_lights(lit: Lit, traced: TracedGeometry, geometry: CaptureGeometry) -> FoundLights:
    """Collect the recovered lamps, panels, windows, sky and sun of a room, and the holes of its mesh.

    The sky is included only if there are windows and, in addition, the light from outside depends only on
    direction or includes a sun, whose light the windows' rectangles would block.
    """
    field = lit.baker.field
    lamps = found_lamps(field.emitters, traced.mesh, geometry.parts)
    rays = leaving_rays(field, lit.surfels)
    median = float(np.median(luminance(lit.surfels.radiance.astype(np.float64))))
    openings = found_openings(rays, field.background, median)
    windows, holes = divide_openings(openings, lit.surfels, lit.diffuse)
    sun = None
    if lit.sun is not None:
        direction, irradiance = as_color(lit.sun.direction), as_color(lit.sun.irradiance)
        sun = FoundSun(direction, irradiance, ANGULAR_DIAMETER_RAD)
    is_far = field.background.layout.is_far or sun is not None
    sky = sky_image(field.background) if windows and is_far else None
    return FoundLights(lamps, found_panels(lit), windows, sky, holes, sun)


def radiance_samples(views: Sequence[TracedView], num: int = NUM_SAMPLES) -> RadianceSamples:
    """Sample the radiance of about ``num`` random valid, unclipped pixels, equally many per view.

    The result does not depend on the order of the views.
    """
    rays: list[tuple[NDArray, NDArray, NDArray]] = []
    for view in sorted(views, key=lambda view: camera_row(view).tobytes()):
        is_known = (
            view.valid_mask if view.clipped_mask is None else view.valid_mask & ~view.clipped_mask.any(axis=2)
        )
        usable = np.argwhere(is_known)
        count = min(-(-num // len(views)), len(usable))
        row, column = usable[np.random.default_rng([_SEED, len(rays)]).permutation(len(usable))[:count]].T
        direction = view.camera.ray_directions()[row, column]
        rays.append((np.tile(view.camera.position_m, (count, 1)), direction, view.color[row, column]))
    return RadianceSamples(*(np.concatenate(part).astype(np.float32) for part in zip(*rays, strict=True)))


def sky_image(background: Background) -> NDArray[np.float32]:
    """Convert the radiance of a ``background`` to an image of a distant sky (HEIGHT, WIDTH, 3).

    A pixel is the mean of the known bins in it or, without any, equals the nearest pixel that has some.
    """
    of_direction = directions_of(background.layout.bin_directions(), HEIGHT)
    pixel = np.resize(of_direction, background.layout.num_bins)[background.is_known]
    radiance = background.radiance[background.is_known].astype(np.float64)
    count = np.bincount(pixel, minlength=HEIGHT * WIDTH)
    sums = [np.bincount(pixel, column, HEIGHT * WIDTH) for column in radiance.T]
    image = (np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]).astype(np.float32)
    known = count > 0
    if known.any():
        every = direction_vectors(HEIGHT)
        _, nearest = cKDTree(every[known]).query(every[~known])
        image[~known] = image[known][nearest]
    return image.reshape(HEIGHT, WIDTH, 3)


def directions_of(direction: NDArray, height: int) -> NDArray[np.int64]:
    """Compute the flat pixel index (N,) of directions (N, 3) in an image of 2 ``height`` x ``height`` pixels.

    The top row is +Z, the centre column +Y, and +X is to its right.
    """
    row = np.clip(np.arccos(np.clip(direction[:, 2], -1, 1)) / np.pi * height, 0, height - 1).astype(np.int64)
    turn = 0.5 + np.arctan2(direction[:, 0], direction[:, 1]) / (2 * np.pi)
    column = np.clip(turn * 2 * height, 0, 2 * height - 1).astype(np.int64)
    return row * 2 * height + column


def direction_vectors(height: int) -> NDArray[np.float64]:
    """Compute the unit directions (2 ``height``^2, 3) of the pixel centres of a sky image, row by row."""
    row, column = np.divmod(np.arange(2 * height * height), 2 * height)
    polar, turn = (row + 0.5) / height * np.pi, ((column + 0.5) / (2 * height) - 0.5) * 2 * np.pi
    return np.stack([np.sin(polar) * np.sin(turn), np.sin(polar) * np.cos(turn), np.cos(polar)], axis=1)
