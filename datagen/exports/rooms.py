# SPDX-License-Identifier: MIT
"""Code shared by the exports: reading the rooms and views of a dataset, and writing the files of an export.

A room is a configuration with its shard. Buffers are read one view at a time, on demand.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import write_bytes_atomically
from datagen.formats.configuration import Configuration, PlacedAsset, Split
from datagen.formats.shard import Dataset, ShardReader, ViewPlace, index_shard, read_buffers, read_record
from datagen.formats.view import ViewRecord
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import input_error
from datagen.foundation.images import encode_png, shown_bytes
from datagen.library import Library

MARKER = "export.json"


@dataclass(frozen=True)
class RoomView:
    """A view of a room: the location of its files in the shard, and its record."""

    place: ViewPlace
    record: ViewRecord

    @property
    def camera(self) -> Camera:
        return self.record.camera.camera()

    def read(self, *names: str) -> dict[str, NDArray]:
        """Read the buffers ``names``: arrays (H, W, C) of the stored types, by name."""
        return read_buffers(self.place, names)


@dataclass(frozen=True)
class Room:
    """A configuration and its views, read from the file ``shard`` on first use."""

    shard: Path
    split: Split

    @cached_property
    def configuration(self) -> Configuration:
        return ShardReader(self.shard).configuration()

    @cached_property
    def views(self) -> tuple[RoomView, ...]:
        return tuple(RoomView(place, read_record(place)) for place in index_shard(self.shard))

    @cached_property
    def exposure(self) -> float:
        """Common exposure of the room's views, the median of their exposures."""
        return float(np.median([view.record.exposure for view in self.views]))

    def objects(self) -> dict[str, PlacedAsset]:
        """Return the placed objects by instance name, which the views' records also use."""
        return {placed.name: placed for placed in self.configuration.objects}


@dataclass
class Export:
    """One run of ``datagen export``; ``neighbours`` and ``min_overlap`` are options of optical flow."""

    rooms: Sequence[Room]
    out: Path
    library: Library | None = None
    neighbours: int = 2
    min_overlap: float = 0.2
    num_files: int = 0

    def write(self, name: str, data: bytes) -> None:
        """Write ``data`` atomically to file ``name`` of the export."""
        write_bytes_atomically(self.out / name, data, parents=True)
        self.num_files += 1

    def write_json(self, name: str, value: dict[str, Any]) -> None:
        """Write JSON with one line per top-level key, which keeps long files readable."""
        lines = (f"{json.dumps(key)}: {json.dumps(item)}" for key, item in value.items())
        self.write(name, ("{\n" + ",\n".join(lines) + "\n}\n").encode())

    def write_picture(self, name: str, beauty: NDArray, exposure: float) -> None:
        """Write an 8-bit sRGB PNG of linear radiance (H, W, 3) times ``exposure``."""
        self.write(name, encode_png(shown_bytes(beauty, exposure)))


def pixel_box(mask: NDArray[np.bool_]) -> list[int]:
    """Return the box [left, top, width, height], in pixels, of the True pixels of ``mask`` (H, W)."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    left, top = int(columns[0]), int(rows[0])
    return [left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1]


def open_rooms(dataset: Path, split: Split | None, only: Sequence[str]) -> list[Room]:
    """Return a dataset's rooms of ``split`` (None: all) whose configurations are in ``only`` (empty: all).

    Raises :class:`InputError` for unknown ids or if no room matches.
    """
    opened = Dataset(dataset)
    known = {shard.configuration: shard for shard in opened.index.shards}
    for name in only:
        if name not in known:
            expected = f"one of {', '.join(sorted(known)[:8])}" + (" ..." if len(known) > 8 else "")
            raise input_error(dataset, "--configuration", name, expected, "correct it")
    chosen = [
        s for s in opened.index.shards if split in (None, s.split) and (not only or s.configuration in only)
    ]
    if not chosen:
        raise input_error(dataset, "--split", split, "a split that has configurations", "correct it")
    paths = dict(zip((s.configuration for s in opened.index.shards), opened.shard_paths(), strict=True))
    return [Room(paths[s.configuration], s.split) for s in chosen]


def claim_folder(out: Path, format_name: str, dataset: Path, command: dict[str, Any]) -> None:
    """Create the folder ``out`` with a marker file; an earlier export of the same rooms may be overwritten.

    ``command``: selection of rooms, stored in the marker. Raises :class:`InputError` for a folder with other
    contents, such as an export of another split, since each export numbers categories and models anew.
    """
    marker, name = out / MARKER, dataset.resolve().name
    note = {"format": "scene-materials/export", "layout": format_name, "dataset": name, **command}
    if out.is_file() or (out.is_dir() and any(out.iterdir()) and not _is_marked(marker, note)):
        expected = f"a new or empty folder, or an earlier export to {format_name} of the same rooms"
        raise input_error(out, "--out", "other contents", expected, "choose another --out")
    out.mkdir(parents=True, exist_ok=True)
    write_bytes_atomically(marker, (json.dumps(note, indent=2) + "\n").encode())


def _is_marked(marker: Path, note: dict[str, Any]) -> bool:
    try:
        return bool(json.loads(marker.read_text(encoding="utf-8")) == note)
    except (OSError, ValueError):
        return False
