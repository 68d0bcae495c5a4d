# SPDX-License-Identifier: MIT
"""Runs a plan on Slurm, or on any queue that can call one command a unit.

Slurm does not give exactly-once: a killed node's job is requeued while its old process may run to its end.
The output protocol of ``work_unit`` does. Nothing is ever keyed on a job id: a restarted controller reuses
them.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from datagen.farm.folder import DatasetFolder
from datagen.farm.job_options import SlurmOptions, can_be_directive, check_folder, split_option
from datagen.farm.local import EXIT_INTERRUPTED, check_writable
from datagen.farm.space import check_space
from datagen.farm.status import array_spec
from datagen.formats.base import sha256_hex, write_bytes_atomically
from datagen.foundation.errors import input_error


def job_name(root: Path) -> str:
    """Name that all jobs of a dataset folder share; found again by ``squeue`` and ``scancel``."""
    return f"datagen-{sha256_hex(str(root.resolve()).encode())[:10]}"


def _directives(directives: dict[str, str | None], options: tuple[str, ...]) -> str:
    """``#SBATCH`` lines; None is an option without a value. Values between double quotes are read as they are
    (without them, a ``#`` would begin a comment)."""
    lines = []
    for name, value in [*directives.items(), *map(split_option, options)]:
        if value == "":
            continue
        if value is not None and not can_be_directive(value):
            raise input_error("farm submit", name, ascii(value), "one line without quotes", "correct it")
        is_plain = value is None or re.fullmatch(r"[\w.,:@%/+=-]+", value)
        lines.append(
            f"#SBATCH --{name}" + ("" if value is None else f"={value}" if is_plain else f'="{value}"')
        )
    return "\n".join(lines)


def _shared_directives(root: Path, options: SlurmOptions) -> dict[str, str | None]:
    """What both kinds of job ask for."""
    return {
        "job-name": job_name(root),
        "account": options.account,
        "qos": options.qos,
        "exclude": options.exclude,
        "mail-user": options.mail_user,
        "mail-type": options.mail_type,
        "open-mode": "append",
    }


def _with_setup(options: SlurmOptions, root: Path) -> str:
    setup = f"{options.setup.rstrip()}\n" if options.setup.strip() else ""
    return f"set -u\n{setup}folder={shlex.quote(str(root.resolve()))}"


def array_script(root: Path, options: SlurmOptions, offset: int, indices: list[int]) -> str:
    """The array job's script. Task i works on unit ``offset + i``, since arrays have a largest index."""
    check_folder(root, "slurm")
    throttle = f"%{options.throttle}" if options.throttle else ""
    directives: dict[str, str | None] = {
        **_shared_directives(root, options),
        "time": options.time_limit,
        "mem": options.memory,
        "cpus-per-task": str(options.cpus),
        "gres": f"gpu:{options.gpus}" if options.gpus else "",
        "partition": options.partition,
        "constraint": options.constraint,
        "array": array_spec([index - offset for index in indices]) + throttle,
        "requeue": None,
        "output": f"{_escaped(root.resolve())}/logs/slurm-unit-%a.log",
        "signal": f"B:USR1@{options.notice_s}",
    }
    return f"""#!/bin/bash
# Units of {root.resolve().name}: a task a unit. Written by `datagen farm submit`; safe to submit again.
{_directives(directives, options.sbatch_options)}
{_with_setup(options, root)}
unit=$(({offset} + SLURM_ARRAY_TASK_ID))
task="${{SLURM_ARRAY_JOB_ID}}_${{SLURM_ARRAY_TASK_ID}}"

# Slurm tells the script {options.notice_s} s before the time limit; the unit finishes its view and
# ends with {EXIT_INTERRUPTED}.
datagen unit "$folder" "$unit" --attempts {options.attempts} &
worker=$!
trap 'kill -USR1 "$worker" 2>/dev/null' USR1 TERM
wait "$worker"
code=$?
while kill -0 "$worker" 2>/dev/null; do
    wait "$worker"
    code=$?
done
if [ "$code" = {EXIT_INTERRUPTED} ]; then
    # Not $SLURM_JOB_ID: the last task's is the array's, and all tasks would start again.
    scontrol requeue "$task"
fi
exit "$code"
"""


def collect_script(root: Path, options: SlurmOptions) -> str:
    """The dependent job's script: status, index, verification, report. It asks for no GPU, and ends with the
    code of the last step that found something wrong."""
    check_folder(root, "slurm")
    directives: dict[str, str | None] = {
        **_shared_directives(root, options),
        "time": options.collect_time,
        "mem": options.collect_memory,
        "cpus-per-task": str(options.collect_cpus),
        "partition": options.collect_partition or options.partition,
        "output": f"{_escaped(root.resolve())}/logs/slurm-collect.log",
    }
    return f"""#!/bin/bash
# Collects {root.resolve().name} after its units. Written by `datagen farm submit`.
{_directives(directives, options.collect_options)}
{_with_setup(options, root)}
code=0
datagen farm status "$folder" || code=$?
datagen farm collect "$folder" --deep || code=$?
datagen verify "$folder" --workers {options.collect_cpus} || code=$?
datagen report "$folder" --workers {options.collect_cpus} || code=$?
exit "$code"
"""


def shell_script(root: Path, indices: list[int], options: SlurmOptions) -> str:
    """One command a line, for any other queue (GNU parallel, xargs, SGE, HTCondor, ...)."""
    check_folder(root, "shell")
    folder = shlex.quote(str(root.resolve()))
    lines = [f"datagen unit {folder} {index} --attempts {options.attempts}" for index in indices]
    return "\n".join(lines) + "\n"


def _escaped(path: Path) -> str:
    """A path as Slurm's file name patterns take it."""
    return str(path).replace("%", "%%")


@dataclass(frozen=True)
class Submission:
    """What :func:`submit` did: the scripts, and the job ids (empty for a dry run)."""

    scripts: tuple[Path, ...]
    job_ids: tuple[str, ...]
    num_units: int


def _undone(folder: DatasetFolder) -> list[int]:
    return [unit.index for unit in folder.read_plan().units if not folder.is_done(unit)]


def submit(
    root: Path,
    options: SlurmOptions,
    engine: str = "slurm",
    dry_run: bool = False,
    is_space_checked: bool = True,
) -> Submission:
    """Write job scripts for the units that are not done, and submit them unless ``dry_run``.

    Engines: ``slurm``, or ``shell`` (only a list of commands is written). Raises :class:`InputError`, also
    where the disk has no room for the shards and for the views of ``throttle`` units at work, or of one where
    the queue decides how many.
    """
    folder = DatasetFolder(root)
    indices = _undone(folder)
    check_folder(root, engine)
    check_writable(root)
    if is_space_checked and not dry_run:
        check_space(folder, options.throttle or 1)
    jobs = root / "jobs"
    jobs.mkdir(exist_ok=True)
    folder.logs_path.mkdir(exist_ok=True)
    if engine == "shell":
        path = jobs / "units.sh"
        write_bytes_atomically(path, shell_script(root, indices, options).encode())
        return Submission((path,), (), len(indices))
    if engine != "slurm":
        raise input_error("farm submit", "engine", engine, "slurm or shell", "choose one of them")
    scripts = []
    for number, start in enumerate(range(0, _end(indices), options.max_array - 1)):
        chunk = [i for i in indices if start <= i < start + options.max_array - 1]
        if not chunk:
            continue
        path = jobs / f"units-{number}.sbatch"
        write_bytes_atomically(path, array_script(root, options, start, chunk).encode())
        scripts.append(path)
    collect = jobs / "collect.sbatch"
    write_bytes_atomically(collect, collect_script(root, options).encode())
    if dry_run or not scripts:
        return Submission((*scripts, collect), (), len(indices))
    if shutil.which("sbatch") is None:
        remedy = "run this on a cluster's login node, or use --dry-run or --engine shell"
        raise input_error("farm submit", "sbatch", "not found", "Slurm's commands on PATH", remedy)
    already = running_jobs(root)
    if already:
        remedy = "wait for them, or `datagen farm cancel` first"
        raise input_error(root, "jobs", f"{len(already)} in the queue", "none of this folder", remedy)
    ids = [_sbatch(path) for path in scripts]
    # afterok would wait for ever on one failed task.
    ids.append(_sbatch(collect, f"--dependency=afterany:{':'.join(ids)}"))
    return Submission((*scripts, collect), tuple(ids), len(indices))


def _end(indices: list[int]) -> int:
    return indices[-1] + 1 if indices else 0


def _sbatch(script: Path, *arguments: str) -> str:
    result = subprocess.run(
        ["sbatch", "--parsable", *arguments, str(script.resolve())],
        capture_output=True,
        text=True,
        check=False,
    )
    if result.returncode != 0:
        what = " ".join(result.stderr.split()) or f"exit code {result.returncode}"
        raise input_error(script, "sbatch", what, "an accepted job", "correct the options and submit again")
    return result.stdout.strip().split(";")[0]


def running_jobs(root: Path) -> list[str]:
    """Job ids of this folder in Slurm's queue, pending or running, arrays as one."""
    result = subprocess.run(
        ["squeue", "--noheader", "--format=%A", f"--name={job_name(root)}"],
        capture_output=True,
        text=True,
        check=False,
    )
    if result.returncode != 0:
        what = " ".join(result.stderr.split()) or f"exit code {result.returncode}"
        raise input_error(root, "squeue", what, "an answer from Slurm", "check that the controller runs")
    return sorted(set(result.stdout.split()))


def cancel(root: Path) -> list[str]:
    """Cancel every job of this folder; what is finished stays. Returns the ids."""
    DatasetFolder(root).read_plan()
    ids = running_jobs(root)
    if ids:
        subprocess.run(["scancel", f"--name={job_name(root)}"], check=True, capture_output=True)
    return ids
