# SPDX-License-Identifier: MIT
"""Reads captures from shards, with images from the tar file and geometry from the configuration's library."""

from __future__ import annotations

import tarfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.farm.folder import DatasetFolder, rooms_of
from datagen.formats.capture import Capture, CaptureView, ColorImage
from datagen.formats.shard import ShardReader
from datagen.foundation.bundled import bundled_library
from datagen.foundation.cameras import Camera
from datagen.foundation.errors import input_error
from datagen.foundation.exr import decode_view
from datagen.library import Library
from datagen.rendering.capture_geometry import configuration_geometry, without_lamps


@dataclass(frozen=True)
class ShardSource:
    """A view's EXR in a shard: the file ``member``, of ``num_bytes`` bytes from the byte ``offset``."""

    shard: Path
    member: str
    offset: int
    num_bytes: int

    def read(self, camera: Camera) -> ColorImage:
        """Read the view's ``beauty``, resized to the size of ``camera`` by averaging areas."""
        beauty = self._decode(("beauty",))["beauty"].astype(np.float32)
        size = (camera.width_px, camera.height_px)
        if (beauty.shape[1], beauty.shape[0]) != size:
            import cv2

            beauty = np.asarray(cv2.resize(beauty, size, interpolation=cv2.INTER_AREA), np.float32)
        return ColorImage(beauty, np.ones(beauty.shape[:2], dtype=bool))

    def read_maps(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        """Read the buffers ``names`` that are stored, (H, W, C) each."""
        return self._decode(names)

    def _decode(self, names: tuple[str, ...]) -> dict[str, NDArray]:
        with self.shard.open("rb") as file:
            file.seek(self.offset)
            data = file.read(self.num_bytes)
        return decode_view(data, names, where=f"{self.shard}:{self.member}")


def library_of(shard: Path, paths: tuple[Path, ...]) -> Library:
    """Open the library of a shard: the folders ``paths`` and the rooms of the shard's dataset.

    Without paths, it is the library recorded in the dataset or, if there is no record, the bundled one.
    """
    folder = DatasetFolder(shard.parent.parent)
    if paths:
        return Library([*paths, *rooms_of(folder.root)])
    if folder.record_path.is_file():
        return Library(folder.library_paths())
    return Library([bundled_library()])


def read_shard(shard: Path, library: Library) -> Capture:
    """Read a shard as a capture.

    Raises :class:`InputError` if package hashes in ``library`` differ from those of the configuration.
    """
    reader = ShardReader(shard)
    configuration = reader.configuration()
    records = {record.name: record for record in reader.records()}
    with tarfile.open(shard, mode="r:") as tar:
        members = {Path(info.name).stem: info for info in tar if info.name.endswith(".exr")}
    views = []
    for name, record in records.items():
        if name not in members:
            raise input_error(shard, name, "a record without an image", "both", "make the shard again")
        info = members[name]
        source = ShardSource(shard, info.name, info.offset_data, info.size)
        views.append(CaptureView(name, record.camera.camera(), source))
    geometry, notes = configuration_geometry(configuration, library)
    return Capture(configuration.id, tuple(views), geometry, without_lamps(configuration.lights), notes)
