# SPDX-License-Identifier: MIT
"""Index of the views in a shard's tar, for random access to views."""

from __future__ import annotations

import tarfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from datagen.formats.shard import CONFIGURATION_MEMBERS, parse_member
from datagen.formats.view import ViewRecord
from datagen.foundation.errors import Problem, input_error, raise_problems
from datagen.foundation.exr import decode_view

_REMEDY = "make the shard again"


@dataclass(frozen=True)
class ViewPlace:
    """Offset and size, in bytes, of each of a view's two members in a shard's tar."""

    shard: Path
    name: str
    exr: tuple[int, int]
    record: tuple[int, int]


def index_shard(path: Path) -> list[ViewPlace]:
    """Index a shard's views from the tar's headers alone. Raises :class:`InputError` for a damaged tar."""
    members: dict[str, dict[str, tuple[int, int]]] = {}
    try:
        with tarfile.open(path, mode="r:") as tar:
            for info in tar:
                if info.name in CONFIGURATION_MEMBERS or not info.isreg():
                    continue
                stem, _, suffix = info.name.rpartition(".")
                members.setdefault(stem, {})[suffix] = (info.offset_data, info.size)
    except (tarfile.TarError, EOFError, OSError, ValueError) as error:
        raise input_error(path, "", str(error), "an intact shard (.tar)", _REMEDY) from None
    size = path.stat().st_size
    places, problems = [], []
    for stem, parts in members.items():
        if set(parts) != {"exr", "json"}:
            problems.append(Problem(path, stem, ", ".join(sorted(parts)), "one .exr and one .json", _REMEDY))
        elif max(offset + length for offset, length in parts.values()) > size:
            problems.append(Problem(path, stem, "cut off", "a whole member", _REMEDY))
        else:
            places.append(ViewPlace(path, stem, parts["exr"], parts["json"]))
    if not members:
        problems.append(Problem(path, "", "no views", "at least one", _REMEDY))
    raise_problems(problems)
    return places


def read_record(place: ViewPlace) -> ViewRecord:
    """Read a view's record. Raises :class:`InputError` if it is damaged."""
    return parse_member(ViewRecord, read_member(place, place.record), f"{place.shard}:{place.name}")


def read_buffers(place: ViewPlace, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Read a view's buffers ``names``, (H, W, C) each, as stored. Raises :class:`InputError` if the view is
    damaged or lacks one.
    """
    data = read_member(place, place.exr)
    return decode_view(data, names, num_threads=1, where=f"{place.shard}:{place.name}")


def read_member(place: ViewPlace, part: tuple[int, int]) -> bytes:
    """Bytes of a view's member at ``part`` (offset, size). Raises :class:`InputError` if the tar is short."""
    with place.shard.open("rb") as file:
        file.seek(part[0])
        data = file.read(part[1])
    if len(data) != part[1]:
        raise input_error(place.shard, place.name, "cut off", "a whole member", _REMEDY)
    return data
