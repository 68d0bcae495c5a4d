# SPDX-License-Identifier: MIT
"""Cost and variety of generated rooms: ``python -m benchmarks.bench_rooms [--seeds N] [--json FILE]``.

For N seeds of every kind of room: processor seconds, bytes of the package, and number of attempts; minimum,
median and maximum of the number of pieces of furniture, floor area, ratio of its sides, number of windows and
their width; the shares of windows with curtains, with a blind and with a radiator.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import Stopwatch, write_report
from datagen.parametric.kinds import KINDS
from datagen.parametric.packing import package_of
from datagen.parametric.room import make_room
from datagen.parametric.shell import Shell


def measure(num_seeds: int) -> dict[str, Any]:
    """Figures over all kinds, and the seconds of the slowest room of each kind."""
    watch = Stopwatch()
    tries, num_bytes, pieces = [], [], []
    shells: list[Shell] = []
    dressing: Counter[str] = Counter()
    for kind in sorted(KINDS):
        for seed in range(num_seeds):
            with watch.stage(kind):
                room = make_room(kind, f"bench/{seed}")
                data, _ = package_of(room)
            tries.append(room.tries)
            num_bytes.append(len(data))
            pieces.append(len(room.furnished.items))
            shells.append(room.furnished.shell)
            dressing.update(p.item.name for p in room.furnished.items)
    every = np.concatenate([np.array(values) for values in watch.cpu.values()])
    windows = [window for shell in shells for window in shell.windows]
    return {
        "rooms": len(every),
        "kinds": len(watch.cpu),
        "seconds_median": round(float(np.median(every)), 3),
        "seconds_95": round(float(np.percentile(every, 95)), 3),
        "seconds_max": round(float(every.max()), 3),
        "first_try_share": round(float(np.mean(np.array(tries) == 1)), 3),
        "max_tries": max(tries),
        "kilobytes_median": round(float(np.median(num_bytes)) / 1e3),
        "kilobytes_max": round(max(num_bytes) / 1e3),
        "pieces": _range(pieces),
        "area_m2": _range([shell.width * shell.depth for shell in shells]),
        "proportion": _range([max(s.width, s.depth) / min(s.width, s.depth) for s in shells]),
        "windows": _range([len(shell.windows) for shell in shells]),
        "window_width_m": _range([window.width for window in windows]),
        "of_windows": {
            name: round(dressing[name] / max(len(windows), 1), 2)
            for name in ("curtains", "blind", "radiator")
        },
        "slowest": {kind: round(max(values), 3) for kind, values in watch.cpu.items()},
    }


def _range(values: Sequence[float]) -> list[float]:
    """Minimum, median and maximum of ``values``."""
    return [round(float(x), 2) for x in np.quantile(values, (0.0, 0.5, 1.0))]


def main() -> None:
    """Run the command, which prints the figures and, given ``--json``, writes them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    write_report(measure(arguments.seeds), arguments.json, indent=2)


if __name__ == "__main__":
    main()
