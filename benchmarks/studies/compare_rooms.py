# SPDX-License-Identifier: MIT
"""Generated rooms compared with imported ones: distributions, exposures and pictures.

    python -m benchmarks.studies.compare_rooms DATASET --imported SHARD [SHARD ...]
        --out DIR [--views 8] [--page 24]

DATASET is a dataset folder; an imported SHARD is the tar of a capture with ground truth, for example one that
`materials evaluate` rendered for a scene of a suite. Surface pixels of ``--views`` evenly spaced views per
room are counted; every room has the same weight, so densities are means over rooms. Luminances and exposures
are relative to the room's median exposure, since each scene has its own unit of radiance.

Writes ``distributions.png`` (D, S, R, luminance, exposure), ``beside.jpg`` (imported rooms left, generated
ones right) and ``page.jpg`` (a view of each of the first ``--page`` rooms of DATASET), all exposed as in
contact sheets. Prints a table: shares of pixels with S > 0.3 and R < 0.3, share of pixels clipped at that
exposure, with and without window parts (frames, sills, blinds, curtains), and the ratio of the largest to the
smallest exposure within a room.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from datagen.formats.configuration import GLOSSY_ROUGHNESS, METAL_SPECULAR
from datagen.formats.shard import Dataset, ShardReader, View
from datagen.foundation.buffers import surface_pixels
from datagen.foundation.color import clipped_share, luminance, photographic_exposure, srgb_from_linear

MAX_CLIPPED = 0.03
WINDOW_PARTS = ("window", "blind", "curtain")
"""Prefixes of the names of window parts in generated rooms, such as frames, sills and slats."""
BINS = {
    "luminance of D": np.linspace(0, 1, 41),
    "brightest channel of S": np.geomspace(0.02, 1, 41),
    "R": np.linspace(0, 1, 41),
    "luminance, exposed": np.geomspace(1e-3, 4, 41),
    "exposure / room's median": np.geomspace(0.1, 10, 25),
}
_LOGARITHMIC = ("brightest channel of S", "luminance, exposed", "exposure / room's median")


@dataclass(frozen=True)
class RoomFigures:
    """Figures of one room.

    ``densities``: a histogram of sum 1 for each of :data:`BINS`. ``metal_share``, ``gloss_share``: shares of
    surface pixels with high S and with low R. By view (N,): ``exposures``; ``clipped``, the share of surface
    pixels that are clipped, and ``clipped_in_room``, the same without window parts. ``picture``: the view
    with most instances, (H, W, 3) sRGB.
    """

    name: str
    densities: dict[str, NDArray]
    metal_share: float
    gloss_share: float
    exposures: NDArray
    clipped: NDArray
    clipped_in_room: NDArray
    picture: NDArray[np.uint8]

    @property
    def exposure_ratio(self) -> float:
        return float(self.exposures.max() / self.exposures.min())


def is_window(view: View) -> NDArray[np.bool_]:
    """Mask (H, W) of pixels whose instance has the name of a window part."""
    parts = [
        int(number)
        for number, name in view.record.instances.items()
        if name.rpartition("/")[2].startswith(WINDOW_PARTS)
    ]
    return np.isin(view.buffers["instance_id"][..., 0], parts)


def _density(name: str, values: NDArray) -> NDArray:
    bins = BINS[name]
    counts = np.histogram(np.clip(values, bins[0], bins[-1]), bins)[0]
    return counts / max(int(counts.sum()), 1)


def figures_of(name: str, views: Sequence[View]) -> RoomFigures:
    """Measure the figures of the room ``name`` in its views."""
    values: dict[str, list[NDArray]] = {key: [] for key in BINS}
    exposures, clipped, clipped_in_room, sizes, lit = [], [], [], [], []
    for view in views:
        buffers, mask = view.buffers, surface_pixels(view.buffers)
        beauty = np.nan_to_num(buffers["beauty"].astype(np.float32))
        exposure = photographic_exposure(beauty, mask)
        exposures.append(exposure)
        clipped.append(clipped_share(beauty, exposure, mask))
        clipped_in_room.append(clipped_share(beauty, exposure, mask & ~is_window(view)))
        _, pixels = np.unique(buffers["instance_id"][..., 0][mask], return_counts=True)
        sizes.append(int((pixels > 0.002 * mask.size).sum()))
        values["luminance of D"].append(luminance(buffers["diffuse_albedo"][mask].astype(np.float32)))
        values["brightest channel of S"].append(buffers["specular_albedo"].max(axis=-1)[mask])
        values["R"].append(buffers["roughness"][..., 0][mask])
        lit.append(luminance(beauty[mask]))
    middle = float(np.median(exposures))
    values["luminance, exposed"] = [part * middle for part in lit]
    values["exposure / room's median"] = [np.array(exposures) / middle]
    joined = {key: np.concatenate(parts).astype(np.float64) for key, parts in values.items()}
    best = int(np.argmax(sizes))
    shown = np.clip(views[best].buffers["beauty"].astype(np.float32) * exposures[best], 0, 1)
    return RoomFigures(
        name,
        {key: _density(key, found) for key, found in joined.items()},
        float((joined["brightest channel of S"] > METAL_SPECULAR).mean()),
        float((joined["R"] < GLOSSY_ROUGHNESS).mean()),
        np.array(exposures),
        np.array(clipped),
        np.array(clipped_in_room),
        (255 * srgb_from_linear(np.nan_to_num(shown)) + 0.5).astype(np.uint8),
    )


def read_room(shard: Path, num_views: int) -> RoomFigures:
    """Measure a room's figures in ``num_views`` evenly spaced views of its shard."""
    reader = ShardReader(shard)
    count = sum(1 for _ in reader.records())
    chosen = {k * count // num_views for k in range(num_views)} if count > num_views else None
    views = [view for k, view in enumerate(reader) if chosen is None or k in chosen]
    return figures_of(reader.configuration().id, views)


def table(groups: dict[str, list[RoomFigures]]) -> str:
    """Markdown table of the figures of each group of rooms."""
    lines = [
        "| | rooms, views | S > 0.3 | R < 0.3 | clipped, median | at most 3 % clipped | outside windows "
        "| exposures within a room, median and most |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, rooms in groups.items():
        clipped = np.concatenate([room.clipped for room in rooms])
        in_room = np.concatenate([room.clipped_in_room for room in rooms])
        ratios = [room.exposure_ratio for room in rooms]
        lines.append(
            f"| {name} | {len(rooms)}, {len(clipped)} | {np.mean([r.metal_share for r in rooms]):.1%} "
            f"| {np.mean([r.gloss_share for r in rooms]):.1%} | {np.median(clipped):.1%} "
            f"| {(clipped <= MAX_CLIPPED).mean():.0%} of the views | {(in_room <= MAX_CLIPPED).mean():.0%} "
            f"| {np.median(ratios):.1f} x, {max(ratios):.1f} x |"
        )
    return "\n".join(lines)


def draw(groups: dict[str, list[RoomFigures]], path: Path) -> None:
    """Plot densities by group, as mean over rooms with the range of the middle 80 % of rooms."""
    matplotlib.use("Agg")
    figure, axes = plt.subplots(1, len(BINS), figsize=(15, 2.9), layout="constrained")
    for axis, (name, bins) in zip(axes, BINS.items(), strict=True):
        for color, (label, rooms) in zip(("tab:blue", "tab:orange"), groups.items(), strict=True):
            found = np.array([room.densities[name] for room in rooms])
            axis.stairs(found.mean(axis=0), bins, color=color, lw=2, label=label)
            low, high = np.quantile(found, [0.1, 0.9], axis=0)
            axis.fill_between(
                bins, np.append(low, 0), np.append(high, 0), step="post", color=color, alpha=0.15
            )
        if name in _LOGARITHMIC:
            axis.set_xscale("log")
        axis.set(xlabel=name, ylabel="share" if axis is axes[0] else None, xlim=(bins[0], bins[-1]))
        top = max(np.mean([r.densities[name] for r in rooms], axis=0).max() for rooms in groups.values())
        axis.set_ylim(0, 1.6 * top)
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _fitted(picture: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Crop a picture at its centre to the aspect of ``size`` (width, height), and resize it."""
    height, width = picture.shape[:2]
    cut_w, cut_h = (
        min(width, round(height * size[0] / size[1])),
        min(height, round(width * size[1] / size[0])),
    )
    x, y = (width - cut_w) // 2, (height - cut_h) // 2
    cut = Image.fromarray(picture[y : y + cut_h, x : x + cut_w])
    return np.asarray(cut.resize(size, Image.Resampling.LANCZOS))


def write_grid(pictures: list[NDArray[np.uint8]], columns: int, size: tuple[int, int], path: Path) -> None:
    """Write pictures of ``size`` (width, height) in rows, with 4 white pixels between them, as JPEG."""
    gap, rows = 4, -(-len(pictures) // columns)
    sheet = Image.new("RGB", (columns * (size[0] + gap) - gap, rows * (size[1] + gap) - gap), "white")
    for k, picture in enumerate(pictures):
        place = ((k % columns) * (size[0] + gap), (k // columns) * (size[1] + gap))
        sheet.paste(Image.fromarray(_fitted(picture, size)), place)
    sheet.save(path, quality=82)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--imported", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--views", type=int, default=8, help="views per room")
    parser.add_argument("--page", type=int, default=24, help="rooms on the page")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    shards = [options.dataset / shard.file for shard in Dataset(options.dataset).index.shards]
    generated = [read_room(shard, options.views) for shard in shards]
    imported = [read_room(shard, options.views) for shard in options.imported]
    groups = {"generated rooms": generated, "imported rooms": imported}
    print(table(groups))
    draw(groups, options.out / "distributions.png")
    write_grid([room.picture for room in generated[: options.page]], 4, (224, 140), options.out / "page.jpg")
    pairs = [p for pair in zip(imported, generated, strict=False) for p in (pair[0].picture, pair[1].picture)]
    write_grid(pairs, 2, (360, 225), options.out / "beside.jpg")


if __name__ == "__main__":
    main()
