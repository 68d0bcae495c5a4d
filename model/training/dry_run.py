# SPDX-License-Identifier: MIT
"""Dry run: resolved configuration, sizes, memory and time, estimated from a few steps on synthetic crops."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from datagen.foundation.buffers import MATERIAL_MAPS
from model.networks import INPUTS, input_channels, num_parameters
from model.training.conditions import generator_for
from model.training.config import TrainingConfig
from model.training.context import make_context
from model.training.phases import Phase
from model.training.sources import open_data, validation_note
from model.training.stopwatch import Stopwatch


def synthetic_batch(batch: int, size: int, device: torch.device) -> dict[str, Tensor]:
    """Batch of ``batch`` square crops of ``size`` pixels per side, of a plane at a distance of 2 m."""
    generator = torch.Generator().manual_seed(0)

    def smooth(channels: int) -> Tensor:
        small = torch.rand(batch, channels, 8, 8, generator=generator)
        return torch.nn.functional.interpolate(small, size=(size, size), mode="bilinear")

    y, x = torch.meshgrid(torch.linspace(-0.5, 0.5, size), torch.linspace(-0.5, 0.5, size), indexing="ij")
    z = torch.full_like(x, 2.0)
    inputs = (name for name in INPUTS if name not in ("normal_camera", "depth"))
    images = {name: smooth(input_channels(name)) for name in inputs}
    images |= {name: smooth(1 if name == "roughness" else 3) for name in MATERIAL_MAPS}
    images["normal_camera"] = torch.tensor([0.0, 0.0, -1.0]).reshape(1, 3, 1, 1).expand(batch, 3, size, size)
    images["position"] = torch.stack([x * z, y * z, z]).expand(batch, 3, size, size)
    images["depth_z_m"] = z.expand(batch, 1, size, size)
    images["mask"] = torch.ones(batch, 1, size, size, dtype=torch.bool)
    images["exposure"] = torch.ones(batch)
    images["depth_max_m"] = torch.full((batch,), 2.0)
    images["sample_id"] = torch.arange(batch)
    images["is_skipped"] = torch.zeros(batch, dtype=torch.bool)
    return {name: value.contiguous().to(device) for name, value in images.items()}


def timed_step(phase: Phase, batch: dict[str, Tensor], key: int, watch: Stopwatch) -> float:
    """Seconds of one optimiser step of a phase on ``batch``; ``key`` seeds its random numbers."""
    before = watch.seconds.get("step", 0.0)
    with watch.section("step"):
        phase.optimizer.zero_grad(set_to_none=True)
        terms = phase.terms(batch, generator_for(key))
        with watch.section("backward"):
            terms.total.backward()
        with watch.section("optimizer"):
            phase.optimizer.step()
    return watch.seconds["step"] - before


def predicted_step(phase: Phase, config: TrainingConfig, device: torch.device) -> tuple[float, int]:
    """Predict the seconds of a step with a whole batch; also return the largest timed number of crops.

    One crop is timed, then as many as fit into 3 s (at most the batch); the difference separates the cost per
    crop from the fixed cost of a step.
    """

    def fastest(crops: int) -> float:
        batch = synthetic_batch(crops, config.data.crop_px, device)
        # the minimum is the least disturbed measurement
        return min(timed_step(phase, batch, key, Stopwatch(device)) for key in (1, 2))

    timed_step(phase, synthetic_batch(1, config.data.crop_px, device), 0, Stopwatch(device))  # warm-up
    one = fastest(1)
    crops = min(config.batch_size, max(1, int(3.0 / (2 * one))))
    if crops == 1:
        return one * config.batch_size, 1
    several = fastest(crops)
    return several + max(several - one, 0.0) / (crops - 1) * (config.batch_size - crops), crops


def saved_bytes(run: Callable[[], Any]) -> int:
    """Call ``run`` and return the size in bytes of the storages that autograd saves for the backward pass."""
    sizes: dict[int, int] = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        sizes[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        run()
    return sum(sizes.values())


def describe_run(config: TrainingConfig, folders: list[Path], device: torch.device | None = None) -> str:
    """Text for ``--dry-run``: configuration, data, and the estimated memory and time of each phase."""
    data = open_data(folders, config.network, config.data.crop_px)
    context = make_context(config, data, device)
    device = context.device
    lines = [yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False).rstrip(), ""]
    width, height = data.size_px
    lines.append(
        f"data: {len(data.train)} training and {len(data.validation)} validation views, {width} x {height}"
    )
    if note := validation_note(data, config.validation.num_views):
        lines.append(note)
    for name, part in context.models.network.parts().items():
        lines.append(f"{name}: {num_parameters(part):,} parameters")
    lines.append(f"confidence: {num_parameters(context.models.confidence):,} parameters")
    lines.append(f"loss: {context.loss.name}; device: {device}, {torch.get_num_threads()} threads")
    batch = synthetic_batch(1, config.data.crop_px, device)
    total = 0.0
    for index in range(len(config.phases)):
        phase = Phase(context, index)
        steps = phase.num_steps
        activations = saved_bytes(lambda p=phase: p.terms(batch, generator_for(0)))  # type: ignore[misc]
        seconds, crops = predicted_step(phase, config, device)
        weights = sum(p.numel() for p in context.models.parameters()) * 4
        moving = sum(p.numel() for p in phase.parameters) * 4 * 3  # gradient and two moments
        memory = (activations * config.batch_size + weights + moving) / 2**30
        hours = steps * config.accumulation * seconds / 3600
        total += hours
        lines.append(
            f"{phase.config.name}: {steps:,} steps, about {memory:.1f} GiB and {hours:.2f} h "
            f"({seconds:.2f} s per batch, measured with {crops} crop{'s' * (crops > 1)})"
        )
    lines.append(f"in all about {total:.2f} h, without validation")
    return "\n".join(lines)
