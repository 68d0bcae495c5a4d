# SPDX-License-Identifier: MIT
"""Datasets as a stream of tensors for custom training: any buffers, whole views or crops.

    loader = DataLoader(ViewStream(["rooms"], ["beauty", "diffuse_albedo"], crop_px=128), 8, num_workers=4)

An epoch uses every view of a split once, except up to n - 1 views with n ranks. Its order is a pure function
of (seed, epoch): each rank takes every n-th view, and each of its m loader processes every m-th of these. A
sample is a dictionary: each buffer (C, H, W) as float32, or int64 for ids, ``intrinsics`` (3, 3) in pixels of
the crop, ``world_from_camera`` (4, 4), the scalar ``exposure``, and the names ``configuration`` and ``view``.
Images are linear; the luminance of ``beauty`` times ``exposure`` has its 95th percentile at 0.9.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import distributed
from torch.utils.data import IterableDataset, get_worker_info

from datagen.formats.configuration import Split
from datagen.formats.shard import Dataset, ViewPlace, index_shard, read_buffers, read_record
from datagen.formats.view import ViewRecord
from datagen.foundation.buffers import BUFFERS
from datagen.foundation.errors import Problem, input_error, raise_problems

_BLOCK_VIEWS = 8
_ORDER, _CROPS, _MIXING = 0x51, 0x52, 0x53
_REMEDY = "make the shard again"


class ViewStream(IterableDataset[dict[str, Any]]):
    """Stream of the views of dataset folders or shards (.tar), or of random square crops of them.

    ``split``: None for all views; shards passed individually are included whatever their split. ``crop_px``:
    side of the ``crops_per_view`` crops of each view; None yields whole views, which require a loader with
    ``batch_size`` 1 if their sizes differ. Crops are shuffled within groups of eight views. ``rank`` and
    ``num_ranks`` default to those of ``torch.distributed`` if it is running; all ranks yield the same number
    of samples, so the last few views of an epoch may be dropped. Raises :class:`InputError` for paths that
    are not datasets, for fewer views than ranks and, during iteration, for a damaged view.
    """

    def __init__(
        self,
        sources: Sequence[str | Path],
        buffers: Sequence[str],
        *,
        split: Split | None = "train",
        crop_px: int | None = None,
        crops_per_view: int = 1,
        shuffle: bool = True,
        seed: int = 0,
        rank: int | None = None,
        num_ranks: int | None = None,
    ):
        super().__init__()
        self.buffers = tuple(buffers)
        unknown = [name for name in self.buffers if name not in BUFFERS]
        raise_problems([Problem("ViewStream", "buffers", name, ", ".join(BUFFERS)) for name in unknown])
        given = {"crop_px": crop_px, "crops_per_view": crops_per_view}
        low = [(name, str(value)) for name, value in given.items() if value is not None and value < 1]
        raise_problems([Problem("ViewStream", name, value, "at least 1") for name, value in low])
        self.crop_px, self.crops_per_view = crop_px, crops_per_view if crop_px else 1
        self.shuffle, self.seed = shuffle, seed
        self.rank, self.num_ranks = _ranks(rank, num_ranks)
        self.places = [place for source in sources for place in _places(Path(source), split)]
        if len(self.places) < self.num_ranks:
            where = ", ".join(map(str, sources))
            got = f"{len(self.places)} views of split {split}"
            raise input_error(where, "views", got, f"at least one for each of {self.num_ranks} ranks")
        # in shared memory, since persistent loader processes must read later changes
        self._epoch = torch.zeros(1, dtype=torch.int64).share_memory_()

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch that determines order and crops of the next iteration, even in persistent loaders."""
        self._epoch[0] = epoch

    def __len__(self) -> int:
        """Number of samples per epoch of this rank, summed over its loader processes."""
        return len(self.places) // self.num_ranks * self.crops_per_view

    def __iter__(self) -> Iterator[dict[str, Any]]:
        worker = get_worker_info()
        index, count = (worker.id, worker.num_workers) if worker is not None else (0, 1)
        epoch = int(self._epoch[0])
        order = np.arange(len(self.places))
        if self.shuffle:
            order = np.random.default_rng((self.seed, _ORDER, epoch)).permutation(order)
        each = len(order) // self.num_ranks
        mine = order[self.rank : each * self.num_ranks : self.num_ranks][index::count]
        mixing = np.random.default_rng((self.seed, _MIXING, epoch, self.rank, index))
        for start in range(0, len(mine), _BLOCK_VIEWS):
            samples: list[dict[str, Any]] = []
            for number in mine[start : start + _BLOCK_VIEWS]:
                crops = np.random.default_rng((self.seed, _CROPS, epoch, number))
                found = self._samples(self.places[number], crops)
                if self.crop_px is None:
                    yield from found
                else:
                    samples += found
            if self.shuffle:
                mixing.shuffle(samples)  # type: ignore[arg-type]
            yield from samples

    def _samples(self, place: ViewPlace, generator: np.random.Generator) -> list[dict[str, Any]]:
        record, buffers = read_view(place, self.buffers)
        height, width = record.camera.height_px, record.camera.width_px
        size = self.crop_px
        if size is None:
            return [_sample(record, buffers, 0, 0, height, width)]
        if size > min(height, width):
            where = f"{place.shard}:{place.name}"
            raise input_error(where, "size", f"{width} x {height}", f"at least the crop, {size} px per side")
        samples = []
        for _ in range(self.crops_per_view):
            top = int(generator.integers(0, height - size + 1))
            left = int(generator.integers(0, width - size + 1))
            samples.append(_sample(record, buffers, top, left, size, size))
        return samples


def read_view(place: ViewPlace, names: Sequence[str]) -> tuple[ViewRecord, dict[str, NDArray]]:
    """Read a view's record and the buffers ``names``, each (H, W, C) in its stored type.

    Raises :class:`InputError` for a damaged view.
    """
    where = f"{place.shard}:{place.name}"
    record = read_record(place)
    buffers = read_buffers(place, names)
    expected = (record.camera.height_px, record.camera.width_px)
    for name, values in buffers.items():
        if values.shape[:2] != expected:
            raise input_error(where, name, f"{values.shape[:2]}", f"{expected} as in its camera", _REMEDY)
    return record, buffers


def _ranks(rank: int | None, num_ranks: int | None) -> tuple[int, int]:
    if (rank is None) != (num_ranks is None):
        raise input_error("ViewStream", "rank", rank, "rank and num_ranks, or neither of them")
    if rank is None or num_ranks is None:
        is_running = distributed.is_available() and distributed.is_initialized()
        return (distributed.get_rank(), distributed.get_world_size()) if is_running else (0, 1)
    if not 0 <= rank < num_ranks:
        raise input_error("ViewStream", "rank", rank, f"a number from 0 to num_ranks - 1 = {num_ranks - 1}")
    return rank, num_ranks


def _places(source: Path, split: Split | None) -> list[ViewPlace]:
    paths = [source] if source.suffix == ".tar" else Dataset(source).shard_paths(split)
    return [place for path in paths for place in index_shard(path)]


def _sample(
    record: ViewRecord, buffers: dict[str, NDArray], top: int, left: int, height: int, width: int
) -> dict[str, Any]:
    camera = record.camera
    focal = ((camera.fx_px, 0.0, camera.cx_px - left), (0.0, camera.fy_px, camera.cy_px - top), (0, 0, 1))
    sample: dict[str, Any] = {
        "configuration": record.configuration,
        "view": record.name,
        "exposure": torch.tensor(record.exposure, dtype=torch.float32),
        "intrinsics": torch.tensor(focal, dtype=torch.float32),
        "world_from_camera": torch.tensor(camera.world_from_camera, dtype=torch.float32),
    }
    for name, values in buffers.items():
        kind = np.int64 if values.dtype.kind == "u" else np.float32
        cut = values[top : top + height, left : left + width].transpose(2, 0, 1)
        sample[name] = torch.from_numpy(np.ascontiguousarray(cut, dtype=kind))
    return sample
