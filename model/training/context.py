# SPDX-License-Identifier: MIT
"""Training context: the ranks, the models, the loss and the data of all phases."""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn

from datagen.foundation.errors import input_error
from model.checkpoint import DataRecord, load_checkpoint
from model.confidence import ConfidenceNets
from model.networks import TRACK_OUTPUTS, MaterialNetwork, input_channels, track_inputs
from model.own_network import OwnNetwork, make_network, try_network
from model.training.conditions import generator_for
from model.training.config import TrainingConfig
from model.training.dataset import BatchPlan, CropOrder, SharedViews, buffer_names
from model.training.losses import MaterialLoss
from model.training.perceptual import make_perceptual
from model.training.sources import TrainingData
from model.training.stopwatch import Stopwatch

_INIT_PURPOSE = 0x11


class Ranks:
    """Number of ranks and this process's rank under ``torchrun``; a single rank without it.

    ``device``: device of training; None: this rank's GPU if there is one.
    """

    def __init__(self, device: torch.device | None = None) -> None:
        uses_gpu = torch.cuda.is_available() if device is None else device.type == "cuda"
        self.count = int(os.environ.get("WORLD_SIZE", "1"))
        self.index = int(os.environ.get("RANK", "0"))
        self.local_index = int(os.environ.get("LOCAL_RANK", "0"))
        if self.count > 1 and uses_gpu:
            torch.cuda.set_device(self.local_index)
        if self.count > 1 and not dist.is_initialized():
            dist.init_process_group("nccl" if uses_gpu else "gloo")

    @property
    def is_first(self) -> bool:
        return self.index == 0

    def mean(self, values: dict[str, Tensor]) -> dict[str, float]:
        """Mean of each scalar of ``values`` over the ranks."""
        stacked = torch.stack([v.detach().float() for v in values.values()])
        if self.count > 1:
            dist.all_reduce(stacked)
            stacked /= self.count
        return dict(zip(values, stacked.tolist(), strict=True))

    def barrier(self) -> None:
        if self.count > 1:
            dist.barrier()


class Models(nn.Module):
    """All trained networks as one module, with one state dictionary."""

    def __init__(self, config: TrainingConfig):
        super().__init__()
        self.network = make_network(config.network)
        self.confidence = ConfidenceNets()


@dataclass(frozen=True)
class TrainingContext:
    """Objects shared by all phases of a run.

    ``inherited``: records of the datasets on which ``initial_checkpoint`` was trained; ``shared``: decoded
    views if ``data.in_memory``, else None.
    """

    config: TrainingConfig
    data: TrainingData
    models: Models
    inherited: tuple[DataRecord, ...]
    loss: MaterialLoss
    device: torch.device
    ranks: Ranks
    stopwatch: Stopwatch
    shared: SharedViews | None = None

    def order(self, index: int) -> tuple[CropOrder, int]:
        """Return the crop order and the seed of phase ``index``."""
        data, seed = self.config.data, self.config.seed * 16 + index
        return CropOrder(len(self.data.train), data.crops_per_view, data.block_views, seed), seed

    def plan(self, index: int, start: int, stop: int | None = None) -> BatchPlan:
        """Micro-batches of this rank in phase ``index`` for steps [start, stop); endless if stop is None."""
        config, ranks = self.config, self.ranks
        order, _ = self.order(index)
        return BatchPlan(order, config.batch_size, config.accumulation, ranks.index, ranks.count, start, stop)

    def num_steps(self, index: int) -> int:
        """Number of optimiser steps of phase ``index``."""
        phase = self.config.phases[index]
        return phase.steps or (phase.epochs or 1) * self.plan(index, 0).steps_per_epoch


def make_context(
    config: TrainingConfig,
    data: TrainingData,
    device: torch.device | None = None,
    stopwatch: Stopwatch | None = None,
) -> TrainingContext:
    """Construct the initial models and the loss on ``device`` (default: a GPU if available).

    Raises :class:`InputError` for an unsuitable ``initial_checkpoint``, network or file of VGG16's weights.
    """
    ranks = Ranks(device)
    if device is None:
        device = torch.device("cuda", ranks.local_index) if torch.cuda.is_available() else torch.device("cpu")
    perceptual = None
    if config.loss.perceptual_weight > 0:
        chosen = config.perceptual
        perceptual = make_perceptual(chosen.kind, chosen.vgg, chosen.heads, chosen.precision)
    loss = MaterialLoss(config.loss, perceptual).to(device)
    models, inherited = _initial_models(config)
    models.to(device)
    if config.channels_last:
        models.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if config.compile:
        for part in models.network.trained(("diffuse", "specular")):
            part.compile()
    stopwatch = stopwatch or Stopwatch()
    shared = None
    if config.data.in_memory:
        shared = SharedViews(data.train, buffer_names(config.network), data.size_px)
    return TrainingContext(config, data, models, inherited, loss, device, ranks, stopwatch, shared)


def _initial_models(config: TrainingConfig) -> tuple[Models, tuple[DataRecord, ...]]:
    """Return models with random weights or an initial checkpoint's, and the records of its datasets."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(generator_for(config.seed, _INIT_PURPOSE).initial_seed()))
        models = Models(config)
    if isinstance(models.network, OwnNetwork):
        try_network(models.network)
    path = config.initial_checkpoint
    if path is None:
        return models, ()
    first = load_checkpoint(path)
    given, wanted = first.card.network, config.network
    light = {"light_inputs": wanted.light_inputs, "blends_reflectance": wanted.blends_reflectance}
    is_narrower = set(given.light_inputs) <= set(wanted.light_inputs)
    is_narrower &= wanted.blends_reflectance or not given.blends_reflectance
    if not is_narrower or given.model_copy(update=light) != wanted:
        expected = f"{wanted}, or the same with fewer light_inputs or without blends_reflectance"
        raise input_error(path, "network", given, expected)
    if isinstance(first.network, MaterialNetwork) and isinstance(models.network, MaterialNetwork):
        models.network.load_state_dict(_widened(first.network, models.network))
    else:
        models.network.load_state_dict(first.network.state_dict())
    if first.confidence is not None:
        models.confidence.load_state_dict(first.confidence.state_dict())
    return models, first.card.data


def _widened(network: MaterialNetwork, wider: MaterialNetwork) -> dict[str, Tensor]:
    """Initial weights of ``wider``, which may have more inputs and outputs than the trained ``network``.

    Weights of new inputs are 0, so the outputs of ``network`` are unchanged before training. New outputs keep
    the random weights of ``wider`` and do not affect the others.
    """
    weights, random = dict(network.state_dict()), wider.state_dict()
    for track in TRACK_OUTPUTS:
        given = set(track_inputs(track, network.config))
        is_given = torch.cat(
            [torch.full((input_channels(n),), n in given) for n in track_inputs(track, wider.config)]
        )
        for name in (f"tracks.{track}.enc1.weight", f"tracks.{track}.global_start.weight"):
            narrow = weights[name]
            wide = narrow.new_zeros(len(narrow), len(is_given), *narrow.shape[2:])
            wide[:, is_given] = narrow
            weights[name] = wide
        for layer in ("conv1", "conv2", "link.add"):
            name = f"tracks.{track}.dec1.{layer}.weight"
            narrow, wide = weights[name], random[name].clone()
            wide[: len(narrow)] = 0
            wide[: len(narrow), : narrow.shape[1]] = narrow
            weights[name] = wide
    return weights
