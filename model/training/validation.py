# SPDX-License-Identifier: MIT
"""Errors of predicted maps on whole views, and simple baselines that a network must surpass."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import torch
from torch import Tensor

from datagen.formats.shard import ViewPlace
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.errors import InputError
from model.bilateral_solver import SolverConfig
from model.confidence import FILTERED_MAPS, ConfidenceNets, filter_maps
from model.networks import MaterialNetwork, TrackName, encode_color
from model.own_network import OwnNetwork
from model.training.config import PHASE_TRACKS, BadViewPolicy, PhaseName
from model.training.context import TrainingContext
from model.training.dataset import buffer_names, load_view, view_sample
from model.training.run_log import RunLog, view_panel
from model.training.sources import spread

ALL_TRACKS = PHASE_TRACKS["joint"]
Predictor = Callable[[Mapping[str, Tensor]], dict[str, Tensor]]
"""Function that maps a batch of buffers by name to predicted maps by name."""


def score_of(metrics: Mapping[str, float]) -> float:
    """Mean of the maps' mean squared errors; the best checkpoint has the lowest."""
    values = [value for name, value in metrics.items() if name.endswith("_mse")]
    return sum(values) / len(values)


def valid_views(
    places: Sequence[ViewPlace], names: Sequence[str], on_bad_view: BadViewPolicy
) -> list[ViewPlace]:
    """Return ``places`` without invalid views; with ``refuse``, these raise :class:`InputError`."""
    valid = []
    for place in places:
        try:
            load_view(place, names)
        except InputError:
            if on_bad_view == "refuse":
                raise
        else:
            valid.append(place)
    return valid


def whole_views(
    places: Iterable[ViewPlace], names: Sequence[str], device: torch.device
) -> Iterable[dict[str, Tensor]]:
    """Yield a batch of one sample for each whole view of ``places``, with the buffers ``names``."""
    for index, place in enumerate(places):
        sample = view_sample(load_view(place, names), index)
        yield {name: value.unsqueeze(0).to(device) for name, value in sample.items()}


@torch.no_grad()
def evaluate(predict: Predictor, batches: Iterable[Mapping[str, Tensor]]) -> dict[str, float]:
    """Mean squared and absolute errors of ``predict`` over the surface pixels and channels of batches, as
    ``<map>_mse`` and ``<map>_l1``.
    """
    sums: dict[str, dict[str, float]] = {}
    counts: dict[str, float] = {}
    for batch in batches:
        predicted = predict(batch)
        for name in MATERIAL_MAPS:
            if name not in predicted:
                continue
            error = ((predicted[name].float() - batch[name]) * batch["mask"]).double()
            total = sums.setdefault(name, {"mse": 0.0, "l1": 0.0})
            total["mse"] += float(error.square().sum())
            total["l1"] += float(error.abs().sum())
            pixels = float(batch["mask"].sum()) * batch[name].shape[1]
            counts[name] = counts.get(name, 0.0) + pixels
    return {f"{n}_{kind}": v / max(counts[n], 1.0) for n, kinds in sums.items() for kind, v in kinds.items()}


def network_predictor(
    network: MaterialNetwork | OwnNetwork, tracks: tuple[TrackName, ...], precision: str = "float32"
) -> Predictor:
    """Return a predictor that runs ``tracks`` of ``network`` in eval mode."""

    def predict(batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        modes = [(module, module.training) for module in network.modules()]
        network.eval()
        device = batch["beauty"].device.type
        with torch.autocast(device, torch.bfloat16, enabled=precision == "bfloat16"):
            maps = network(batch, batch["exposure"], batch["depth_max_m"], tracks)
        for module, was_training in modes:  # per module, since a phase may train a single track
            module.training = was_training
        return maps

    return predict


def filtered_predictor(predict: Predictor, nets: ConfidenceNets, solver: SolverConfig) -> Predictor:
    """Return a predictor that filters the S and R predicted by ``predict`` with the bilateral solver."""

    def filtered(batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        maps = predict(batch)
        image = encode_color(batch["beauty"], batch["exposure"].reshape(-1, 1, 1, 1))
        result = filter_maps(maps, nets(image, maps), solver)
        return {name: result[name] for name in FILTERED_MAPS}

    return filtered


def phase_metrics(
    context: TrainingContext, phase: PhaseName, views: Sequence[ViewPlace], log: RunLog, step: int
) -> dict[str, float]:
    """Errors on ``views``, by name, of the maps that a phase trains. Panels of some views are logged."""
    if not views:
        return {}
    config, models = context.config, context.models
    predict = network_predictor(models.network, PHASE_TRACKS[phase] or ALL_TRACKS, config.precision)
    if not PHASE_TRACKS[phase]:
        predict = filtered_predictor(predict, models.confidence, config.solver)
    names = buffer_names(config.network)
    metrics = evaluate(predict, whole_views(views, names, context.device))
    shown = spread(views, config.validation.num_panels)
    for index, batch in enumerate(whole_views(shown, names, context.device)):
        with torch.no_grad():
            log.panel(step, f"{phase}/view{index}", view_panel(batch, predict(batch)))
    return metrics


def final_metrics(context: TrainingContext, views: Sequence[ViewPlace]) -> dict[str, float]:
    """Errors of all maps on ``views`` by name, and of filtered maps if the last phase is ``confidence``."""
    if not views:
        return {}
    config, models = context.config, context.models
    names = buffer_names(config.network)
    predict = network_predictor(models.network, ALL_TRACKS, config.precision)
    metrics = evaluate(predict, whole_views(views, names, context.device))
    if config.phases[-1].name == "confidence":
        filtered = filtered_predictor(predict, models.confidence, config.solver)
        after = evaluate(filtered, whole_views(views, names, context.device))
        metrics |= {f"filtered_{key}": value for key, value in after.items()}
    return metrics


def mean_maps(batches: Iterable[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Mean (C, 1, 1) of every true map over the surface pixels of ``batches``."""
    sums: dict[str, Tensor] = {}
    count = 0.0
    for batch in batches:
        count += float(batch["mask"].sum())
        for name in MATERIAL_MAPS:
            total = (batch[name] * batch["mask"]).double().sum(dim=(0, 2, 3))
            sums[name] = sums.get(name, torch.zeros_like(total)) + total
    return {name: (total / max(count, 1.0)).float().reshape(-1, 1, 1) for name, total in sums.items()}


def constant_predictor(means: Mapping[str, Tensor]) -> Predictor:
    """Return a predictor of constant maps: the ``means`` (C, 1, 1) of the training set."""
    return lambda batch: {name: value.expand_as(batch[name]) for name, value in means.items()}


def median_predictor(batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Baseline that predicts the exposed ``color_median``, clipped to [0, 1], as the diffuse albedo."""
    exposed = batch["color_median"] * batch["exposure"].reshape(-1, 1, 1, 1)
    return {"diffuse_albedo": exposed.clamp(0.0, 1.0)}


def reflectance_predictor(batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Baseline that predicts the recorded reflectance, clipped to [0, 1], as the diffuse albedo."""
    return {"diffuse_albedo": batch["reflectance"].clamp(0.0, 1.0)}
