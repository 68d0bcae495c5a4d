# SPDX-License-Identifier: MIT
"""A training phase: its networks, optimiser, data and loss."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.errors import InputError, Problem
from model.networks import MaterialNetwork, TrackName, encode_color
from model.own_network import OwnNetwork
from model.training.conditions import Geometry, SampleDraws
from model.training.config import PHASE_TRACKS
from model.training.context import TrainingContext
from model.training.dataset import CropDataset, make_loader
from model.training.losses import LossTerms, confidence_loss
from model.training.validation import network_predictor

_WARM_UP = 10.0  # early averages span a tenth of the steps so far, which excludes the initial weights


class TrackModule(nn.Module):
    """The tracks that a phase trains, as one module, so that ranks exchange no other gradients."""

    def __init__(self, network: MaterialNetwork | OwnNetwork, tracks: tuple[TrackName, ...], precision: str):
        super().__init__()
        self.tracks, self.precision = tracks, precision
        self.trained = nn.ModuleList(network.trained(tracks))
        self._network = [network]  # in a list, which prevents registration of the other track

    def forward(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Predicted maps by name, (B, 3 or 1, S, S) for crops of S pixels per side."""
        device = batch["beauty"].device.type
        with torch.autocast(device, torch.bfloat16, enabled=self.precision == "bfloat16"):
            return self._network[0](batch, batch["exposure"], batch["depth_max_m"], self.tracks)


class Phase:
    """Phase ``index`` of a run: its networks, optimiser, data and loss."""

    def __init__(self, context: TrainingContext, index: int, num_steps: int | None = None):
        """``num_steps`` replaces the configured number of steps, for measurements without data."""
        config, models = context.config, context.models
        self.config = config.phases[index]
        self.index = index
        self.tracks = PHASE_TRACKS[self.config.name]
        self.context = context
        module: nn.Module = models.confidence
        if self.tracks:
            module = TrackModule(models.network, self.tracks, config.precision)
        module.to(context.device)
        models.requires_grad_(False)
        module.requires_grad_(True)
        models.eval()
        module.train()
        self.num_steps = num_steps or context.num_steps(index)
        self.optimizer = torch.optim.Adam(module.parameters(), self.learning_rate(0), betas=config.adam_betas)
        self.parameters = list(module.parameters())
        self.average = WeightAverage(self.parameters, config.average_decay) if config.average_decay else None
        self.module = module
        if context.ranks.count > 1:
            self.module = DistributedDataParallel(module)
        _, self.seed = context.order(index)
        data = context.data
        self.dataset = CropDataset(
            data.train, config.data, config.network, self.seed, data.size_px, context.shared
        )

    def learning_rate(self, step: int) -> float:
        """Learning rate of step ``step`` (from 0): constant, or cosine annealing to the final rate."""
        first = self.config.learning_rate or self.context.config.learning_rate
        last = self.config.final_learning_rate or self.context.config.final_learning_rate
        if last is None:
            return first
        return last + (first - last) * 0.5 * (1 + math.cos(math.pi * step / max(1, self.num_steps - 1)))

    @property
    def steps_per_epoch(self) -> int:
        """Number of optimiser steps per pass over the data."""
        return self.context.plan(self.index, 0).steps_per_epoch

    def batches(self, start: int) -> Iterator[dict[str, Tensor]]:
        """Yield micro-batches from step ``start`` to the phase's end.

        Raises :class:`InputError` for an invalid view, even if a loader process found it.
        """
        plan = self.context.plan(self.index, start, self.num_steps)
        workers, pin = self.context.config.data.workers, self.context.device.type == "cuda"
        try:
            yield from make_loader(self.dataset, plan, workers=workers, pin_memory=pin)
        except InputError as error:
            _, is_from_worker, text = str(error).rpartition("datagen.foundation.errors.InputError: ")
            if not is_from_worker:
                raise
            where, _, rest = text.strip().partition(": ")
            raise InputError(Problem(where, got=rest)) from None

    def averaged_weights(self) -> AbstractContextManager[None]:
        """Context in which the networks have the averaged weights, if averaging is configured."""
        return self.average.applied() if self.average else nullcontext()

    def gradient_sync(self, is_last: bool) -> AbstractContextManager[Any]:
        """Context of one micro-batch, in which ranks exchange gradients only if it is the step's last."""
        if isinstance(self.module, DistributedDataParallel) and not is_last:
            return self.module.no_sync()
        return nullcontext()

    def terms(self, batch: dict[str, Tensor], generator: torch.Generator) -> LossTerms:
        """Loss of one micro-batch; ``generator`` supplies the perceptual metric's random transforms."""
        context = self.context
        truth = {name: batch[name] for name in MATERIAL_MAPS}
        watch = context.stopwatch
        if not self.tracks:
            network = context.models.network
            predictor = network_predictor(network, ("diffuse", "specular"), context.config.precision)
            with torch.no_grad():
                predicted = predictor(batch)
            image = encode_color(batch["beauty"], batch["exposure"].reshape(-1, 1, 1, 1))
            return confidence_loss(self.module, image, predicted, truth, batch["mask"], context.config.solver)
        with watch.section("forward"):
            predicted = self.module(batch)
        geometry = Geometry(batch["position"], batch["normal_camera"], batch["mask"])
        draws = SampleDraws.for_samples(self.seed, batch["sample_id"].tolist())
        return context.loss(predicted, truth, geometry, draws, generator, watch)


class WeightAverage:
    """Exponential moving average of ``parameters`` over about the last 1 / (1 - ``decay``) steps."""

    def __init__(self, parameters: Sequence[nn.Parameter], decay: float):
        self.parameters, self.decay = list(parameters), decay
        self.values = [parameter.detach().clone() for parameter in self.parameters]

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Update the averages with the current weights, after step ``step`` (from 1)."""
        share = 1.0 - min(self.decay, step / (_WARM_UP + step))
        for value, parameter in zip(self.values, self.parameters, strict=True):
            value.lerp_(parameter, share)

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Replace the weights by their averages within the context."""
        trained = [parameter.detach().clone() for parameter in self.parameters]
        self._set(self.values)
        try:
            yield
        finally:
            self._set(trained)

    @torch.no_grad()
    def _set(self, values: Sequence[Tensor]) -> None:
        for parameter, value in zip(self.parameters, values, strict=True):
            parameter.copy_(value)

    def tensors(self) -> dict[str, Tensor]:
        """The averages by name, for the state of a run."""
        return {f"average.{index}": value for index, value in enumerate(self.values)}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Set the averages from the saved result of :meth:`tensors`."""
        for index, value in enumerate(self.values):
            value.copy_(tensors[f"average.{index}"])
