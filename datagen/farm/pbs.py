# SPDX-License-Identifier: MIT
"""Runs a plan on PBS (OpenPBS, PBS Professional) in array jobs.

PBS arrays have at least two members with consecutive numbers, so the script lists the unit of each member.
PBS sends no signal before a time limit, so the script sends one. Jobs of unfinished units then resubmit
themselves. The collecting job, which has a different name, resubmits itself while units are left.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from datagen.farm.engine import Script, ask, job_name, shell_script
from datagen.farm.job_options import SlurmOptions, check_folder, option_name, seconds_of
from datagen.foundation.errors import Problems, raise_problems

_SLURM_ONLY = ("qos", "constraint", "exclude", "mail_type", "sbatch_options", "collect_options")


class PbsEngine:
    """Engine for PBS, which calls ``qsub``, ``qselect`` and ``qdel``; ``--partition`` is a PBS queue."""

    program = "qsub"

    def check(self, root: Path, options: SlurmOptions) -> None:
        check_folder(root, "pbs")
        problems = Problems("farm submit")
        for name in _SLURM_ONLY:
            if getattr(options, name):
                option, got = option_name(name), repr(getattr(options, name))
                remedy = "leave it out, or edit the script that --dry-run writes"
                problems.add(option, got, "nothing: PBS does not support it", remedy)
        if options.notice_s >= seconds_of(options.time_limit):
            problems.add("--notice", str(options.notice_s), f"less than --time {options.time_limit}")
        raise_problems(problems)

    def units(self, root: Path, options: SlurmOptions, indices: Sequence[int]) -> list[Script]:
        size = options.max_array
        return [
            Script(f"units-{number}.pbs", _unit_script(root, options, indices[start : start + size], number))
            for number, start in enumerate(range(0, len(indices), size))
        ]

    def collect(self, root: Path, options: SlurmOptions) -> Script | None:
        select = _select(options.collect_cpus, options.collect_memory, 0)
        queue = options.collect_partition or options.partition
        head = _directives(_collecting_name(root), options, select, options.collect_time, queue)
        text = shell_script("collect.pbs", root, options, directives=head, job_name=job_name(root))
        return Script("collect.pbs", text + shell_script("collect.sh", root, options))

    def send(self, script: Path, after: Sequence[str]) -> str:
        wait = ["-W", f"depend=afterany:{':'.join(after)}"] if after else []
        return ask(script, "an accepted job", "qsub", *wait, str(script.resolve())).strip()

    def jobs(self, root: Path) -> list[str]:
        names = (job_name(root), _collecting_name(root))
        return sorted({job for n in names for job in ask(root, "a list of jobs", "qselect", "-N", n).split()})

    def stop(self, root: Path, ids: Sequence[str]) -> None:
        ask(root, "cancelled jobs", "qdel", *ids)


def _collecting_name(root: Path) -> str:
    return f"collect-{job_name(root)}"


def _select(cpus: int, memory: str, gpus: int) -> str:
    unit = memory.lower() + ("mb" if memory.isdigit() else "b")
    return f"select=1:ncpus={cpus}:mem={unit}" + (f":ngpus={gpus}" if gpus else "")


def _directives(name: str, options: SlurmOptions, select: str, time_limit: str, queue: str) -> str:
    minutes, seconds = divmod(seconds_of(time_limit), 60)
    lines = [
        f"-N {name}",
        f"-l {select}",
        f"-l walltime={minutes // 60:02d}:{minutes % 60:02d}:{seconds:02d}",
        *([f"-q {queue}"] if queue else []),
        *([f"-A {options.account}"] if options.account else []),
        *([f"-M {options.mail_user}", "-m ae"] if options.mail_user else ["-m n"]),
        # The script redirects its output, since a directive cannot contain every path.
        "-j oe",
        "-o /dev/null",
        "-r y",
    ]
    return "\n".join(f"#PBS {line}" for line in lines)


def _unit_script(root: Path, options: SlurmOptions, indices: Sequence[int], number: int) -> str:
    select = _select(options.cpus, options.memory, options.gpus)
    head = _directives(job_name(root), options, select, options.time_limit, options.partition)
    if len(indices) > 1:
        throttle = f"%{options.throttle}" if options.throttle else ""
        head += f"\n#PBS -J 0-{len(indices) - 1}{throttle}"
    wait_s = seconds_of(options.time_limit) - options.notice_s
    units = " ".join(map(str, indices))
    return shell_script(
        "units.pbs", root, options, directives=head, units=units, wait_s=wait_s, number=number
    )
