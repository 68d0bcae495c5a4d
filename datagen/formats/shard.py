# SPDX-License-Identifier: MIT
"""Shards: WebDataset tar files with deterministic bytes, one configuration each, and the dataset's index.

A shard contains ``<configuration>/<view>.exr`` and ``<configuration>/<view>.json`` for each view, in order,
after ``__meta__/configuration``: WebDataset skips folders named ``__NAME__``, and Hugging Face's `datasets`
skips names without a suffix. Headers are USTAR with fixed owner, mode and time. Older shards, whose first
member is called ``__meta__/configuration.json``, can be read too.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

from numpy.typing import NDArray

from datagen.formats.base import ModelT, RelativePath, StrictModel, parse_model, read_json
from datagen.formats.configuration import Configuration, Split
from datagen.formats.recipe import Recipe
from datagen.formats.view import ViewRecord
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from datagen.foundation.exr import decode_view
from datagen.foundation.paths import inside

CONFIGURATION_MEMBER = "__meta__/configuration"
CONFIGURATION_MEMBERS = (CONFIGURATION_MEMBER, "__meta__/configuration.json")
"""Current name of the member that contains the configuration, and its name in older shards."""
INDEX_FILE = "index.json"
MAX_MEMBER_BYTES = 2 << 30
_RENEW = "make the shard again"
_REMEDY = "make the shard again (remove it and rerun), or restore the file"


class AssetRecord(StrictModel):
    """An asset used by the dataset: kind, content hash, licence, author and source."""

    kind: Literal["environment", "object", "material", "panorama"]
    sha256: str
    license: str
    author: str = ""
    source: str = ""


class ShardRecord(StrictModel):
    """One shard in the index. ``file`` is a path relative to the index, ``assets`` the ids of used assets."""

    file: RelativePath
    sha256: str
    num_bytes: int
    configuration: str
    split: Split
    num_views: int
    seed: int
    assets: tuple[str, ...]


class DatasetIndex(StrictModel):
    """``index.json``: content and provenance of the dataset.

    ``versions`` lists the software that affects pixels, ``missing`` the planned units without a shard;
    ``splits`` counts configurations by split, ``assets`` describes the used assets by id.
    """

    format: Literal["scene-materials/dataset"] = "scene-materials/dataset"
    version: Literal[1] = 1
    recipe: Recipe
    versions: dict[str, str]
    variant: str
    num_configurations: int
    num_views: int
    num_bytes: int
    is_complete: bool
    missing: tuple[str, ...] = ()
    splits: dict[Split, int]
    buffers: tuple[str, ...]
    assets: dict[str, AssetRecord]
    shards: tuple[ShardRecord, ...]


def _add(tar: tarfile.TarFile, name: str, size: int, stream: BinaryIO) -> None:
    info = tarfile.TarInfo(name)
    info.size = size
    info.mode = 0o644
    tar.addfile(info, stream)  # mtime, uid, gid are 0 and the names empty by default


def write_shard(stream: BinaryIO, configuration: bytes, members: Iterable[tuple[str, Path]]) -> None:
    """Write a shard: the configuration's canonical JSON, then ``members`` (name in the tar, file)."""
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        _add(tar, CONFIGURATION_MEMBER, len(configuration), io.BytesIO(configuration))
        for name, path in members:
            with path.open("rb") as file:
                _add(tar, name, path.stat().st_size, file)


@dataclass(frozen=True)
class View:
    """A view: its record, and its buffers by name, (H, W, C) arrays of the stored types."""

    record: ViewRecord
    buffers: dict[str, NDArray[Any]]


class ShardReader:
    """Reader of one shard; iteration yields :class:`View` objects. ``names`` selects buffers, None = all.

    Raises :class:`InputError` if the tar or a member is damaged or a requested buffer is missing.
    """

    def __init__(self, path: Path, names: Iterable[str] | None = None):
        self.path = path
        self.names = tuple(names) if names is not None else None

    def members(self) -> Iterator[tuple[str, bytes]]:
        """Yield (name, content) of each member, in order."""
        if self.path.exists() and not self.path.is_file():
            raise InputError(Problem(self.path, "", "a folder, pipe or device", "a shard", "check the path"))
        try:
            with tarfile.open(self.path, mode="r:") as tar:
                for info in tar:
                    # `isreg` is true for sparse members too, whose few bytes may expand to any size
                    if not info.isreg() or info.issparse() or info.size > MAX_MEMBER_BYTES:
                        got = f"{info.name!r}, type {info.type!r}, {info.size} bytes"
                        raise InputError(Problem(self.path, "member", got, "a regular file", _REMEDY))
                    file = tar.extractfile(info)
                    data = file.read() if file else b""
                    if len(data) != info.size:
                        got = f"{len(data)} bytes"
                        raise InputError(Problem(self.path, info.name, got, f"{info.size}", _REMEDY))
                    yield info.name, data
        except FileNotFoundError:
            raise InputError(Problem(self.path, "", "no such file", "a shard", _REMEDY)) from None
        except (tarfile.TarError, EOFError, OSError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(Problem(self.path, "", str(error), "an intact tar file", _REMEDY)) from None

    def configuration(self) -> Configuration:
        """Read the shard's configuration. Raises :class:`InputError` if it is missing or damaged."""
        for name, data in self.members():
            if name in CONFIGURATION_MEMBERS:
                return parse_member(Configuration, data, f"{self.path}:{name}")
        raise InputError(Problem(self.path, CONFIGURATION_MEMBER, "missing", "this member", _REMEDY))

    def records(self) -> Iterator[ViewRecord]:
        """Yield the views' records, without decoding pixels."""
        for name, data in self.members():
            if name.endswith(".json") and name not in CONFIGURATION_MEMBERS:
                yield parse_member(ViewRecord, data, f"{self.path}:{name}")

    def __iter__(self) -> Iterator[View]:
        images: dict[str, bytes] = {}
        for name, data in self.members():
            stem, _, suffix = name.rpartition(".")
            if suffix == "exr":
                images[stem] = data
            elif suffix == "json" and name not in CONFIGURATION_MEMBERS:
                where = f"{self.path}:{stem}"
                record = parse_member(ViewRecord, data, where)
                if stem not in images:
                    raise InputError(
                        Problem(
                            where, "", "JSON without an EXR before it", "the EXR of the view first", _REMEDY
                        )
                    )
                yield View(record, decode_view(images.pop(stem), self.names, where=where))


def parse_member(model: type[ModelT], data: bytes, where: str) -> ModelT:
    """Parse a shard's member as a ``model``. Raises :class:`InputError` with every problem in ``where``."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(Problem(where, "", str(error), "valid JSON", _REMEDY)) from None
    return parse_model(model, value, where)


class Dataset:
    """A dataset folder with its index; yields views of one split or all, shard by shard.

    Example: ``Dataset(folder).views("train", names=["beauty", "diffuse_albedo"])``.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self.index = read_json(DatasetIndex, inside(self.folder, self.folder / INDEX_FILE))

    def shard_paths(self, split: Split | None = None) -> list[Path]:
        """Return the paths of the shards of ``split`` (None = all), in the index's order.

        Raises :class:`InputError` for a path that leads out of the folder.
        """
        shards = [s for s in self.index.shards if split is None or s.split == split]
        return [inside(self.folder, self.folder / s.file) for s in shards]

    def views(self, split: Split | None = None, names: Iterable[str] | None = None) -> Iterator[View]:
        """Yield every view of ``split`` (None = all), with the buffers in ``names`` (None = all)."""
        chosen = tuple(names) if names is not None else None
        for path in self.shard_paths(split):
            yield from ShardReader(path, chosen)


@dataclass(frozen=True)
class ViewPlace:
    """Offset and size, in bytes, of each of a view's two members in a shard's tar."""

    shard: Path
    name: str
    exr: tuple[int, int]
    record: tuple[int, int]


def index_shard(path: Path) -> list[ViewPlace]:
    """Locate a shard's views by the tar's headers alone. Raises :class:`InputError` for a damaged shard."""
    members: dict[str, dict[str, tuple[int, int]]] = {}
    try:
        with tarfile.open(path, mode="r:") as tar:
            for info in tar:
                if info.name in CONFIGURATION_MEMBERS or not info.isreg():
                    continue
                stem, _, suffix = info.name.rpartition(".")
                members.setdefault(stem, {})[suffix] = (info.offset_data, info.size)
    except (tarfile.TarError, EOFError, OSError, ValueError) as error:
        raise input_error(path, "", str(error), "an intact shard (.tar)", _RENEW) from None
    size = path.stat().st_size
    places, problems = [], []
    for stem, parts in members.items():
        if set(parts) != {"exr", "json"}:
            problems.append(Problem(path, stem, ", ".join(sorted(parts)), "one .exr and one .json", _RENEW))
        elif max(offset + length for offset, length in parts.values()) > size:
            problems.append(Problem(path, stem, "cut off", "a whole member", _RENEW))
        else:
            places.append(ViewPlace(path, stem, parts["exr"], parts["json"]))
    if not members:
        problems.append(Problem(path, "", "no views", "at least one", _RENEW))
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
    """Read a view's member at ``part`` (offset, size). Raises :class:`InputError` if the tar is truncated."""
    with place.shard.open("rb") as file:
        file.seek(part[0])
        data = file.read(part[1])
    if len(data) != part[1]:
        raise input_error(place.shard, place.name, "cut off", "a whole member", _RENEW)
    return data
