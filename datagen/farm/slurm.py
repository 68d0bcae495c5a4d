# SPDX-License-Identifier: MIT
"""Runs a plan on Slurm, or on any queue that can run one command per unit.

Slurm may run a job twice, since it requeues the job of a lost node whose process may still run;
``work_unit`` commits only one result. Jobs are found by name, since a restarted controller may reuse ids.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from datagen.farm.engine import Engine, Script, ask, job_name, shell_script
from datagen.farm.job_options import SlurmOptions, can_be_directive, check_folder, split_option
from datagen.farm.status import array_spec
from datagen.foundation.errors import input_error


def _directives(directives: dict[str, str | None], options: tuple[str, ...]) -> str:
    """Format ``#SBATCH`` lines; None stands for an option without a value, and '' leaves an option out.

    Values are double-quoted if necessary, as ``#`` would begin a comment. Raises :class:`InputError` for
    values that cannot be quoted.
    """
    lines = []
    for name, value in [*directives.items(), *map(split_option, options)]:
        if value == "":
            continue
        if value is not None and not can_be_directive(value):
            raise input_error("farm submit", name, ascii(value), "one line without quotes", "correct it")
        is_plain = value is None or re.fullmatch(r"[\w.,:@%/+=-]+", value)
        assigned = "" if value is None else f"={value}" if is_plain else f'="{value}"'
        lines.append(f"#SBATCH --{name}{assigned}")
    return "\n".join(lines)


def _shared_directives(root: Path, options: SlurmOptions) -> dict[str, str | None]:
    """Directives common to the array jobs and the collecting job."""
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
    """Script of an array job for the units ``indices``; task i runs unit ``offset + i``.

    The offset keeps task numbers below Slurm's limit.
    """
    throttle = f"%{options.throttle}" if options.throttle else ""
    directives = {
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
    head = _directives(directives, options.sbatch_options)
    return shell_script("units.sbatch", root, options, directives=head, offset=offset)


def _escaped(path: Path) -> str:
    """Escape a path for Slurm's file name patterns."""
    return str(path).replace("%", "%%")


class SlurmEngine:
    """Engine for Slurm, which calls ``sbatch``, ``squeue`` and ``scancel``."""

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
        directives = {
            **_shared_directives(root, options),
            "time": options.collect_time,
            "mem": options.collect_memory,
            "cpus-per-task": str(options.collect_cpus),
            "partition": options.collect_partition or options.partition,
            "output": f"{_escaped(root.resolve())}/logs/slurm-collect.log",
        }
        head = _directives(directives, options.collect_options)
        text = shell_script("collect.sbatch", root, options, directives=head)
        return Script("collect.sbatch", text + shell_script("collect.sh", root, options))

    def send(self, script: Path, after: Sequence[str]) -> str:
        # with afterok, the job would wait forever after a failed task
        wait = [f"--dependency=afterany:{':'.join(after)}"] if after else []
        answer = ask(script, "an accepted job", "sbatch", "--parsable", *wait, str(script.resolve()))
        return answer.strip().split(";")[0]

    def jobs(self, root: Path) -> list[str]:
        """Ids of the dataset folder's jobs; an array counts as one."""
        name = f"--name={job_name(root)}"
        return sorted(set(ask(root, "a list of jobs", "squeue", "--noheader", "--format=%A", name).split()))

    def stop(self, root: Path, ids: Sequence[str]) -> None:
        ask(root, "cancelled jobs", "scancel", f"--name={job_name(root)}")


class ShellEngine(Engine):
    """Engine that writes a command per line, for other queues (GNU parallel, SGE), and submits nothing."""

    program = ""

    def check(self, root: Path, options: SlurmOptions) -> None:
        check_folder(root, "shell")

    def units(self, root: Path, options: SlurmOptions, indices: Sequence[int]) -> list[Script]:
        folder = shlex.quote(str(root.resolve()))
        lines = [f"datagen run {folder} --unit {index} --attempts {options.attempts}" for index in indices]
        return [Script("units.sh", "\n".join(lines) + "\n")]
