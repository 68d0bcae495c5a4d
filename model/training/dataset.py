# SPDX-License-Identifier: MIT
"""Training batches from shards: order of crops, decoding, checks, cropping and augmentation.

The order is a pure function of the seed: an epoch shuffles all views, divides them into blocks of
``block_views``, and shuffles the crops within each block. A view's crops are thus close together, and a
loader process that keeps the last block decodes each view once. A global batch is the next slice of that
order; each rank takes its part of the slice. For any number of ranks and loader processes, each crop is
therefore used at most once per epoch, and training can resume at any batch.

A sample is a dictionary of float32 tensors (C, S, S): ``beauty`` and the statistics (linear),
``normal_camera``, ``depth_z_m``, ``position`` (camera space, metres), the true maps, ``mask`` (bool), and the
scalars ``exposure``, ``depth_max_m``, ``sample_id`` and ``is_skipped``.
"""

from __future__ import annotations

import functools
import math
import os
import shutil
import signal
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from datagen.formats.shard import ViewPlace, read_buffers, read_record
from datagen.formats.view import ViewRecord
from datagen.foundation.buffers import LIGHT_BUFFERS, MATERIAL_MAPS, get_buffer
from datagen.foundation.errors import InputError, Problem, Problems, input_error, raise_problems
from model.networks import COLOR_STATISTICS, NetworkConfig, input_channels
from model.own_network import network_inputs
from model.training.conditions import generator_for
from model.training.config import DataConfig

_GEOMETRY_BUFFERS = ("normal_world", "depth_z_m", "surface_mask")
_REMEDY = "make the shard again, or train with --set data.on_bad_view=skip"
_ORDER_PURPOSE, _CROP_PURPOSE = 0x0D, 0xC4
_SHARED_MEMORY = Path("/dev/shm")
_RANGE_SLACK = 1e-3  # tolerance for rounding
_RADIANCE = ("beauty", *COLOR_STATISTICS, "mirror_sharp", "mirror_broad")
_ALBEDO = ("reflectance", MATERIAL_MAPS.diffuse_albedo, MATERIAL_MAPS.specular_albedo)


def buffer_names(network: NetworkConfig) -> tuple[str, ...]:
    """Names of the stored buffers of a view that training reads."""
    inputs = network_inputs(network)
    stored = (name for name in (*COLOR_STATISTICS, *LIGHT_BUFFERS) if name in inputs)
    return ("beauty", *stored, *MATERIAL_MAPS, *_GEOMETRY_BUFFERS)


@dataclass(frozen=True)
class DecodedView:
    """A checked view: its record, stored buffers (H, W, C) by name, and maximum depth in metres."""

    record: ViewRecord
    buffers: dict[str, NDArray]
    depth_max_m: float


def load_view(
    place: ViewPlace, names: Sequence[str], min_side_px: int = 1, size_px: tuple[int, int] | None = None
) -> DecodedView:
    """Decode and check the buffers ``names`` of one view.

    Raises :class:`InputError` with all faults, such as a side below ``min_side_px`` or a size other than
    ``size_px`` (width, height).
    """
    where, record = f"{place.shard}:{place.name}", read_record(place)
    try:
        buffers = read_buffers(place, names)
    except InputError as error:
        renamed = [Problem(where, p.field, p.got, p.expected, _REMEDY) for p in error.problems]
        raise InputError(*renamed) from None
    raise_problems(_problems_of(where, record, buffers, min_side_px, size_px))
    return DecodedView(record, buffers, float(buffers["depth_z_m"].max(initial=0.0)))


def _problems_of(
    where: str,
    record: ViewRecord,
    buffers: dict[str, NDArray],
    min_side_px: int,
    size_px: tuple[int, int] | None,
) -> list[Problem]:
    """All faults of a decoded view: size, NaN, values out of range, normals not of unit length, no depth."""
    problems = Problems(where)
    complain = functools.partial(problems.add, remedy=_REMEDY)
    camera = record.camera
    height, width = buffers["beauty"].shape[:2]
    if (height, width) != (camera.height_px, camera.width_px):
        complain("size", f"{width} x {height}", f"{camera.width_px} x {camera.height_px} as in its camera")
    if size_px is not None and (width, height) != size_px:
        complain("size", f"{width} x {height}", f"{size_px[0]} x {size_px[1]} as in the rest of the data")
    if min(height, width) < min_side_px:
        complain("size", f"{width} x {height}", f"at least the crop, {min_side_px} px per side")
    if not record.exposure > 0:
        complain("exposure", str(record.exposure), "a factor above 0")
    for name, values in buffers.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            complain(name, f"{int((~np.isfinite(values)).sum())} values NaN or Inf", "finite values")
        elif name in (*MATERIAL_MAPS, "surface_mask", "known_share"):
            low, high = float(values.min()), float(values.max())
            if low < -_RANGE_SLACK or high > 1.0 + _RANGE_SLACK:
                complain(
                    name,
                    f"{low:.4g} ... {high:.4g}",
                    "values in [0, 1] (albedos linear, roughness perceptual)",
                )
        elif name in ("beauty", *COLOR_STATISTICS, *LIGHT_BUFFERS, "depth_z_m") and values.min() < 0:
            complain(name, f"{float(values.min()):.4g}", "values >= 0")
    if not problems:
        solid = buffers["surface_mask"][..., 0] > 0.99
        length = np.linalg.norm(buffers["normal_world"].astype(np.float32), axis=-1)[solid]
        if length.size and np.median(np.abs(length - 1.0)) > 0.05:
            complain("normal_world", f"median length {np.median(length):.3g}", "unit vectors in world space")
        lacks_depth = (buffers["depth_z_m"][..., 0][solid] <= 0).mean() if solid.any() else 0.0
        if lacks_depth > 0.05:
            complain(
                "depth_z_m",
                f"0 on {100 * lacks_depth:.0f} % of the surface",
                "depth along the optical axis, in metres",
            )
    return problems


# --- order ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CropOrder:
    """Order of the crops of each epoch, a permutation of the ids view * crops_per_view + crop."""

    num_views: int
    crops_per_view: int
    block_views: int
    seed: int

    @property
    def epoch_length(self) -> int:
        """Number of crops per epoch."""
        return self.num_views * self.crops_per_view

    def epoch(self, epoch: int) -> NDArray[np.int64]:
        """Crop ids of an epoch in order, (epoch_length,)."""
        generator = generator_for(self.seed, _ORDER_PURPOSE, epoch)
        views = torch.randperm(self.num_views, generator=generator).numpy()
        parts = []
        for start in range(0, self.num_views, self.block_views):
            block = views[start : start + self.block_views]
            ids = (block[:, None] * self.crops_per_view + np.arange(self.crops_per_view)).ravel()
            parts.append(ids[torch.randperm(len(ids), generator=generator).numpy()])
        return np.concatenate(parts)


class BatchPlan(Sampler[list[int]]):
    """Micro-batches of one rank, from optimiser step ``start`` to ``stop``, as lists of sample ids, which are
    epoch * epoch_length + crop id.

    A step uses ``batch_size * accumulation * num_ranks`` crops; an incomplete step at the end of an epoch is
    dropped. Raises :class:`InputError` if an epoch has fewer crops than a step.
    """

    def __init__(
        self,
        order: CropOrder,
        batch_size: int,
        accumulation: int = 1,
        rank: int = 0,
        num_ranks: int = 1,
        start: int = 0,
        stop: int | None = None,
    ):
        self.order = order
        self.batch_size, self.accumulation = batch_size, accumulation
        self.rank, self.num_ranks = rank, num_ranks
        self.start, self.stop = start, stop
        step = batch_size * accumulation * num_ranks
        self.steps_per_epoch = order.epoch_length // step
        if self.steps_per_epoch == 0:
            expected = f"at least {step}, the crops of one step"
            remedy = "use more views, more crops per view, or a smaller batch"
            raise input_error("training data", "crops", order.epoch_length, expected, remedy)

    def __len__(self) -> int:
        if self.stop is None:
            raise TypeError("an endless plan has no length")
        return (self.stop - self.start) * self.accumulation

    def __iter__(self) -> Iterator[list[int]]:
        length, size = self.order.epoch_length, self.batch_size
        step_index, epoch, ids = self.start, -1, np.empty(0, np.int64)
        while self.stop is None or step_index < self.stop:
            if step_index // self.steps_per_epoch != epoch:
                epoch = step_index // self.steps_per_epoch
                ids = epoch * length + self.order.epoch(epoch)
            begin = (step_index % self.steps_per_epoch) * size * self.accumulation * self.num_ranks
            for micro in range(self.accumulation):
                offset = begin + (micro * self.num_ranks + self.rank) * size
                yield ids[offset : offset + size].tolist()
            step_index += 1


# --- crops ------------------------------------------------------------------------------------------------


class RecentViews:
    """LRU cache of at most ``limit`` decoded views by index; None for invalid views."""

    def __init__(self, limit: int):
        self._limit = limit
        self._views: OrderedDict[int, DecodedView | None] = OrderedDict()

    def __contains__(self, index: int) -> bool:
        return index in self._views

    def __getitem__(self, index: int) -> DecodedView | None:
        self._views.move_to_end(index)
        return self._views[index]

    def __setitem__(self, index: int, view: DecodedView | None) -> None:
        self._views[index] = view
        while len(self._views) > self._limit:
            self._views.popitem(last=False)


class SharedViews:
    """Decoded views by index, in memory shared by the loader processes; None for invalid views.

    Each of the buffers ``names`` is one tensor (N, H, W, C) for all ``places``, with images of ``size_px``
    (width, height). Raises :class:`InputError` if the shared memory is too small, since writing beyond it
    would kill the process without a message.
    """

    _STORED, _INVALID = 1, 2

    def __init__(self, places: Sequence[ViewPlace], names: Sequence[str], size_px: tuple[int, int]):
        self._places = places
        width, height = size_px
        shapes = {name: (len(places), height, width, get_buffer(name).num_channels) for name in names}
        dtypes = {name: torch.from_numpy(np.empty(0, get_buffer(name).dtype)).dtype for name in names}
        needed = sum(math.prod(shape) * dtypes[name].itemsize for name, shape in shapes.items())
        needed *= int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # torchrun: ranks of this machine
        free = shutil.disk_usage(_SHARED_MEMORY).free if _SHARED_MEMORY.is_dir() else needed
        if needed > free:
            got = f"{free / 1e9:.1f} GB free in {_SHARED_MEMORY}"
            remedy = "enlarge it (docker run --shm-size), or train with --set data.in_memory=false"
            raise input_error("data.in_memory", "", got, f"{needed / 1e9:.1f} GB", remedy)
        self._buffers = {name: _shared(shape, dtypes[name]) for name, shape in shapes.items()}
        self._state = _shared((len(places),), torch.uint8)
        self._records: dict[int, ViewRecord] = {}

    def __contains__(self, index: int) -> bool:
        return bool(self._state[index])

    def __getitem__(self, index: int) -> DecodedView | None:
        if self._state[index] == self._INVALID:
            return None
        if index not in self._records:
            self._records[index] = read_record(self._places[index])
        buffers = {name: values[index].numpy() for name, values in self._buffers.items()}
        return DecodedView(self._records[index], buffers, float(buffers["depth_z_m"].max(initial=0.0)))

    def __setitem__(self, index: int, view: DecodedView | None) -> None:
        # races are harmless: processes that store the same view write the same values
        if view is not None:
            for name, values in self._buffers.items():
                values[index].numpy()[...] = view.buffers[name]
        self._state[index] = self._INVALID if view is None else self._STORED


def _shared(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Make a tensor of zeros in shared memory; only pages that are written to take space."""
    # Tensor.share_memory_ would write all pages
    storage = torch.UntypedStorage._new_shared(math.prod(shape) * dtype.itemsize)
    return torch.empty(0, dtype=dtype).set_(storage).reshape(shape)


class CropDataset(Dataset[dict[str, Tensor]]):
    """Crops by sample id (see :class:`BatchPlan`); ``views`` caches decoded views (default: an LRU cache)."""

    def __init__(
        self,
        places: Sequence[ViewPlace],
        config: DataConfig,
        network: NetworkConfig,
        seed: int,
        size_px: tuple[int, int] | None = None,
        views: SharedViews | None = None,
    ):
        self.places = list(places)
        self.size_px = size_px
        self.config = config
        self.names = buffer_names(network)
        self.seed = seed
        self._views: RecentViews | SharedViews = views or RecentViews(config.block_views)

    def __len__(self) -> int:
        return len(self.places) * self.config.crops_per_view

    def _view(self, index: int) -> DecodedView | None:
        """Decoded view number ``index``, or None if it is invalid and skipped."""
        if index not in self._views:
            try:
                place = self.places[index]
                self._views[index] = load_view(place, self.names, self.config.crop_px, self.size_px)
            except InputError:
                if self.config.on_bad_view == "refuse":
                    raise
                self._views[index] = None
        return self._views[index]

    def __getitem__(self, crop_id: int) -> dict[str, Tensor]:
        view = self._view(crop_id % len(self) // self.config.crops_per_view)
        size = self.config.crop_px
        if view is None:
            return _empty_sample(self.names, size, crop_id)
        generator = generator_for(self.seed, _CROP_PURPOSE, crop_id)
        height, width = view.buffers["beauty"].shape[:2]
        top = int(torch.randint(0, height - size + 1, (1,), generator=generator))
        left = int(torch.randint(0, width - size + 1, (1,), generator=generator))
        flips = torch.randint(0, 2, (2,), generator=generator).bool().tolist()
        stops = float(torch.rand(1, generator=generator)) * 2.0 - 1.0
        sample = view_sample(view, crop_id, (top, left, size, size))
        if self.config.flips:
            sample = flip_sample(sample, horizontal=flips[0], vertical=flips[1])
        sample["exposure"] = sample["exposure"] * 2.0 ** (stops * self.config.exposure_jitter_stops)
        for name, sign in (("color_min", -1.0), ("color_max", 1.0)):
            widened = float(torch.rand(1, generator=generator)) * self.config.spread_jitter_stops
            if name in sample:
                sample[name] = sample[name] * 2.0 ** (sign * widened)
        self._augment(sample, generator)
        return sample

    def _augment(self, sample: dict[str, Tensor], generator: torch.Generator) -> None:
        """Apply ``light_color_stops``, ``light_jitter_stops`` and ``noise`` to a sample in place."""
        config = self.config
        if config.light_color_stops > 0:
            order = torch.randperm(3, generator=generator)
            stops = (2 * torch.rand(3, 1, 1, generator=generator) - 1) * config.light_color_stops
            for name in sample:
                if name in _RADIANCE:
                    sample[name] = sample[name][order] * 2.0**stops
                elif name in _ALBEDO:
                    sample[name] = sample[name][order]
        if config.light_jitter_stops > 0:
            scale = 2.0 ** ((2 * float(torch.rand(1, generator=generator)) - 1) * config.light_jitter_stops)
            for name in LIGHT_BUFFERS:
                if name in sample and name != "known_share":
                    sample[name] = sample[name] * scale
        if config.noise > 0:
            deviation = float(torch.rand(1, generator=generator)) * config.noise
            radiance, exposure = sample["beauty"], sample["exposure"]
            normal = torch.randn(radiance.shape, generator=generator)
            spread = deviation * torch.sqrt(radiance / exposure)
            sample["beauty"] = (radiance + spread * normal).clamp_min(0.0)


def view_sample(
    view: DecodedView, sample_id: int, window: tuple[int, int, int, int] | None = None
) -> dict[str, Tensor]:
    """Make a sample (see the module) of a view, or of its ``window`` (top, left, height, width) in pixels."""
    camera = view.record.camera
    top, left, height, width = window or (0, 0, camera.height_px, camera.width_px)
    rows, columns = slice(top, top + height), slice(left, left + width)
    cut = {name: values[rows, columns].astype(np.float32) for name, values in view.buffers.items()}
    depth = cut["depth_z_m"]
    x = (np.arange(left, left + width, dtype=np.float32) + 0.5 - camera.cx_px) / camera.fx_px
    y = (np.arange(top, top + height, dtype=np.float32) + 0.5 - camera.cy_px) / camera.fy_px
    ray = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones_like(depth[..., 0])], axis=-1)
    world_from_camera = np.asarray(camera.world_from_camera, dtype=np.float32)[:3, :3]
    normal = cut.pop("normal_world") @ world_from_camera  # n^T R is R^T n: camera from world
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    mask = (cut.pop("surface_mask") > 0.5) & (depth > 0) & (length > 0.5)
    cut["normal_camera"] = np.where(mask, normal / np.maximum(length, 1e-6), 0.0)
    cut["position"] = ray * depth
    for name in MATERIAL_MAPS:
        cut[name] = np.clip(cut[name], 0.0, 1.0)
    sample = {n: torch.from_numpy(np.ascontiguousarray(v.transpose(2, 0, 1))).float() for n, v in cut.items()}
    sample["mask"] = torch.from_numpy(np.ascontiguousarray(mask.transpose(2, 0, 1)))
    sample["exposure"] = torch.tensor(float(view.record.exposure))
    sample["depth_max_m"] = torch.tensor(view.depth_max_m)
    sample["sample_id"] = torch.tensor(sample_id, dtype=torch.int64)
    sample["is_skipped"] = torch.tensor(False)
    return sample


def flip_sample(sample: dict[str, Tensor], *, horizontal: bool, vertical: bool) -> dict[str, Tensor]:
    """Mirror the scene: flip pixels, and negate x (horizontal) or y (vertical) of normals and positions."""
    for axis, component, is_flipped in ((-1, 0, horizontal), (-2, 1, vertical)):
        if is_flipped:
            sample = {n: v.flip(axis) if v.dim() == 3 else v for n, v in sample.items()}
            for name in ("normal_camera", "position"):
                sample[name][component].neg_()
    return sample


def _empty_sample(names: Sequence[str], size: int, sample_id: int) -> dict[str, Tensor]:
    """Substitute for a crop of an invalid view; its empty mask excludes it from every loss."""
    renamed = [n for n in names if n not in ("normal_world", "surface_mask")] + ["normal_camera", "position"]
    channels = {"roughness": 1, "depth_z_m": 1}
    sample = {n: torch.zeros(channels.get(n, input_channels(n)), size, size) for n in renamed}
    sample["mask"] = torch.zeros(1, size, size, dtype=torch.bool)
    sample["exposure"] = torch.tensor(1.0)
    sample["depth_max_m"] = torch.tensor(0.0)
    sample["sample_id"] = torch.tensor(sample_id, dtype=torch.int64)
    sample["is_skipped"] = torch.tensor(True)
    return sample


def make_loader(
    dataset: CropDataset, plan: BatchPlan, *, workers: int, pin_memory: bool = False
) -> DataLoader[dict[str, Tensor]]:
    """Data loader of a plan's batches, decoded in advance by ``workers`` processes (0: in this process)."""
    return DataLoader(
        dataset,
        batch_sampler=plan,
        num_workers=workers,
        pin_memory=pin_memory,
        prefetch_factor=4 if workers else None,
        worker_init_fn=_start_worker,
        generator=torch.Generator(),  # otherwise the loader draws its seed from the global generator
        multiprocessing_context="spawn" if workers else None,
    )


def _start_worker(_: int) -> None:
    """Limit a loader process to one thread. Ignore Ctrl-C and the first SIGTERM, which may be sent to all
    processes of the run, since the training process needs more batches to finish its step. The DataLoader
    ends the process by further SIGTERMs: it sends at least two if the process does not stop."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: signal.signal(signal.SIGTERM, signal.SIG_DFL))
