# SPDX-License-Identifier: MIT
"""Runs a plan on Slurm, or on any queue that can call one command per unit.

Slurm does not guarantee exactly one run: a killed node's job is requeued while its old process may still be
running. The output protocol of ``work_unit`` does. Nothing is ever identified by a job id, since a restarted
controller reuses them.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from datagen.farm.engine import Script, ask, collect_commands, job_name, with_setup
from datagen.farm.job_options import SlurmOptions, can_be_directive, check_folder, split_option
from datagen.farm.status import array_spec
from datagen.farm.worker import EXIT_INTERRUPTED
from datagen.foundation.errors import input_error


def _directives(directives: dict[str, str | None], options: tuple[str, ...]) -> str:
    """``#SBATCH`` lines; None marks an option without a value.

    Values are double-quoted, which keeps them unchanged (otherwise a ``#`` would begin a comment).
    """
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
    """Directives shared by both kinds of job."""
    return {
        "job-name": job_name(root),
        "account": options.account,
        "qos": options.qos,
        "exclude": options.exclude,
        "mail-user": options.mail_user,
        "mail-type": options.mail_type,
        "open-mode": "append",
    }


def array_script(root: Path, options: SlurmOptions, offset: int, indices: list[int]) -> str:
    """The array job's script. Task i runs unit ``offset + i``, since array indices are limited."""
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
{with_setup(options, root)}
unit=$(({offset} + SLURM_ARRAY_TASK_ID))
task="${{SLURM_ARRAY_JOB_ID}}_${{SLURM_ARRAY_TASK_ID}}"

# Slurm tells the script {options.notice_s} s before the time limit; the unit finishes its view and
# ends with {EXIT_INTERRUPTED}.
datagen run "$folder" --unit "$unit" --attempts {options.attempts} &
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
    """The dependent job's script: status, index, verification, report.

    The job requests no GPU; it exits with the code of the last failed step.
    """
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
{with_setup(options, root)}
{collect_commands(options)}"""


def shell_script(root: Path, indices: list[int], options: SlurmOptions) -> str:
    """One command per line, for any other queue (GNU parallel, xargs, SGE, HTCondor, ...)."""
    check_folder(root, "shell")
    folder = shlex.quote(str(root.resolve()))
    lines = [f"datagen run {folder} --unit {index} --attempts {options.attempts}" for index in indices]
    return "\n".join(lines) + "\n"


def _escaped(path: Path) -> str:
    """A path, escaped for Slurm's file name patterns."""
    return str(path).replace("%", "%%")


class SlurmEngine:
    """The engine for Slurm, by ``sbatch``, ``squeue`` and ``scancel``."""

    program = "sbatch"

    def check(self, root: Path, options: SlurmOptions) -> None:
        check_folder(root, "slurm")

    def units(self, root: Path, options: SlurmOptions, indices: Sequence[int]) -> list[Script]:
        scripts, end = [], indices[-1] + 1 if indices else 0
        for number, start in enumerate(range(0, end, options.max_array - 1)):
            chunk = [i for i in indices if start <= i < start + options.max_array - 1]
            if chunk:
                scripts.append(Script(f"units-{number}.sbatch", array_script(root, options, start, chunk)))
        return scripts

    def collect(self, root: Path, options: SlurmOptions) -> Script | None:
        return Script("collect.sbatch", collect_script(root, options))

    def send(self, script: Path, after: Sequence[str]) -> str:
        # afterok would wait for ever after one failed task.
        wait = [f"--dependency=afterany:{':'.join(after)}"] if after else []
        answer = ask(script, "an accepted job", "sbatch", "--parsable", *wait, str(script.resolve()))
        return answer.strip().split(";")[0]

    def jobs(self, root: Path) -> list[str]:
        """Ids of this folder's jobs; an array counts as one."""
        name = f"--name={job_name(root)}"
        return sorted(
            set(ask(root, "an answer from Slurm", "squeue", "--noheader", "--format=%A", name).split())
        )

    def stop(self, root: Path, ids: Sequence[str]) -> None:
        ask(root, "jobs that end", "scancel", f"--name={job_name(root)}")


class ShellEngine:
    """A list of commands for any other queue; nothing is submitted."""

    program = ""

    def check(self, root: Path, options: SlurmOptions) -> None:
        check_folder(root, "shell")

    def units(self, root: Path, options: SlurmOptions, indices: Sequence[int]) -> list[Script]:
        return [Script("units.sh", shell_script(root, list(indices), options))]

    def collect(self, root: Path, options: SlurmOptions) -> Script | None:
        return None

    def send(self, script: Path, after: Sequence[str]) -> str:
        raise input_error(script, got="a list of commands", expected="a queue that accepts it")

    def jobs(self, root: Path) -> list[str]:
        return []

    def stop(self, root: Path, ids: Sequence[str]) -> None:
        """Nothing to do: there are no jobs."""
