# SPDX-License-Identifier: MIT
"""What planning, status and collection cost as plans grow, and what the file system sees.

    python -m benchmarks.bench_farm_scale                 # real files, 1,000 to 10,000 finished units
    python -m benchmarks.bench_farm_scale --simulate      # 1,000,000 units on 10,000 slots, with failures

The first part makes folders of finished units (markers and one-kilobyte shards) and times the commands a
user waits for. The second simulates attempts, kills and retries of a large plan in memory and counts the
operations of the output protocol.
"""

from __future__ import annotations

import argparse
import heapq
import json
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from datagen.farm.folder import DatasetFolder, FolderRecord, Plan, PlannedUnit, UnitManifest
from datagen.farm.local import LocalOptions, run_local
from datagen.farm.status import read_status
from datagen.formats.base import canonical_json, sha256_hex
from datagen.formats.recipe import Recipe


def make_finished_folder(root: Path, num_units: int) -> DatasetFolder:
    """A folder whose plan of ``num_units`` is done; shards hold a kilobyte each."""
    folder = DatasetFolder(root)
    for path in (folder.shards_path, folder.units_path):
        path.mkdir(parents=True)
    recipe = Recipe(name="scale", configurations=num_units, views=40)
    folder.recipe_path.write_bytes(canonical_json(recipe))  # JSON is YAML
    record = FolderRecord(recipe_sha256="", library_sha256="", library_paths=(), versions={})
    folder.record_path.write_bytes(canonical_json(record))
    shard = b"\0" * 1024
    digest = sha256_hex(shard)
    units = []
    for index in range(num_units):
        key = sha256_hex(str(index).encode())
        unit_id = f"scale-{index:07d}"
        units.append(
            PlannedUnit(
                index=index, id=unit_id, split="train", key=key, num_views=40, seed=index, assets=("room",)
            )
        )
        name = f"shards/{unit_id}-{digest[:16]}.tar"
        (root / name).write_bytes(shard)
        manifest = UnitManifest(
            key=key,
            id=unit_id,
            shard=name,
            sha256=digest,
            num_bytes=len(shard),
            num_views=40,
            attempt="a",
            host="h",
            seconds={"render": 60.0},
            views=(),
            peak_memory_mb=900.0,
        )
        (folder.units_path / f"{key}.json").write_bytes(canonical_json(manifest))
    plan = Plan(variant="llvm_ad_rgb", versions={}, assets={}, units=tuple(units))
    folder.plan_path.write_bytes(canonical_json(plan))
    return folder


def time_real_folders(sizes: list[int], repeats: int) -> list[dict]:
    """Median seconds of a rerun and of a status on finished folders of several sizes."""
    rows = []
    for size in sizes:
        with tempfile.TemporaryDirectory() as temporary:
            folder = make_finished_folder(Path(temporary) / "set", size)
            reruns, looks = [], []
            for _ in range(repeats):
                start = time.perf_counter()
                summary = run_local(folder.root, LocalOptions(workers=2))
                reruns.append(time.perf_counter() - start)
                assert summary.already_done == size
                start = time.perf_counter()
                assert read_status(folder.root).done == size
                looks.append(time.perf_counter() - start)
            rows.append(
                {"units": size, "rerun_s": statistics.median(reruns), "status_s": statistics.median(looks)}
            )
    return rows


def simulate(num_units: int, slots: int, failure_share: float, seed: int = 0) -> dict:
    """Attempts, makespan and file operations of a plan whose attempts die with ``failure_share``.

    Each attempt takes a log-normal time (median 80 s for 40 views); a killed one keeps the views it finished.
    """
    rng = np.random.default_rng(seed)
    views = 40
    free = [0.0] * slots
    heapq.heapify(free)
    queue: list[tuple[int, int]] = [(unit, 0) for unit in range(num_units)]
    queue.reverse()
    attempts = kills = 0
    end = 0.0
    durations = rng.lognormal(np.log(80.0), 0.3, num_units)
    while queue:
        unit, done_views = queue.pop()
        start = heapq.heappop(free)
        attempts += 1
        left = durations[unit] * (views - done_views) / views
        if rng.random() < failure_share:
            share = rng.random()
            kills += 1
            queue.append((unit, done_views + int((views - done_views) * share)))
            finish = start + left * share
        else:
            finish = start + left
        end = max(end, finish)
        heapq.heappush(free, finish)
    files_a_unit = 4 * views + views + 3  # rendered and complete EXR and JSON, timings; shard, manifest, log
    return {
        "units": num_units,
        "slots": slots,
        "failure_share": failure_share,
        "attempts": attempts,
        "kills": kills,
        "makespan_h": end / 3600,
        "file_creations_per_s": num_units * files_a_unit / end,
        "renames_per_s": num_units * (4 * views + 3) / end,
        "listings_per_status": 4,
        "marker_opens_per_status": num_units,
        "plan_megabytes": num_units * 200 / 1e6,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 2000, 5000, 10000])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--simulate", action="store_true")
    parser.add_argument("--units", type=int, default=1_000_000)
    parser.add_argument("--slots", type=int, default=10_000)
    parser.add_argument("--failures", type=float, default=0.03)
    options = parser.parse_args()
    if options.simulate:
        start = time.perf_counter()
        result = simulate(options.units, options.slots, options.failures)
        result["simulation_s"] = round(time.perf_counter() - start, 1)
        print(json.dumps(result, indent=2))
    else:
        print(json.dumps(time_real_folders(options.sizes, options.repeats), indent=2))


if __name__ == "__main__":
    main()
