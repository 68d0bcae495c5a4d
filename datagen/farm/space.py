# SPDX-License-Identifier: MIT
"""Free disk space compared with the need of the remaining units, estimated before work starts."""

from __future__ import annotations

import shutil
from dataclasses import dataclass

from datagen.farm.folder import DatasetFolder
from datagen.foundation.buffers import BUFFERS, LIGHT_BUFFERS
from datagen.foundation.errors import input_error

VIEW_BYTES_WHILE_WORKING = 16 * 4 * 2
"""Upper bound in bytes per pixel: uncompressed and complete view side by side."""
_PACKED_SHARE = 0.37
"""Size of a packed view relative to all buffers' bytes, measured with the bundled library (`datagen run
smoke.yaml`)."""


@dataclass(frozen=True)
class SpaceNeed:
    """Bytes needed by the shards of ``num_units`` unfinished units, and by units in progress."""

    num_units: int
    shard_bytes: float
    working_bytes: float

    @property
    def total_bytes(self) -> float:
        return self.shard_bytes + self.working_bytes


def needed_space(folder: DatasetFolder, workers: int) -> SpaceNeed:
    """Space needed by the remaining units, from the existing shards or from the size of the views."""
    plan, recipe = folder.read_plan(), folder.read_recipe()
    pixels = recipe.resolution[0] * recipe.resolution[1]
    manifests = [folder.read_manifest(unit) for unit in plan.units if folder.is_done(unit)]
    done = [manifest for manifest in manifests if manifest is not None]
    todo = [unit for unit in plan.units if not folder.is_done(unit)]
    if done:
        bytes_per_view = sum(m.num_bytes for m in done) / sum(m.num_views for m in done)
    else:
        left_out = () if recipe.statistics.light else LIGHT_BUFFERS
        stored = sum(b.num_channels * b.dtype.itemsize for b in BUFFERS.values() if b.name not in left_out)
        share = 1.0 if recipe.output.compression == "none" else _PACKED_SHARE
        bytes_per_view = pixels * stored * share
    views = sorted((unit.num_views for unit in todo), reverse=True)
    in_progress = sum(views[:workers]) * pixels * VIEW_BYTES_WHILE_WORKING
    return SpaceNeed(len(todo), sum(views) * bytes_per_view, float(in_progress))


def check_space(folder: DatasetFolder, workers: int) -> None:
    """Raise :class:`InputError` if the remaining units are likely to need more than the free disk space."""
    need = needed_space(folder, workers)
    free = shutil.disk_usage(folder.root).free
    if need.total_bytes > free:
        remedy = (
            "free some, ask for less, plan it elsewhere (--out), or go on as far as it goes: --no-space-check"
        )
        raise input_error(
            folder.root,
            "free disk",
            f"{free / 1e6:,.0f} MB",
            f"about {need.total_bytes / 1e6:,.0f} MB for {need.num_units} units "
            f"({need.working_bytes / 1e6:,.0f} MB of it only while they are made)",
            remedy,
        )
