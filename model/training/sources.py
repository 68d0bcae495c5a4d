# SPDX-License-Identifier: MIT
"""Views of dataset folders for training and validation, checked before training starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.formats.base import sha256_file
from datagen.formats.configuration import Split
from datagen.formats.shard import INDEX_FILE, ViewPlace, index_shard, read_record
from datagen.formats.shard import Dataset as DatasetFolder
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from model.checkpoint import DataRecord
from model.networks import NetworkConfig
from model.training.dataset import buffer_names


@dataclass(frozen=True)
class TrainingData:
    """Views for training and validation, their (width, height) in pixels, and records of the datasets."""

    train: tuple[ViewPlace, ...]
    validation: tuple[ViewPlace, ...]
    size_px: tuple[int, int]
    records: tuple[DataRecord, ...]


def validation_note(data: TrainingData, num_views: int) -> str:
    """Warning for a user if ``num_views`` > 0 but the data has no validation views; otherwise ""."""
    if data.validation or not num_views:
        return ""
    return (
        "no validation: the data has no views of the split `validation`, so overfitting goes unnoticed "
        "and best-*.safetensors contain each phase's last weights; give the recipe splits: {train: 0.9, "
        "validation: 0.1} or set validation.num_views=0"
    )


def open_data(folders: Sequence[Path], network: NetworkConfig, crop_px: int) -> TrainingData:
    """List the training and validation views of dataset folders, without decoding them.

    Raises :class:`InputError` if an index lacks a buffer that the network needs, a shard is missing or
    damaged, the first view is smaller than ``crop_px`` per side, or there are no training views.
    """
    needed = buffer_names(network)
    places: dict[Split, list[ViewPlace]] = {"train": [], "validation": []}
    records, problems = [], []
    for folder in folders:
        dataset = DatasetFolder(Path(folder))
        missing = [name for name in needed if name not in dataset.index.buffers]
        if missing:
            where = Path(folder) / INDEX_FILE
            problems.append(Problem(where, "buffers", f"no {', '.join(missing)}", "all buffers for training"))
            continue
        for split, found in places.items():
            for path in dataset.shard_paths(split):
                try:
                    found += index_shard(path)
                except InputError as error:
                    problems += error.problems
        digest = sha256_file(Path(folder) / INDEX_FILE)
        records.append(
            DataRecord(
                name=dataset.index.recipe.name,
                index_sha256=digest,
                num_views=dataset.index.num_views,
                assets={name: asset.sha256 for name, asset in dataset.index.assets.items()},
            )
        )
    raise_problems(problems)
    if not places["train"]:
        listed = ", ".join(str(f) for f in folders) or "no folder"
        raise input_error(
            "training data", listed, "no views of split train", "at least one shard of that split"
        )
    first = places["train"][0]
    camera = read_record(first).camera
    size = camera.width_px, camera.height_px
    if min(size) < crop_px:
        view = f"{first.shard}:{first.name}"
        expected = f"at least {crop_px} px per side"
        raise input_error(view, "size", f"{size[0]} x {size[1]}", expected, "reduce data.crop_px")
    return TrainingData(tuple(places["train"]), tuple(places["validation"]), size, tuple(records))


def spread(places: Sequence[ViewPlace], count: int) -> list[ViewPlace]:
    """Select at most ``count`` views, evenly spaced in ``places``."""
    if count >= len(places):
        return list(places)
    return [places[k * len(places) // count] for k in range(count)]
