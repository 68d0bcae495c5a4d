# SPDX-License-Identifier: MIT
"""Time of planning, rerun, status and collection for plans of different numbers of units.

    python -m benchmarks.bench_farm_scale                 # real files, 1,000 to 10,000 finished units

Creates folders of finished units (configurations, markers, shards of one record) and times four operations:
planning of existing configurations, a rerun with nothing left to do, status, and collection. ``cpu_s`` is
processor time, which depends little on other work on the machine.
"""

from __future__ import annotations

import argparse
import io
import statistics
import tarfile
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks.timing import timed, write_report
from datagen.assembly.plan import configuration_id
from datagen.farm.collect import collect
from datagen.farm.folder import DatasetFolder, FolderRecord, Plan, UnitManifest
from datagen.farm.local import LocalOptions, run_local
from datagen.farm.planning import write_plan
from datagen.farm.status import read_status
from datagen.formats.base import canonical_json, sha256_hex
from datagen.formats.configuration import Configuration, PlacedAsset, ViewCamera
from datagen.formats.recipe import Recipe, RenderRecipe
from datagen.formats.view import RenderRecord, ViewRecord
from datagen.foundation.bundled import bundled_library
from datagen.foundation.cameras import Camera, look_at
from datagen.library import Library


def plan_folder(root: Path, num_units: int, library: Library) -> tuple[DatasetFolder, Recipe]:
    """Write a dataset folder of ``num_units`` configurations, without a plan; returns it and its recipe."""
    folder = DatasetFolder(root)
    for path in (folder.shards_path, folder.units_path, folder.configuration_path("x").parent):
        path.mkdir(parents=True)
    recipe = Recipe(
        name="scale", configurations=num_units, views=40, render=RenderRecipe(variant="llvm_ad_rgb")
    )
    folder.recipe_path.write_bytes(canonical_json(recipe))  # JSON is YAML
    record = FolderRecord(recipe_sha256="", library_sha256="", library_paths=(), versions={})
    folder.record_path.write_bytes(canonical_json(record))
    room = library.select("environment")[0]
    for index in range(num_units):
        configuration = Configuration(
            id=configuration_id(recipe, index),
            index=index,
            seed=index,
            environment=PlacedAsset(name="environment", asset=room.id),
            cameras=tuple(_camera(view) for view in range(40)),
            assets={room.id: room.sha256},
        )
        folder.configuration_path(configuration.id).write_bytes(canonical_json(configuration))
    return folder, recipe


def _camera(view: int) -> ViewCamera:
    pose = look_at([0.1 * view, -2.0, 1.4], [0.0, 0.0, 1.0])
    return ViewCamera.from_camera(f"view-{view:03d}", Camera(640, 480, 500.0, 500.0, 320.0, 240.0, pose))


def _shard(configuration: str) -> bytes:
    """Bytes of a tar that contains one view's record."""
    record = ViewRecord(
        configuration=configuration,
        name="view-000",
        index=0,
        split="train",
        camera=_camera(0),
        exposure=1.0,
        buffers=("beauty",),
        instances={},
        materials={},
        render=RenderRecord(
            variant="llvm_ad_rgb",
            seed=0,
            path_samples=1,
            auxiliary_samples=1,
            max_depth=2,
            russian_roulette_depth=2,
            denoiser="none",
        ),
        versions={},
        exr_sha256="",
    )
    data = canonical_json(record)
    info = tarfile.TarInfo(f"{configuration}/view-000.json")
    info.size = len(data)
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        tar.addfile(info, io.BytesIO(data))
    return stream.getvalue()


def finish_folder(folder: DatasetFolder, plan: Plan) -> None:
    """Write the markers and shards that all units of a plan have once they are finished."""
    for unit in plan.units:
        shard = _shard(unit.id)
        digest = sha256_hex(shard)
        name = f"shards/{unit.id}-{digest[:16]}.tar"
        (folder.root / name).write_bytes(shard)
        manifest = UnitManifest(
            key=unit.key,
            id=unit.id,
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
        (folder.units_path / f"{unit.key}.json").write_bytes(canonical_json(manifest))


def time_real_folders(sizes: list[int], repeats: int) -> list[dict]:
    """Median wall and processor seconds of each operation on folders of ``sizes`` units."""
    rows = []
    library = Library([bundled_library()])
    for size in sizes:
        with tempfile.TemporaryDirectory() as temporary:
            folder, recipe = plan_folder(Path(temporary) / "set", size, library)
            steps: dict[str, Callable[[], int]] = {
                "plan": lambda f=folder, r=recipe: len(write_plan(f, r, library).units),  # type: ignore[misc]
                "rerun": lambda f=folder: run_local(f.root, LocalOptions(workers=2)).already_done,  # type: ignore[misc]
                "status": lambda f=folder: read_status(f.root).done,  # type: ignore[misc]
                "collect": lambda f=folder: len(collect(f.root).shards),  # type: ignore[misc]
            }
            row: dict[str, float] = {"units": size}
            for name, step in steps.items():
                times = [timed(partial(_run, step, size)) for _ in range(repeats)]
                row[f"{name}_s"], row[f"{name}_cpu_s"] = (
                    round(statistics.median(values), 3) for values in zip(*times, strict=True)
                )
                if name == "plan":
                    finish_folder(folder, folder.read_plan())
            rows.append(row)
    return rows


def _run(step: Callable[[], int], expected: int) -> None:
    assert step() == expected


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 2000, 5000, 10000])
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    write_report(time_real_folders(options.sizes, options.repeats), None, indent=2)


if __name__ == "__main__":
    main()
