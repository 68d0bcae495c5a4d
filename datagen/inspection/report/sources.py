# SPDX-License-Identifier: MIT
"""Determines the views that each pixel's statistics use, with the kernel that computed the statistics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from datagen.formats.view import StatisticsRecord
from datagen.multiview.statistics import StatisticsOptions, StatisticsView, choose_for_pixels
from datagen.multiview.visibility import PackedViews, VisibilityOptions
from mitsuba_plugins.variant import select_variant

NO_VIEW = 65535
"""Value of the unused entries at the end of a pixel's list of view indices."""


def options_of(record: StatisticsRecord) -> StatisticsOptions:
    """Options of recorded statistics, but always with depth-buffer visibility, since no mesh is loaded."""
    visibility = VisibilityOptions(mode="depth")
    return StatisticsOptions(record.best_views, record.include_self, visibility=visibility)


def source_views(
    views: Sequence[StatisticsView], options: StatisticsOptions, wanted: Sequence[int] | None = None
) -> Iterator[NDArray[np.uint16]]:
    """Yield, for each view in ``wanted`` (None: all), indices (H, W, k) of the views chosen for each pixel.

    The best view comes first; :data:`NO_VIEW` fills the rest. Raises :class:`InputError` if LLVM is missing.
    """
    select_variant()
    import drjit as dr
    import mitsuba as mi

    packed = PackedViews([view.camera for view in views], [view.depth_z_m for view in views])
    for index in range(len(views)) if wanted is None else wanted:
        view = views[index]
        _, _, selection = choose_for_pixels(view, index, packed, options)
        count = selection.num_chosen
        rows = [
            dr.select(mi.UInt32(j) < count, selection.views[mi.UInt32(j)], mi.UInt32(NO_VIEW))
            for j in range(options.best_views)
        ]
        dr.eval(rows)
        shape = (view.camera.height_px, view.camera.width_px, options.best_views)
        yield np.stack([row.numpy() for row in rows], axis=-1).astype(np.uint16).reshape(shape)
