# SPDX-License-Identifier: MIT
"""User-defined networks for tests."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Toy(nn.Module):
    """Two convolutions of colours, normal and depth, with batch normalisation, whose buffers are saved."""

    inputs = ("beauty", "color_median", "normal_camera", "depth")

    def __init__(self, width: int = 8):
        super().__init__()
        self.first = nn.Conv2d(12, width, 3, padding=1)
        self.norm = nn.BatchNorm2d(width)
        self.last = nn.Conv2d(width, 7, 1)

    def forward(self, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        x = torch.cat([inputs[name] for name in self.inputs], dim=1)
        y = torch.sigmoid(self.last(torch.relu(self.norm(self.first(x)))))
        return {"diffuse_albedo": y[:, :3], "specular_albedo": y[:, 3:6], "roughness": y[:, 6:]}


class Echo(nn.Module):
    """Returns its inputs: linear reflectance as D, known share as R."""

    inputs = ("reflectance", "known_share")

    def __init__(self) -> None:
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        span = torch.log(torch.tensor(1.01)) - torch.log(torch.tensor(0.01))
        linear = torch.exp((inputs["reflectance"] + 1) / 2 * span + torch.log(torch.tensor(0.01))) - 0.01
        share = (inputs["known_share"] + 1) / 2
        return {
            "diffuse_albedo": linear.clamp(0, 1),
            "specular_albedo": torch.zeros_like(linear),
            "roughness": share.clamp(0, 1),
        }


class Tied(Toy):
    """Has two layers with the same weight."""

    def __init__(self) -> None:
        super().__init__()
        self.same = nn.Conv2d(8, 7, 1)
        self.same.weight = self.last.weight


class Fixed(nn.Module):
    """Returns its input, without parameters."""

    inputs = ("beauty",)

    def forward(self, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        image = (inputs["beauty"] + 1) / 2
        return {"diffuse_albedo": image, "specular_albedo": image, "roughness": image[:, :1]}


class Unbounded(Toy):
    """Returns values above 1."""

    def forward(self, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        return {name: 3 * value for name, value in super().forward(inputs).items()}


class Halved(Toy):
    """Returns maps of half the size."""

    def forward(self, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        return {name: value[..., ::2, ::2] for name, value in super().forward(inputs).items()}


class Curious(Toy):
    """Names an input that does not exist."""

    inputs = ("beauty", "truth")  # type: ignore[assignment]


class Aimless(nn.Module):
    """Names no inputs."""


def not_a_class(**arguments: object) -> None:
    """A function instead of a network class."""
