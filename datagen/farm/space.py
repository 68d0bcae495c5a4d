# SPDX-License-Identifier: MIT
"""Estimates the disk space needed by the unfinished units, and compares it with the free space."""

from __future__ import annotations

import shutil
from dataclasses import dataclass

from datagen.farm.folder import DatasetFolder
from datagen.formats.recipe import Recipe
from datagen.foundation.buffers import BUFFERS, LIGHT_BUFFERS
from datagen.foundation.errors import input_error

_PACKED_SHARE = 0.4
"""Size of a packed view relative to :func:`view_bytes`, as measured with `datagen run smoke.yaml`."""


@dataclass(frozen=True)
class SpaceNeed:
    """Estimated bytes of the shards of ``num_units`` unfinished units and of temporary files meanwhile."""

    num_units: int
    shard_bytes: float
    working_bytes: float

    @property
    def total_bytes(self) -> float:
        return self.shard_bytes + self.working_bytes


def view_bytes(recipe: Recipe) -> int:
    """Uncompressed size in bytes of a view with statistics."""
    left_out = () if recipe.statistics.light else LIGHT_BUFFERS
    left_out += () if recipe.render.keep_noisy else ("beauty_noisy",)
    stored = sum(b.num_channels * b.dtype.itemsize for b in BUFFERS.values() if b.name not in left_out)
    return recipe.resolution[0] * recipe.resolution[1] * stored


def working_bytes(recipe: Recipe) -> int:
    """Upper bound on the bytes of a view in progress, which is stored twice, without and with statistics."""
    return 2 * view_bytes(recipe)


def needed_space(folder: DatasetFolder, workers: int) -> SpaceNeed:
    """Estimate the space for the unfinished units, ``workers`` of which run at a time.

    The size of shards is estimated from finished ones or, if there are none, from the resolution.
    """
    plan, recipe = folder.read_plan(), folder.read_recipe()
    manifests = {unit.id: folder.finished(unit) for unit in plan.units}
    done = [manifest for manifest in manifests.values() if manifest is not None]
    todo = [unit for unit in plan.units if manifests[unit.id] is None]
    if done:
        bytes_per_view = sum(m.num_bytes for m in done) / sum(m.num_views for m in done)
    else:
        share = 1.0 if recipe.output.compression == "none" else _PACKED_SHARE
        bytes_per_view = view_bytes(recipe) * share
    views = sorted((unit.num_views for unit in todo), reverse=True)
    in_progress = sum(views[:workers]) * working_bytes(recipe)
    return SpaceNeed(len(todo), sum(views) * bytes_per_view, float(in_progress))


def check_space(folder: DatasetFolder, workers: int) -> None:
    """Raise :class:`InputError` if the space of :func:`needed_space` exceeds the free space."""
    need = needed_space(folder, workers)
    free = shutil.disk_usage(folder.root).free
    if need.total_bytes > free:
        needed = f"about {need.total_bytes / 1e6:,.0f} MB for {need.num_units} units "
        needed += f"({need.working_bytes / 1e6:,.0f} MB of it temporarily)"
        remedy = (
            "free space, reduce the recipe, choose another --out, or skip this check with --no-space-check"
        )
        raise input_error(folder.root, "free disk", f"{free / 1e6:,.0f} MB", needed, remedy)
