# SPDX-License-Identifier: MIT
"""Time to export from Blender: a million triangles, a room of 2,000 instances, a bake of 1024 px.

    python -m benchmarks.bench_blender_export [--repeat 5] [--only NAME...]

Each run is a process of its own, since Blender keeps what it has loaded. Prints medians with the quartiles,
in seconds of wall clock and of the processor (all threads), and the limits that the project sets itself.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
LIMITS_S = {"million_triangles": 5.0, "room": None, "three_channels_1024_px": 3.0}


def run(name: str) -> dict[str, float]:
    """Export one scene of :mod:`tests.blender_addon.scale` in a fresh process."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tests.blender_addon.scale", folder, name]
        done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    measured: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return measured


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--only", nargs="+", choices=list(LIMITS_S), default=list(LIMITS_S))
    arguments = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, median (quartiles) of {arguments.repeat}")
    for name in arguments.only:
        runs = [run(name) for _ in range(arguments.repeat)]
        texts = []
        for key, unit in (("s", "s wall"), ("cpu_s", "s processor")):
            low, middle, high = np.percentile([r[f"{name}_{key}"] for r in runs], (25, 50, 75))
            texts.append(f"{middle:.2f} ({low:.2f}-{high:.2f}) {unit}")
        memory = max(r["peak_memory_mb"] for r in runs)
        limit = f", limit {LIMITS_S[name]:g} s wall" if LIMITS_S[name] else ""
        print(f"{name}: {', '.join(texts)}, {memory:.0f} MB{limit}", flush=True)


if __name__ == "__main__":
    main()
