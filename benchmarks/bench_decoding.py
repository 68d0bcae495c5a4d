# SPDX-License-Identifier: MIT
"""Views per second that one core decodes for training, with three buffers per view.

    python -m benchmarks.bench_decoding DATASET [--buffers beauty diffuse_albedo roughness] [--views 40]

Processor time of one thread; medians over views, after a first pass that fills the file cache. ``decode``
converts EXR bytes to arrays, ``view`` also reads and checks the view's JSON, ``crop`` also makes tensors of a
crop of 128 pixels (half of the shorter side if that is less).
"""

from __future__ import annotations

import argparse
import statistics
from functools import partial
from pathlib import Path

import torch

from benchmarks.timing import timed, write_report
from datagen.formats.shard import read_member
from datagen.foundation.exr import decode_view
from model.loading import ViewStream, read_view


def main() -> None:
    """Print the milliseconds per view of each measurement."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--buffers", nargs="+", default=["beauty", "diffuse_albedo", "roughness"])
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    places = ViewStream([args.dataset], args.buffers, split=None).places[: args.views]
    camera = read_view(places[0], args.buffers)[0].camera
    stream = ViewStream([args.dataset], args.buffers, split=None, shuffle=False)
    stream.crop_px = min(128, min(camera.width_px, camera.height_px) // 2)
    members = [read_member(place, place.exr) for place in places]
    result: dict[str, object] = {"size_px": [camera.width_px, camera.height_px], "buffers": args.buffers}
    crops = iter(stream)
    for name, times in {
        "decode": [timed(partial(decode_view, m, args.buffers, num_threads=1)).cpu for m in members],
        "view": [timed(partial(read_view, p, args.buffers)).cpu for p in places],
        "crop": [timed(lambda: [next(crops) for _ in places]).cpu / len(places)],
    }.items():
        each = 1e3 * statistics.median(times)
        result[name] = {"ms": round(each, 2), "views_per_second": round(1e3 / each, 1)}
        print(f"{name:7} {each:6.2f} ms per view, {1e3 / each:6.0f} views/s per core")
    write_report(result, args.out, is_printed=False)


if __name__ == "__main__":
    main()
