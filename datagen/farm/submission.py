# SPDX-License-Identifier: MIT
"""Submits the unfinished units of a plan to a queue."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from datagen.farm.engine import Engine
from datagen.farm.folder import DatasetFolder
from datagen.farm.job_options import SlurmOptions
from datagen.farm.pbs import PbsEngine
from datagen.farm.slurm import ShellEngine, SlurmEngine
from datagen.farm.space import check_space
from datagen.farm.worker import check_writable
from datagen.formats.base import write_bytes_atomically
from datagen.foundation.errors import input_error

ENGINES: dict[str, Engine] = {"slurm": SlurmEngine(), "pbs": PbsEngine(), "shell": ShellEngine()}
"""Engines by their name in ``--engine``."""


@dataclass(frozen=True)
class Submission:
    """Result of :func:`submit`: scripts, job ids (none without submission), number of unfinished units."""

    scripts: tuple[Path, ...]
    job_ids: tuple[str, ...]
    num_units: int


def engine_of(name: str) -> Engine:
    """Return the engine called ``name``. Raises :class:`InputError` for an unknown name."""
    if name not in ENGINES:
        raise input_error("farm", "engine", name, ", ".join(ENGINES), "choose one of them")
    return ENGINES[name]


def submit(
    root: Path,
    options: SlurmOptions,
    engine: str = "slurm",
    dry_run: bool = False,
    is_space_checked: bool = True,
) -> Submission:
    """Write job scripts for the unfinished units, and submit them unless ``dry_run``.

    Raises :class:`InputError` for faults of options, folder or queue and, if ``is_space_checked``, for a disk
    without space for the shards and for ``throttle`` units in progress (one if it is 0).
    """
    folder, queue = DatasetFolder(root), engine_of(engine)
    indices = [unit.index for unit in folder.read_plan().units if not folder.is_done(unit)]
    queue.check(root, options)
    check_writable(root)
    if is_space_checked and not dry_run:
        check_space(folder, options.throttle or 1)
    jobs = root / "jobs"
    jobs.mkdir(exist_ok=True)
    folder.logs_path.mkdir(exist_ok=True)
    units, last = queue.units(root, options, indices), queue.collect(root, options)
    written = []
    for script in [*units, *([last] if last is not None else [])]:
        written.append(jobs / script.name)
        write_bytes_atomically(written[-1], script.text.encode())
    if dry_run or not units or not queue.program:
        return Submission(tuple(written), (), len(indices))
    if shutil.which(queue.program) is None:
        remedy = "run the command on a cluster's login node, or use --dry-run or --engine shell"
        raise input_error("farm submit", queue.program, "not found", f"{engine}'s commands on PATH", remedy)
    already = queue.jobs(root)
    if already:
        remedy = "wait for them, or `datagen farm cancel` first"
        raise input_error(root, "jobs", f"{len(already)} in the queue", "none of this folder", remedy)
    ids = [queue.send(path, ()) for path in written[: len(units)]]
    if last is not None:
        ids.append(queue.send(written[-1], tuple(ids)))
    return Submission(tuple(written), tuple(ids), len(indices))


def cancel(root: Path, engine: str = "slurm") -> list[str]:
    """Cancel all jobs of a dataset folder and return their ids; finished units are kept."""
    DatasetFolder(root).read_plan()
    queue = engine_of(engine)
    ids = queue.jobs(root)
    if ids:
        queue.stop(root, ids)
    return ids
