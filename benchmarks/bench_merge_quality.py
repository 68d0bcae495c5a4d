# SPDX-License-Identifier: MIT
"""Errors of merged maps by options of the merge, on rendered captures with true maps.

    python -m benchmarks.bench_merge_quality weights SHARD ...
    python -m benchmarks.bench_merge_quality sizes SHARD ... --sizes 0.5x,1x,2x,16384
    python -m benchmarks.bench_merge_quality seams SHARD ... --views 12

``weights``: mean squared error of the predicted maps before merging (``views``) and after merging with each
choice of weights. ``sizes``: error of the true maps after merging into atlases of several sizes (2x: twice
the side of ``auto``). ``seams``: by room and choice of weights, the errors and the mean difference of merged
D between neighbouring texels where the true D is smooth, for texels merged from different numbers of views
(``border``) and from equal numbers (``inside``). An atlas is interpolated at the surface point under each
pixel's centre and compared with the pixel's true map; all surface pixels have equal weight. ``--json``: file
for the errors of ``weights`` and ``sizes``.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import write_report
from datagen.formats.capture import Capture
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.texture_lookup import looked_up, pixel_uv
from datagen.geometry.traced import face_normals, seen_sides, smooth_regions
from datagen.geometry.views import TracedCapture, trace_capture
from mitsuba_plugins.variant import select_variant
from model.checkpoint import bundled_checkpoint
from model.reconstruction.atlas.atlas import Atlas, empty_atlas
from model.reconstruction.atlas.texels import TexelSurface
from model.reconstruction.captures.options import CaptureOptions
from model.reconstruction.captures.read import read_capture
from model.reconstruction.infer import map_stages
from model.reconstruction.infer_options import InferOptions, InferReport
from model.reconstruction.merge.fill import fill_unseen
from model.reconstruction.merge.merger import MapMerger, MergeOptions, map_views
from model.reconstruction.merge.weights import Weights
from model.reconstruction.predict.sources import TRUTH, CheckpointMaps
from model.reconstruction.stages import Estimate, Run
from model.reconstruction.unwrap.repacked import atlas_size, pixel_density, repacked
from model.reconstruction.unwrap.uv import unwrapped

WEIGHTS: tuple[Weights, ...] = ("none", "borders", "resolution", "confidence")
Maps = list[dict[str, NDArray]]
MAX_TRUE_STEP = 0.004
"""Largest difference of true D between neighbouring texels, in any channel, that counts as smooth."""
MAX_SIDE = 4096
"""Maximum side in texels of an atlas of size ``auto``, since some rooms include a landscape outside."""


@dataclass
class Room:
    """A rendered capture, traced and unwrapped.

    ``sides``: 1 or -1 by face, the visible side (:func:`seen_sides`); ``uv``: UVs (H, W, 2) of each view's
    pixels, NaN off the surface; ``truth``: the views' true maps; ``auto``: side of the atlas in texels at the
    views' pixel density.
    """

    capture: Capture
    traced: TracedCapture
    mesh: Mesh
    sides: NDArray
    uv: list[NDArray]
    truth: Maps
    auto: int

    def merged(self, maps: Maps, size: int, folder: Path | None, weights: Weights = "none") -> Atlas:
        """Merge the maps of all views into an atlas (``size``, ``size``), in files in ``folder`` if given."""
        regions = smooth_regions(self.traced.geometry.mesh)
        views = map_views(self.traced.views, maps)
        merger = MapMerger(views, MergeOptions(weights=weights), None, regions)
        atlas = empty_atlas(size, folder)
        merger.merge(TexelSurface(self.mesh, face_normals(self.mesh, self.sides), size), atlas)
        fill_unseen(atlas, self.mesh)
        return atlas

    def errors(self, found: Atlas | Maps) -> dict[str, float]:
        """Sums of squared errors of an atlas or of maps over all surface pixels of the views, by map."""
        sums = dict.fromkeys(MATERIAL_MAPS, 0.0)
        for view, (uv, truth) in enumerate(zip(self.uv, self.truth, strict=True)):
            on_surface = ~np.isnan(uv[..., 0])
            for name in MATERIAL_MAPS:
                if isinstance(found, Atlas):
                    values = looked_up(found.maps[name], uv[on_surface])
                else:
                    values = found[view][name][on_surface].astype(np.float64)
                sums[name] += float(((values - truth[name][on_surface]) ** 2).mean(axis=-1).sum())
        return sums

    @property
    def num_pixels(self) -> int:
        """Number of surface pixels of all views."""
        return sum(int((~np.isnan(uv[..., 0])).sum()) for uv in self.uv)


def steps(atlas: Atlas, truth: Atlas) -> dict[str, tuple[float, int]]:
    """Sum of absolute differences of D (mean over channels) between neighbouring observed texels where the
    true D is smooth, and number of pairs, for texels merged from different (``border``) and from equal
    (``inside``) numbers of views. The atlases have the same mesh and side.
    """
    found = {"border": (0.0, 0), "inside": (0.0, 0)}
    for axis in (0, 1):
        count = np.swapaxes(atlas.count, 0, axis)
        merged, true = (
            np.swapaxes(a.maps["diffuse_albedo"].astype(np.float64), 0, axis) for a in (atlas, truth)
        )
        is_smooth = (
            (count[1:] > 0) & (count[:-1] > 0) & (np.abs(np.diff(true, axis=0)).max(-1) < MAX_TRUE_STEP)
        )
        step = np.abs(np.diff(merged, axis=0)).mean(axis=-1)
        for name, is_kind in (("border", count[1:] != count[:-1]), ("inside", count[1:] == count[:-1])):
            chosen = is_smooth & is_kind
            total, num = found[name]
            found[name] = total + float(step[chosen].sum()), num + int(chosen.sum())
    return found


def open_room(shard: Path, library: Sequence[Path], num_views: int | None = None) -> Room:
    """Read, trace and unwrap a rendered capture, or its first ``num_views`` views."""
    capture = read_capture(shard, CaptureOptions(library=tuple(library)))
    capture = replace(capture, views=capture.views[:num_views])
    traced = trace_capture(capture)
    density = pixel_density((view.camera, view.geometry) for view in traced.views)
    mesh, unwrap = repacked(*unwrapped(traced.geometry.mesh), density)
    uvs = [pixel_uv(mesh, view.camera, view.geometry) for view in traced.views]
    size = atlas_size(density.footprint_m, unwrap.metres_per_side)
    sides = seen_sides([view.geometry for view in traced.views], len(mesh.faces))
    return Room(capture, traced, mesh, sides, uvs, TRUTH.read(traced), min(size, MAX_SIDE))


def predictions(room: Room, checkpoint: Path) -> Maps:
    """Maps of all views that ``materials infer`` would merge."""
    source, options = CheckpointMaps(checkpoint), InferOptions()
    with tempfile.TemporaryDirectory(prefix="bench-merge-") as folder:
        (Path(folder) / "views").mkdir()
        run = Run(Path(folder), options, InferReport(), lambda *_: None)
        source.prepare(options)
        estimate = Estimate(source.maps(room.traced, run))
        for stage in map_stages(source, options):
            estimate = stage(room.traced, estimate, run)
    return estimate.maps


def measure(what: str, room: Room, checkpoint: Path, sizes: list[str]) -> dict[str, dict[str, float]]:
    """Sums of squared errors by row of the table ``what`` (``weights`` or ``sizes``) and by map."""
    rows: dict[str, dict[str, float]] = {}
    if what == "weights":
        maps = predictions(room, checkpoint)
        rows["views"] = room.errors(maps)
        for weights in WEIGHTS:
            rows[weights] = room.errors(room.merged(maps, room.auto, None, weights))
    else:
        for size in sizes:
            factor = float(size.removesuffix("x"))
            side = round(factor * room.auto) if size.endswith("x") else int(factor)
            with tempfile.TemporaryDirectory(prefix="bench-merge-") as folder:
                atlas = room.merged(room.truth, side, Path(folder) if side > 4096 else None)
                rows[size] = room.errors(atlas)
    return rows


def print_seams(room: Room, checkpoint: Path) -> None:
    """Print, for each choice of weights, a row with the room's :func:`steps` and errors."""
    maps = predictions(room, checkpoint)
    truth = room.merged(room.truth, room.auto, None)
    for weights in WEIGHTS:
        merged = room.merged(maps, room.auto, None, weights)
        cells = [
            f"{name} {total / max(num, 1):.5f} ({num})" for name, (total, num) in steps(merged, truth).items()
        ]
        cells += [f"{name} {error / room.num_pixels:.5f}" for name, error in room.errors(merged).items()]
        print(f"{weights:<12}" + "  ".join(cells), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("weights", "sizes", "seams"))
    parser.add_argument("shards", nargs="+", type=Path)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--library", type=Path, action="append", default=[])
    parser.add_argument("--views", type=int, help="number of views, from the first")
    parser.add_argument("--sizes", default="0.25x,0.5x,1x,2x")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    select_variant()
    sums: dict[str, dict[str, float]] = {}
    num_pixels = 0
    for shard in arguments.shards:
        room = open_room(shard, arguments.library, arguments.views)
        num_pixels += room.num_pixels
        checkpoint = arguments.checkpoint or bundled_checkpoint()
        if arguments.what == "seams":
            print(f"{shard.name}: {len(room.capture.views)} views, auto {room.auto}", flush=True)
            print_seams(room, checkpoint)
            continue
        rows = measure(arguments.what, room, checkpoint, arguments.sizes.split(","))
        for row, errors in rows.items():
            kept = sums.setdefault(row, dict.fromkeys(MATERIAL_MAPS, 0.0))
            for name, value in errors.items():
                kept[name] += value
        print(f"{shard.name}: {len(room.capture.views)} views, auto {room.auto}", flush=True)
    if not sums:
        return
    print(f"{'':<36}" + "".join(f"{name:>18}" for name in MATERIAL_MAPS))
    for row, errors in sums.items():
        print(f"{row:<36}" + "".join(f"{errors[name] / num_pixels:>18.3e}" for name in MATERIAL_MAPS))
    means = {row: {name: e[name] / num_pixels for name in MATERIAL_MAPS} for row, e in sums.items()}
    write_report(means, arguments.json, is_printed=False, indent=2, sort_keys=True)


if __name__ == "__main__":
    main()
