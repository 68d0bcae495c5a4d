# SPDX-License-Identifier: MIT
"""Creates the index of a dataset whose shards were written without ``datagen run``."""

from __future__ import annotations

from collections.abc import Sequence

from datagen.formats.configuration import Split
from datagen.formats.recipe import Recipe
from datagen.formats.shard import DatasetIndex, ShardRecord


def index_of(name: str, records: Sequence[ShardRecord], buffers: Sequence[str]) -> DatasetIndex:
    """Index of a complete dataset ``name`` with shards ``records`` and ``buffers`` in every view."""
    splits: dict[Split, int] = {"train": 0, "validation": 0, "test": 0}
    for record in records:
        splits[record.split] += 1
    return DatasetIndex(
        recipe=Recipe(name=name, configurations=len(records), views=max(r.num_views for r in records)),
        versions={},
        variant="llvm_ad_rgb",
        num_configurations=len(records),
        num_views=sum(r.num_views for r in records),
        num_bytes=sum(r.num_bytes for r in records),
        is_complete=True,
        splits=splits,
        buffers=tuple(sorted(buffers)),
        assets={},
        shards=tuple(records),
    )
