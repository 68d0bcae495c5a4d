# SPDX-License-Identifier: MIT
"""Loss of the confidence networks: the error of the maps that they filter."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from model.bilateral_solver import SolverConfig
from model.confidence import FILTERED_MAPS, filter_maps
from model.training.losses import LossTerms


def confidence_loss(
    nets: nn.Module,
    image: Tensor,
    predicted: Mapping[str, Tensor],
    truth: Mapping[str, Tensor],
    mask: Tensor,
    solver: SolverConfig,
) -> LossTerms:
    """Mean squared error of the filtered maps over surface pixels; gradients reach only the confidence nets.

    ``nets`` is a :class:`model.confidence.ConfidenceNets`, possibly wrapped for several ranks. ``image`` (B,
    3, H, W) is encoded to [-1, 1]; ``predicted`` and ``truth`` contain all three maps (B, 3 or 1, H, W);
    ``mask`` (B, 1, H, W) is True on surfaces. The result's ``parts`` also contain the error before filtering.
    """
    frozen = {name: value.detach().float() for name, value in predicted.items()}
    with torch.autocast(image.device.type, enabled=False):
        filtered = filter_maps(frozen, nets(image.float(), frozen), solver)
    weight = mask.to(image.dtype)
    count = weight.sum().clamp_min(1.0)
    parts: dict[str, Tensor] = {}
    for name, channels in FILTERED_MAPS.items():
        for label, maps in (("filtered", filtered), ("raw", frozen)):
            error = (maps[name] - truth[name]).square() * weight
            parts[f"{name}_{label}_mse"] = error.sum() / (count * channels)
    total = torch.stack([parts[f"{name}_filtered_mse"] for name in FILTERED_MAPS]).sum()
    return LossTerms(total, parts)
