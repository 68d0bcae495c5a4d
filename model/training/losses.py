# SPDX-License-Identifier: MIT
"""The training loss: re-renderings and maps, each under an L1 and a perceptual distance.

    L = L_E(I) + L_1(I) + sum over the predicted maps M of (L_E(M) + lambda L_1(M)),  lambda = 0.1

L_E is the perceptual and L_1 the L1 distance between prediction and truth. I are images of the materials
under random views and lights. Maps are (B, C, H, W) in [0, 1] by name: ``diffuse_albedo``,
``specular_albedo`` and ``roughness``. The true map replaces a map that is not predicted, and predictions at
pixels without a surface.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from datagen.formats.base import StrictModel
from datagen.foundation.buffers import MATERIAL_MAPS
from model.bilateral_solver import SolverConfig
from model.confidence import FILTERED_MAPS, filter_maps
from model.shading import shade_point_light, shade_spherical_gaussians
from model.training.conditions import (
    AreaCondition,
    Geometry,
    PointCondition,
    SampleDraws,
    sample_area_condition,
    sample_point_condition,
)
from model.training.stopwatch import Stopwatch

METAL_ABOVE = 0.2
"""Specular albedo (maximum over channels) above which a surface counts as metal."""
_LOG_OFFSET = 0.1  # compresses the range of the re-renderings and keeps the logarithm finite at 0


class LossConfig(StrictModel):
    """Weights of the loss terms, and numbers of re-renderings."""

    num_point_lights: int = Field(default=3, ge=0)
    num_area_lights: int = Field(default=3, ge=0)
    map_l1_weight: float = Field(default=0.1, ge=0)
    map_l2_weight: float = Field(default=0.0, ge=0)
    """Weight of the maps' mean squared errors. L1 alone is minimised by the median, which is a dielectric's
    specular albedo where metal is rare (decision 0015)."""
    metal_weight: float = Field(default=1.0, ge=0)
    """Factor of the squared errors of metal (true S above 0.2): if metal is more frequent in a recipe than
    in rooms, a weight below 1 prevents predictions of metal on dark surfaces."""
    perceptual_weight: float = Field(default=1.0, ge=0)
    """Weight of every perceptual term; 0 omits them."""
    num_perceptual_renders: int | None = Field(default=None, ge=0)
    """Number of randomly chosen re-renderings for which the perceptual distance is computed; None: all. Fewer
    take less time and leave the expectation unchanged."""

    @model_validator(mode="after")
    def _any_term(self) -> LossConfig:
        lights = self.num_point_lights + self.num_area_lights
        if lights + self.map_l1_weight + self.map_l2_weight + self.perceptual_weight == 0:
            raise ValueError("expected a light or a weight above 0, without which nothing is trained")
        return self


def encode_log(image: Tensor) -> Tensor:
    """ln(0.1 + I) of an image I, of any shape."""
    return torch.log(image + _LOG_OFFSET)


def encode_log_unit(image: Tensor) -> Tensor:
    """(ln(0.1 + I) - ln 0.1) / (ln 1.1 - ln 0.1), clipped to [0, 1], the range of the perceptual metric."""
    span = math.log(1.0 + _LOG_OFFSET) - math.log(_LOG_OFFSET)
    return ((encode_log(image) - math.log(_LOG_OFFSET)) / span).clamp(0.0, 1.0)


Condition = PointCondition | AreaCondition


def render(maps: Mapping[str, Tensor], geometry: Geometry, condition: Condition) -> Tensor:
    """Radiance (B, 3, H, W) reflected by surfaces with ``maps`` under one condition, computed in float32."""
    diffuse, specular, roughness = (maps[name].float() for name in MATERIAL_MAPS)
    normal, view = geometry.normal, condition.view_dir
    if isinstance(condition, PointCondition):
        position, light = geometry.position, condition.light_position
        return shade_point_light(
            diffuse, specular, roughness, normal, view, position, light, condition.intensity
        )
    return shade_spherical_gaussians(diffuse, specular, roughness, normal, view, condition.lights)


@dataclass(frozen=True)
class LossTerms:
    """The ``total`` loss to minimise and its unweighted parts by name, all scalars."""

    total: Tensor
    parts: dict[str, Tensor]


class MaterialLoss(nn.Module):
    """Weighted sum of L1 and ``perceptual`` distances of rendered images and maps, and L2 distances of maps.

    ``perceptual`` is from :mod:`model.training.perceptual`; None omits it.
    """

    def __init__(self, config: LossConfig, perceptual: nn.Module | None):
        super().__init__()
        self.config = config
        self.perceptual = perceptual if config.perceptual_weight > 0 else None

    @property
    def name(self) -> str:
        """Name of the loss in checkpoints: its terms and the perceptual distance."""
        distance = "none" if self.perceptual is None else str(self.perceptual.name)
        return f"l1+{'l2+' if self.config.map_l2_weight > 0 else ''}{distance}"

    def forward(
        self,
        predicted: Mapping[str, Tensor],
        truth: Mapping[str, Tensor],
        geometry: Geometry,
        draws: SampleDraws,
        generator: torch.Generator,
        stopwatch: Stopwatch | None = None,
    ) -> LossTerms:
        """Loss of a batch of crops; maps that are missing in ``predicted`` have no terms.

        ``predicted`` and ``truth`` are (B, 3 or 1, H, W) by name. Each image's views and lights come from
        ``draws``, the transforms of E-LPIPS from the CPU ``generator``. ``stopwatch`` measures the sections
        ``render`` and ``perceptual``.
        """
        watch = stopwatch or Stopwatch()
        mask = geometry.mask
        shown = {
            n: torch.where(mask, predicted[n].float(), truth[n]) for n in MATERIAL_MAPS if n in predicted
        }
        materials = {**truth, **shown}
        parts: dict[str, Tensor] = {}
        total = next(iter(shown.values())).new_zeros(())
        with watch.section("render"):
            images = self._render_all(materials, truth, geometry, draws)
        if images:
            l1 = [(encode_log(ours) - encode_log(theirs)).abs().mean() for ours, theirs in images]
            parts["render_l1"] = torch.stack(l1).mean()
            total = total + parts["render_l1"]
            count = self.config.num_perceptual_renders
            if self.perceptual is not None and count != 0:
                order = torch.randperm(len(images), generator=generator).tolist()[:count]
                pairs = [tuple(encode_log_unit(image) for image in images[k]) for k in order]
                with watch.section("perceptual"):
                    parts["render_perceptual"] = self._distance(pairs, generator)
                total = total + self.config.perceptual_weight * parts["render_perceptual"]
        is_metal = truth[MATERIAL_MAPS.specular_albedo].amax(dim=1, keepdim=True) > METAL_ABOVE
        weights = torch.where(is_metal, self.config.metal_weight, 1.0)
        for name, ours in shown.items():
            theirs = truth[name]
            parts[f"{name}_l1"] = (ours - theirs).abs().mean()
            total = total + self.config.map_l1_weight * parts[f"{name}_l1"]
            if self.config.map_l2_weight > 0:
                parts[f"{name}_l2"] = (weights * (ours - theirs).square()).mean()
                total = total + self.config.map_l2_weight * parts[f"{name}_l2"]
            if self.perceptual is not None:
                pair = (ours.expand(-1, 3, -1, -1), theirs.expand(-1, 3, -1, -1))
                with watch.section("perceptual"):
                    parts[f"{name}_perceptual"] = self._distance([pair], generator)
                total = total + self.config.perceptual_weight * parts[f"{name}_perceptual"]
        return LossTerms(total, parts)

    def _render_all(
        self,
        materials: Mapping[str, Tensor],
        truth: Mapping[str, Tensor],
        geometry: Geometry,
        draws: SampleDraws,
    ) -> list[tuple[Tensor, Tensor]]:
        conditions: list[Condition] = [
            *(sample_point_condition(geometry, draws) for _ in range(self.config.num_point_lights)),
            *(sample_area_condition(geometry, draws) for _ in range(self.config.num_area_lights)),
        ]
        pairs = []
        for condition in conditions:
            with torch.no_grad():
                target = render(truth, geometry, condition)
            pairs.append((render(materials, geometry, condition), target))
        return pairs

    def _distance(self, pairs: list[tuple[Tensor, ...]], generator: torch.Generator) -> Tensor:
        """Mean perceptual distance of image pairs, each with an independent transform and dropout."""
        assert self.perceptual is not None
        return torch.stack([self.perceptual(*pair, generator).mean() for pair in pairs]).mean()


def confidence_loss(
    nets: nn.Module,
    image: Tensor,
    predicted: Mapping[str, Tensor],
    truth: Mapping[str, Tensor],
    mask: Tensor,
    solver: SolverConfig,
) -> LossTerms:
    """Sum of the filtered maps' mean squared errors on surfaces; gradients reach only the confidence nets.

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
