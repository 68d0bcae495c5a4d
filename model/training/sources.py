# SPDX-License-Identifier: MIT
"""Views of dataset folders for training and validation, checked before work starts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.formats.base import parse_model, sha256_file
from datagen.formats.configuration import Split
from datagen.formats.shard import INDEX_FILE
from datagen.formats.shard import Dataset as DatasetFolder
from datagen.formats.view import ViewRecord
from datagen.formats.view_places import ViewPlace, index_shard, read_member
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from model.checkpoint import DataRecord
from model.networks import NetworkConfig
from model.training.dataset import buffer_names


@dataclass(frozen=True)
class TrainingData:
    """Views of both splits, their common size (width, height) in pixels, and records of the datasets."""

    train: tuple[ViewPlace, ...]
    validation: tuple[ViewPlace, ...]
    size_px: tuple[int, int]
    records: tuple[DataRecord, ...]


def validation_note(data: TrainingData, num_views: int) -> str:
    """Warning if ``num_views`` > 0 validation views are configured but there are none; "" otherwise."""
    if data.validation or not num_views:
        return ""
    return (
        "no validation: the data has no views of the split `validation`, so overfitting goes unnoticed "
        "and best-*.safetensors contain each phase's last weights; give the recipe splits: {train: 0.9, "
        "validation: 0.1} or set validation.num_views=0"
    )


def open_data(folders: Sequence[Path], network: NetworkConfig, crop_px: int) -> TrainingData:
    """Open the views of dataset folders, divided by the splits in their indices.

    Only tar headers and one JSON file are read. Raises :class:`InputError` if an index lacks a buffer that
    the network needs, a shard is missing or damaged, views are smaller than a crop, or no training views
    remain.
    """
    needed = buffer_names(network)
    places: dict[Split, list[ViewPlace]] = {"train": [], "validation": [], "test": []}
    records, problems = [], []
    for folder in folders:
        dataset = DatasetFolder(Path(folder))
        missing = [name for name in needed if name not in dataset.index.buffers]
        if missing:
            where = Path(folder) / INDEX_FILE
            problems.append(Problem(where, "buffers", f"no {', '.join(missing)}", "all buffers for training"))
            continue
        for shard in dataset.index.shards:
            if shard.split == "test":
                continue
            try:
                places[shard.split] += index_shard(dataset.folder / shard.file)
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
    size = view_size(places["train"][0])
    if min(size) < crop_px:
        first = places["train"][0]
        got = f"{size[0]} x {size[1]}"
        remedy = "reduce data.crop_px"
        raise input_error(
            f"{first.shard}:{first.name}", "size", got, f"at least {crop_px} px per side", remedy
        )
    return TrainingData(tuple(places["train"]), tuple(places["validation"]), size, tuple(records))


def view_size(place: ViewPlace) -> tuple[int, int]:
    """Width and height of a view in pixels, read from its record; raises :class:`InputError`."""
    where = f"{place.shard}:{place.name}"
    try:
        text = json.loads(read_member(place, place.record))
    except (ValueError, RecursionError) as error:
        raise input_error(where, "", str(error), "valid JSON", "make the shard again") from None
    camera = parse_model(ViewRecord, text, where).camera
    return camera.width_px, camera.height_px


def spread(places: Sequence[ViewPlace], count: int) -> list[ViewPlace]:
    """At most ``count`` of the views, evenly spaced."""
    if count >= len(places):
        return list(places)
    return [places[k * len(places) // count] for k in range(count)]
