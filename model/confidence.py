# SPDX-License-Identifier: MIT
"""The confidence networks and the filter that they control (network of Li et al. 2020).

A network estimates, from the image and a predicted map, the reliability of each pixel's prediction. The
bilateral solver then smooths the map, guided by the predicted diffuse albedo, from reliable pixels to
unreliable ones. Specular albedo and roughness are filtered, diffuse albedo is not. Images are (B, C, H, W).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.bilateral_solver import SolverConfig, bilateral_solve, build_grid

FILTERED_MAPS = {"specular_albedo": 3, "roughness": 1}
_WIDTH = 16


class _Block(nn.Sequential):
    """Replicate-padded convolution, GroupNorm of 2 groups, ReLU."""

    def __init__(self, num_in: int, size: int, stride: int):
        super().__init__(
            nn.Conv2d(num_in, _WIDTH, size, stride=stride, padding=1, padding_mode="replicate", bias=True),
            nn.GroupNorm(2, _WIDTH),
            nn.ReLU(),
        )


class ConfidenceNet(nn.Module):
    """Network that estimates the confidence of a predicted map with ``map_channels`` channels.

    The layers are two 4x4 stride-2 convolutions and a 3x3 convolution; upsampling, concatenation with the
    result of the first layer and a 3x3 convolution; upsampling and a last 3x3 convolution to one channel.
    """

    def __init__(self, map_channels: int):
        super().__init__()
        self.down1 = _Block(3 + map_channels, 4, 2)
        self.down2 = _Block(_WIDTH, 4, 2)
        self.middle = _Block(_WIDTH, 3, 1)
        self.up1 = _Block(2 * _WIDTH, 3, 1)
        self.last = nn.Conv2d(_WIDTH, 1, 3, padding=1, padding_mode="replicate")

    def forward(self, image: Tensor, predicted: Tensor) -> Tensor:
        """Return the confidence (B, 1, H, W), scaled to a maximum of 1 per image, of ``predicted`` (B, C, H,
        W) in [0, 1]; ``image`` (B, 3, H, W) is encoded to [-1, 1]. No gradient flows to the inputs."""
        height, width = image.shape[-2:]
        x = torch.cat([image, 2.0 * predicted - 1.0], dim=1).detach()
        bottom, right = -height % 4, -width % 4
        if bottom or right:
            x = F.pad(x, (0, right, 0, bottom), mode="replicate")
        first = self.down1(x)
        x = self.middle(self.down2(first))
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        x = self.up1(torch.cat([x, first], dim=1))
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        confidence = 0.5 * (torch.tanh(self.last(x)[:, :, :height, :width]) + 1.0)
        # the minimum avoids a division by 0 for an image whose confidence is 0 everywhere
        return confidence / confidence.amax(dim=(1, 2, 3), keepdim=True).clamp_min(1e-6)


class ConfidenceNets(nn.Module):
    """One :class:`ConfidenceNet` for each filtered map."""

    def __init__(self) -> None:
        super().__init__()
        self.nets = nn.ModuleDict({name: ConfidenceNet(c) for name, c in FILTERED_MAPS.items()})

    def forward(self, image: Tensor, maps: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the confidence (B, 1, H, W) of each filtered map, by name (see :class:`ConfidenceNet`)."""
        return {name: self.nets[name](image, maps[name]) for name in FILTERED_MAPS}


def filter_maps(
    maps: Mapping[str, Tensor], confidences: Mapping[str, Tensor], config: SolverConfig | None = None
) -> dict[str, Tensor]:
    """Filter the specular albedo and roughness of ``maps`` (B, 3 or 1, H, W), guided by the diffuse albedo.

    Returns all maps by name. ``confidences`` contains (B, 1, H, W) for each filtered map. Gradients flow to
    the confidences and to the specular albedo and roughness.
    """
    grid = build_grid(maps["diffuse_albedo"], config)
    target = torch.cat([maps[name] for name in FILTERED_MAPS], dim=1)
    confidence = torch.cat(
        [confidences[name].expand(-1, channels, -1, -1) for name, channels in FILTERED_MAPS.items()], dim=1
    )
    filtered = bilateral_solve(target, confidence, grid, config).clamp(0.0, 1.0)
    parts = filtered.split(list(FILTERED_MAPS.values()), dim=1)
    return {**maps, **dict(zip(FILTERED_MAPS, parts, strict=True))}
