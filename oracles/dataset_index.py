# SPDX-License-Identifier: MIT
"""Index of datasets whose shards tests and studies write directly."""

from __future__ import annotations

from collections.abc import Sequence

from datagen.formats.configuration import Split
from datagen.formats.recipe import Recipe
from datagen.formats.shard import DatasetIndex, ShardRecord


def index_of(name: str, records: Sequence[ShardRecord], buffers: Sequence[str]) -> DatasetIndex:
    """The index of a complete dataset of shards with ``buffers`` in every view."""
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
