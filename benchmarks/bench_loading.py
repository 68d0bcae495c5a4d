# SPDX-License-Identifier: MIT
"""Would it pay to decode only the rows that a crop needs?

    python -m benchmarks.bench_loading DATASET [--preset paper] [--views 20]

Processor time, one thread: a whole view as training loads it (read, decode, check); the EXR decoder alone for
all rows and for the rows of one crop; and the share of blocks of 16 rows (what ZIP compresses together) that
the crops of a view touch. A view's crops follow one another, so a loader decodes it once for all of them, and
the checks (NaN, ranges) and the greatest depth need every row.
"""

from __future__ import annotations

import argparse
import io
import statistics
from functools import partial
from pathlib import Path

import Imath
import numpy as np
import OpenEXR

from benchmarks.timing import timed
from datagen.formats.view_places import ViewPlace, read_member
from model.training.config import resolve_config
from model.training.dataset import buffer_names, load_view
from model.training.sources import open_data, spread

BLOCK_ROWS = 16
HALF = Imath.PixelType(Imath.PixelType.HALF)


def decode_rows(data: bytes, first: int, last: int) -> object:
    """Rows first to last of every channel but depth, which alone is not half."""
    file = OpenEXR.InputFile(io.BytesIO(data))
    names = [n for n, c in file.header()["channels"].items() if c.type == HALF]
    return file.channels(names, HALF, first, last)


def touched_share(height: int, crop: int, crops: int, seed: int = 0) -> float:
    """Mean share of a view's blocks of rows that ``crops`` random crops touch."""
    generator = np.random.default_rng(seed)
    count = -(-height // BLOCK_ROWS)
    shares = []
    for _ in range(1000):
        touched = np.zeros(count, bool)
        for top in generator.integers(0, height - crop + 1, crops):
            touched[top // BLOCK_ROWS : (top + crop - 1) // BLOCK_ROWS + 1] = True
        shares.append(touched.mean())
    return float(np.mean(shares))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--views", type=int, default=20)
    args = parser.parse_args()
    config = resolve_config(args.preset)
    names, height = buffer_names(config.network), 384
    data = open_data([args.dataset], config.network, 16)
    places: list[ViewPlace] = list(spread(data.train, args.views))
    rows = data.size_px[1]
    crop_rows = round(rows * config.data.crop_px / height) if args.preset == "paper" else config.data.crop_px
    whole = statistics.median(timed(partial(load_view, place, names)).cpu for place in places)
    members = [read_member(place, place.exr) for place in places]
    everything, part = (
        statistics.median(timed(partial(decode_rows, member, 0, last)).cpu for member in members)
        for last in (rows - 1, crop_rows - 1)
    )
    share = touched_share(rows, crop_rows, config.data.crops_per_view)
    print(f"load a view ({data.size_px[0]} x {rows}): {whole * 1e3:.1f} ms of processor time")
    print(f"decode all rows: {everything * 1e3:.1f} ms; {crop_rows} rows of one crop: {part * 1e3:.1f} ms")
    print(f"blocks touched by the {config.data.crops_per_view} crops of a view: {share:.0%}")
    print(f"one loader process feeds {config.data.crops_per_view / whole:.0f} crops a second")


if __name__ == "__main__":
    main()
