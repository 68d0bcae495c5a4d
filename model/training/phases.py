# SPDX-License-Identifier: MIT
"""The parts of a training run: the ranks that share it, what is trained, and one phase ready to step."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from datagen.foundation.buffers import MATERIAL_MAPS
from model.confidence import ConfidenceNets
from model.networks import MaterialNetwork, TrackName, encode_color
from model.training.conditions import Geometry, SampleDraws
from model.training.confidence import confidence_loss
from model.training.config import PHASE_TRACKS, TrainingConfig
from model.training.dataset import BatchPlan, CropDataset, CropOrder, make_loader
from model.training.losses import LossTerms, MaterialLoss
from model.training.sources import TrainingData
from model.training.stopwatch import Stopwatch
from model.training.validation import network_predictor


class Ranks:
    """This process among those that train together; one process where ``torchrun`` did not start it."""

    def __init__(self) -> None:
        self.count = int(os.environ.get("WORLD_SIZE", "1"))
        self.index = int(os.environ.get("RANK", "0"))
        self.local_index = int(os.environ.get("LOCAL_RANK", "0"))
        if self.count > 1 and torch.cuda.is_available():
            torch.cuda.set_device(self.local_index)
        if self.count > 1 and not dist.is_initialized():
            dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")

    @property
    def is_first(self) -> bool:
        return self.index == 0

    def mean(self, values: dict[str, Tensor]) -> dict[str, float]:
        """Means of scalars over the ranks."""
        stacked = torch.stack([v.detach().float() for v in values.values()])
        if self.count > 1:
            dist.all_reduce(stacked)
            stacked /= self.count
        return dict(zip(values, stacked.tolist(), strict=True))

    def barrier(self) -> None:
        """Wait for every rank."""
        if self.count > 1:
            dist.barrier()


class Models(nn.Module):
    """Everything that is trained, under one state dictionary."""

    def __init__(self, config: TrainingConfig):
        super().__init__()
        self.network = MaterialNetwork(config.network)
        self.confidence = ConfidenceNets()


class TrackModule(nn.Module):
    """The tracks that a phase trains, so that only their gradients are exchanged between ranks."""

    def __init__(self, network: MaterialNetwork, tracks: tuple[TrackName, ...], precision: str):
        super().__init__()
        self.tracks, self.precision = tracks, precision
        self.trained = nn.ModuleList([network.tracks[track] for track in tracks])
        self._network = [network]  # in a list, so that the other track does not become a part of this module

    def forward(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Maps by name, (B, 3 or 1, S, S)."""
        device = batch["beauty"].device.type
        with torch.autocast(device, torch.bfloat16, enabled=self.precision == "bfloat16"):
            return self._network[0](batch, batch["exposure"], batch["depth_max_m"], self.tracks)


@dataclass(frozen=True)
class Workshop:
    """What all phases of a run share."""

    config: TrainingConfig
    data: TrainingData
    models: Models
    loss: MaterialLoss
    device: torch.device
    ranks: Ranks
    stopwatch: Stopwatch

    def order(self, index: int) -> tuple[CropOrder, int]:
        """The order of crops of a phase, and the phase's seed."""
        data, seed = self.config.data, self.config.seed * 16 + index
        return CropOrder(len(self.data.train), data.crops_per_view, data.block_views, seed), seed

    def plan(self, index: int, start: int, stop: int | None = None) -> BatchPlan:
        """This rank's micro-batches of a phase from step ``start`` on."""
        config, ranks = self.config, self.ranks
        order, _ = self.order(index)
        return BatchPlan(order, config.batch_size, config.accumulation, ranks.index, ranks.count, start, stop)

    def num_steps(self, index: int) -> int:
        """Optimiser steps of a phase."""
        phase = self.config.phases[index]
        return phase.steps or (phase.epochs or 1) * self.plan(index, 0).steps_per_epoch


class Phase:
    """One phase ready to run: what is trained, its optimiser, its data and its loss."""

    def __init__(self, shop: Workshop, index: int, num_steps: int | None = None):
        """``num_steps`` replaces the configuration's, for measurements without data."""
        config, models = shop.config, shop.models
        self.config = config.phases[index]
        self.index = index
        self.tracks = PHASE_TRACKS[self.config.name]
        self.shop = shop
        module: nn.Module = models.confidence
        if self.tracks:
            module = TrackModule(models.network, self.tracks, config.precision)
        module.to(shop.device)
        models.requires_grad_(False)
        module.requires_grad_(True)
        models.eval()
        module.train()
        self.num_steps = num_steps or shop.num_steps(index)
        self.optimizer = torch.optim.Adam(module.parameters(), self.learning_rate(0), betas=config.adam_betas)
        self.parameters = list(module.parameters())
        self.module = module
        if shop.ranks.count > 1:
            self.module = DistributedDataParallel(module)
        _, self.seed = shop.order(index)
        self.dataset = CropDataset(shop.data.train, config.data, config.network, self.seed, shop.data.size_px)

    def learning_rate(self, step: int) -> float:
        """The rate of a step of the phase, counted from 0: constant, or half a cosine to the final one."""
        first = self.config.learning_rate or self.shop.config.learning_rate
        last = self.config.final_learning_rate or self.shop.config.final_learning_rate
        if last is None:
            return first
        return last + (first - last) * 0.5 * (1 + math.cos(math.pi * step / max(1, self.num_steps - 1)))

    @property
    def steps_per_epoch(self) -> int:
        """Optimiser steps that a pass over the data takes."""
        return self.shop.plan(self.index, 0).steps_per_epoch

    def loader(self, start: int) -> Iterator[dict[str, Tensor]]:
        """Batches from step ``start`` to the phase's end."""
        plan = self.shop.plan(self.index, start, self.num_steps)
        workers, pin = self.shop.config.data.workers, self.shop.device.type == "cuda"
        return iter(make_loader(self.dataset, plan, workers=workers, pin_memory=pin))

    def terms(self, batch: dict[str, Tensor], generator: torch.Generator) -> LossTerms:
        """Loss of one micro-batch."""
        shop = self.shop
        truth = {name: batch[name] for name in MATERIAL_MAPS}
        watch = shop.stopwatch
        if not self.tracks:
            network = shop.models.network
            with torch.no_grad():
                predicted = network_predictor(network, ("diffuse", "specular"), shop.config.precision)(batch)
            image = encode_color(batch["beauty"], batch["exposure"].reshape(-1, 1, 1, 1))
            return confidence_loss(self.module, image, predicted, truth, batch["mask"], shop.config.solver)
        with watch.section("forward"):
            predicted = self.module(batch)
        geometry = Geometry(batch["position"], batch["normal_camera"], batch["mask"])
        draws = SampleDraws.for_samples(self.seed, batch["sample_id"].tolist())
        return shop.loss(predicted, truth, geometry, draws, generator, watch)
