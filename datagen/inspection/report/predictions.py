# SPDX-License-Identifier: MIT
"""Compares predicted maps of a dataset's views with their ground truth, and writes them for the viewer.

A method, such as a network, has a folder with one EXR file per view that contains D, S and R as half floats
under the dataset's channel names. The first of these paths that exists is read:

    FOLDER/<configuration>/<view>.exr
    FOLDER/<configuration>/views/<view>.exr    from ``materials infer SHARD --out FOLDER/<configuration>``
    FOLDER/views/<view>.exr                    one result of ``materials infer``; report.json names the
                                               configuration

Errors are mean squared errors of linear values over a view's surface pixels and a map's channels.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import canonical_json, sha256_hex
from datagen.formats.shard import ShardReader, ShardRecord, View
from datagen.foundation.buffers import MATERIAL_MAPS, surface_pixels
from datagen.foundation.errors import InputError, Problem, raise_problems
from datagen.foundation.exr import decode_view
from datagen.foundation.naming import unique
from datagen.foundation.transliteration import transliterated
from datagen.inspection.report.gather import cached
from datagen.inspection.report.tiles import write_tile

TILES = "predictions"
"""Folder of predicted maps in ``tiles/``, and first part of the keys of their tiles."""
MAX_LISTED_PROBLEMS = 200
_REVISION = 1
_NEEDED = ("depth_z_m", "surface_mask", *MATERIAL_MAPS)


@dataclass(frozen=True)
class Method:
    """A method whose predictions are compared: title on the page, name in file names, and folder."""

    label: str
    slug: str
    folder: Path

    def folders(self, configuration: str) -> list[Path]:
        """Folders of a configuration's predictions, in the order in which they are searched."""
        folders = [self.folder / configuration, self.folder / configuration / "views"]
        return [*folders, self.folder / "views"] if self.own_configuration() == configuration else folders

    def find(self, configuration: str, view: str) -> Path | None:
        """The file of a view's prediction, or None if there is none."""
        paths = (folder / f"{view}.exr" for folder in self.folders(configuration))
        return next((path for path in paths if path.is_file()), None)

    def covers(self, configuration: str) -> bool:
        """Return whether the method's folder may contain predictions of a configuration."""
        return (self.folder / configuration).is_dir() or self.own_configuration() == configuration

    def own_configuration(self) -> str | None:
        """The configuration in ``report.json`` if the folder is a ``materials infer`` result, else None."""
        try:
            report = json.loads((self.folder / "report.json").read_bytes())
        except (OSError, ValueError):
            return None
        name = report.get("name") if isinstance(report, dict) else None
        return name if isinstance(name, str) else None


def parse_methods(folders: Sequence[Path], labels: Sequence[str]) -> tuple[Method, ...]:
    """Create the methods from the values of ``--predictions`` and ``--label``.

    Labels are assigned to folders in order; methods without a label are named after their folder. Raises
    :class:`InputError` for missing folders, and for labels that are surplus, empty or not unique.
    """
    problems = [
        Problem("--predictions", str(path), "no such folder", "a folder of predicted maps", "check the path")
        for path in folders
        if not path.is_dir()
    ]
    if len(labels) > len(folders):
        expected = f"at most {len(folders)}, one for each --predictions"
        problems.append(Problem("--label", "", f"{len(labels)} labels", expected, "leave some out"))
    names = [*labels, *(path.resolve().name for path in folders[len(labels) :])][: len(folders)]
    for name in sorted({name for name in names if names.count(name) > 1 or not name.strip()}):
        remedy = "name each with --label, in the order of --predictions"
        problems.append(Problem("--label", "", repr(name), "a distinct name for each method", remedy))
    raise_problems(problems)
    slugs: list[str] = []
    for name in names:
        base = re.sub(r"[^a-z0-9]+", "-", transliterated(name).lower()).strip("-") or "method"
        slugs.append(unique(base, set(slugs)))
    return tuple(Method(*parts) for parts in zip(names, slugs, folders, strict=True))


@dataclass(frozen=True)
class CompareJob:
    """A shard to compare with a method's maps, which are also written as tiles if ``with_pixels``."""

    shard: Path
    record: ShardRecord
    out: Path
    method: Method
    with_pixels: bool

    @property
    def key(self) -> str:
        """Hash of everything on which the result depends; files are identified by size and time."""
        found = [
            [str(path), path.stat().st_size, path.stat().st_mtime_ns]
            for folder in self.method.folders(self.record.configuration)
            for path in sorted(folder.glob("*.exr"))
        ]
        return sha256_hex(canonical_json([_REVISION, self.record.sha256, self.with_pixels, found]))

    @property
    def cache_path(self) -> Path:
        name = f"{self.record.configuration}.json"
        return self.out / "gathered" / "predictions" / self.method.slug / name

    @property
    def tiles(self) -> Path:
        """Folder of the tiles of the method's maps for the configuration."""
        return self.out / "tiles" / TILES / self.method.slug / self.record.configuration


@cached
def compare_shard(job: CompareJob) -> dict[str, Any]:
    """Compare a method's maps with a shard; return each view's errors as plain data, and write tiles.

    Faults of a prediction are part of the result. Raises :class:`InputError` if the shard is damaged.
    """
    views = []
    tile_bytes = 0
    for view in ShardReader(job.shard):
        truth = {name: view.buffers[name] for name in _NEEDED if name in view.buffers}
        figures, maps = _compare_view(job.method, view, truth)
        views.append(figures)
        if job.with_pixels:
            stem = f"{TILES}/{job.method.slug}/{view.record.configuration}/{view.record.name}"
            for name, predicted in maps.items():
                path = job.out / "tiles" / f"{stem}/{name}.html"
                tile_bytes += write_tile(path, f"{stem}/{name}", predicted)
    return {
        "configuration": job.record.configuration,
        "method": job.method.slug,
        "views": views,
        "tile_bytes": tile_bytes,
    }


def _compare_view(
    method: Method, view: View, truth: Mapping[str, NDArray]
) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """A view's errors and problems, and its readable predicted maps."""
    name = view.record.name
    path = method.find(view.record.configuration, name)
    figures: dict[str, Any] = {"name": name, "file": path is not None, "pixels": 0}
    figures |= {"mse": {}, "maps": [], "problems": []}
    if path is None:
        return figures, {}
    mask = surface_pixels(truth)
    figures["pixels"] = int(mask.sum())
    maps, problems = _read_maps(path, mask.shape)
    for map_name, predicted in maps.items():
        if map_name not in truth:
            problems.append(f"{map_name}: the dataset has no ground truth")
            continue
        error = mean_squared_error(predicted, truth[map_name], mask)
        if error is not None:
            figures["mse"][map_name] = error
        elif mask.any():
            bad = int((~np.isfinite(predicted[mask]).all(axis=-1)).sum())
            problems.append(f"{map_name}: {bad} surface pixels are NaN or Inf; expected finite values")
    figures["problems"], figures["maps"] = problems, list(maps)
    return figures, maps


def _read_maps(path: Path, shape: tuple[int, ...]) -> tuple[dict[str, NDArray], list[str]]:
    """The maps of a file that are readable and of size ``shape`` (H, W), and the faults of the others."""
    maps: dict[str, NDArray] = {}
    problems: dict[str, str] = {}
    for name in MATERIAL_MAPS:
        try:
            predicted = decode_view(path, [name])[name]
        except InputError as error:
            problems[name] = "; ".join(f"{p.got}; expected {p.expected}" for p in error.problems)
            continue
        if predicted.shape[:2] == shape:
            maps[name] = predicted
        else:
            got, expected = (" x ".join(map(str, size[1::-1])) for size in (predicted.shape, shape))
            problems[name] = f"{got} pixels; expected {expected}"
    whole = set(problems.values())
    if len(problems) == len(MATERIAL_MAPS) and len(whole) == 1:
        return maps, [f"the file: {whole.pop()}"]
    return maps, [f"{name}: {text}" for name, text in problems.items()]


def mean_squared_error(predicted: NDArray, truth: NDArray, mask: NDArray[np.bool_]) -> float | None:
    """Mean squared error over the pixels of ``mask`` and all channels; None if undefined or not finite."""
    difference = predicted[mask].astype(np.float64) - truth[mask].astype(np.float64)
    return float(np.mean(difference**2)) if difference.size and np.isfinite(difference).all() else None


def prediction_table(
    methods: Sequence[Method], compared: Iterable[dict[str, Any]], gathered: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Combine the results of :func:`compare_shard` into the page's data.

    The key ``methods`` contains each method's totals over all counted pixels. ``errors`` contains, by method
    and view in the page's order, a list of the maps' errors (None if unknown) and a bit mask of the maps that
    can be displayed; the list is None for a view without a prediction.
    """
    by_place: dict[tuple[str, str, str], dict[str, Any]] = {}
    for result in compared:
        for view in result["views"]:
            by_place[result["method"], result["configuration"], view["name"]] = view
    order = [(shard["id"], view["name"]) for shard in gathered for view in shard["views"]]
    methods_out, errors = [], {}
    for method in methods:
        found = {place: by_place.get((method.slug, *place), {}) for place in order}
        there = {place: view for place, view in found.items() if view.get("file")}
        problems = [
            [*place, "; ".join(view["problems"])] for place, view in there.items() if view["problems"]
        ]
        missing = ["/".join(place) for place in order if place not in there]
        methods_out.append(
            {
                "label": method.label,
                "slug": method.slug,
                "folder": method.folder.resolve().name,
                "total": {name: _total(list(there.values()), name) for name in MATERIAL_MAPS},
                "num_views": len(there),
                "num_missing": len(missing),
                "missing": missing[:MAX_LISTED_PROBLEMS],
                "num_problems": len(problems),
                "problems": problems[:MAX_LISTED_PROBLEMS],
            }
        )
        errors[method.slug] = [
            [*(_rounded(view["mse"].get(name)) for name in MATERIAL_MAPS), _bits(view["maps"])]
            if (view := there.get(place))
            else None
            for place in order
        ]
    return {"maps": list(MATERIAL_MAPS), "methods": methods_out, "errors": errors}


def _total(views: Sequence[dict[str, Any]], name: str) -> float | None:
    counted = [(view["mse"][name], view["pixels"]) for view in views if name in view["mse"]]
    pixels = sum(num for _, num in counted)
    return sum(error * num for error, num in counted) / pixels if pixels else None


def _bits(maps: Sequence[str]) -> int:
    return sum(1 << bit for bit, name in enumerate(MATERIAL_MAPS) if name in maps)


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.6g}")
