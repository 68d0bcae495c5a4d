# SPDX-License-Identifier: MIT
"""The verbs of ``datagen farm``; heavy imports happen in the verbs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

FolderArgument = Annotated[Path, typer.Argument(help="Dataset folder.")]

_RepeatedOption = Optional[list[str]]  # noqa: UP045 - typer reads this at run time, on Python 3.10 too

farm = typer.Typer(
    help="One plan on a cluster: submit, watch, retry, cancel, collect.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@farm.command()
def submit(
    folder: FolderArgument,
    engine: Annotated[str, typer.Option(help="slurm, pbs, or shell: only a list of commands.")] = "slurm",
    time_limit: Annotated[str, typer.Option("--time", help="Time limit of a unit.")] = "04:00:00",
    memory: Annotated[str, typer.Option(help="Memory of a unit.")] = "8G",
    cpus: Annotated[int, typer.Option(min=1, help="Processors of a unit.")] = 4,
    gpus: Annotated[int, typer.Option(min=0, help="GPUs of a unit.")] = 0,
    throttle: Annotated[int, typer.Option(min=0, help="Units at a time; 0 = no limit.")] = 0,
    notice: Annotated[int, typer.Option(min=1, help="Seconds of notice before the time limit.")] = 120,
    attempts: Annotated[int, typer.Option(min=1, help="Tries a unit before it is set aside.")] = 3,
    setup: Annotated[str, typer.Option(help="Shell code that makes `datagen` callable on a node.")] = "",
    partition: Annotated[str, typer.Option(help="Slurm partition, or PBS queue.")] = "",
    account: Annotated[str, typer.Option(help="Account.")] = "",
    max_array: Annotated[int, typer.Option(min=2, help="The cluster's longest array (MaxArraySize).")] = 1001,
    qos: Annotated[str, typer.Option(help="Slurm quality of service.")] = "",
    constraint: Annotated[str, typer.Option(help="Features that the units' nodes have.")] = "",
    exclude: Annotated[str, typer.Option(help="Nodes to leave out.")] = "",
    mail_user: Annotated[str, typer.Option(help="Address that Slurm writes to.")] = "",
    mail_type: Annotated[str, typer.Option(help="What Slurm writes about, as END,FAIL.")] = "",
    sbatch_option: Annotated[
        _RepeatedOption, typer.Option(help="NAME or NAME=VALUE for sbatch, for the units; repeatable.")
    ] = None,
    collect_time: Annotated[str, typer.Option(help="Time limit of the job that collects.")] = "04:00:00",
    collect_memory: Annotated[str, typer.Option(help="Memory of the job that collects.")] = "4G",
    collect_cpus: Annotated[int, typer.Option(min=1, help="Processors of the job that collects.")] = 1,
    collect_partition: Annotated[str, typer.Option(help="Its partition; else that of the units.")] = "",
    collect_option: Annotated[
        _RepeatedOption, typer.Option(help="As --sbatch-option, for the job that collects.")
    ] = None,
    space_check: Annotated[
        bool, typer.Option(help="Refuse to submit where the disk is too small for the estimate.")
    ] = True,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only write the job scripts.")] = False,
) -> None:
    """Write readable job scripts for the units that are not done, and submit them.

    Example: datagen farm submit paper --engine slurm --cpus 8 --setup "source .venv/bin/activate"
    """
    from datagen.farm.job_options import SlurmOptions
    from datagen.farm.submission import submit as submit_jobs

    options = SlurmOptions(
        time_limit=time_limit,
        memory=memory,
        cpus=cpus,
        gpus=gpus,
        throttle=throttle,
        notice_s=notice,
        attempts=attempts,
        setup=setup,
        partition=partition,
        account=account,
        max_array=max_array,
        qos=qos,
        constraint=constraint,
        exclude=exclude,
        mail_user=mail_user,
        mail_type=mail_type,
        sbatch_options=tuple(sbatch_option or ()),
        collect_time=collect_time,
        collect_memory=collect_memory,
        collect_cpus=collect_cpus,
        collect_partition=collect_partition,
        collect_options=tuple(collect_option or ()),
    )
    submission = submit_jobs(folder, options, engine, dry_run, space_check)
    for script in submission.scripts:
        typer.echo(script)
    if submission.job_ids:
        typer.echo(f"{submission.num_units} units submitted as jobs {', '.join(submission.job_ids)}")
    else:
        why = "only written" if submission.num_units else "all are done"
        typer.echo(f"{submission.num_units} units to do, nothing submitted: {why}")


@farm.command("status")
def farm_status(
    folder: FolderArgument,
    cost: Annotated[float, typer.Option(min=0, help="Price of an hour of a unit's resources.")] = 0.0,
) -> None:
    """Show units done, running, failed and waiting, rate, time left, cost, and the logs of failures.

    Example: datagen farm status paper --cost 0.12
    """
    from datagen.farm.status import print_status

    print_status(folder, cost)


@farm.command()
def retry(folder: FolderArgument) -> None:
    """Forget the failures that were set aside, so that the next submit or run tries them again.

    Example: datagen farm retry paper && datagen farm submit paper
    """
    from datagen.farm.status import forget_failures

    typer.echo(f"{len(forget_failures(folder))} failed units will be tried again by the next run or submit")


@farm.command()
def cancel(
    folder: FolderArgument,
    engine: Annotated[str, typer.Option(help="The queue that has them: slurm or pbs.")] = "slurm",
) -> None:
    """Cancel this folder's jobs in the queue; what is finished stays.

    Example: datagen farm cancel paper
    """
    from datagen.farm.submission import cancel as cancel_jobs

    ids = cancel_jobs(folder, engine)
    typer.echo(f"cancelled {', '.join(ids)}" if ids else "no jobs of this folder in the queue")


@farm.command("collect")
def farm_collect(
    folder: FolderArgument,
    deep: Annotated[bool, typer.Option("--deep", help="Hash every shard again.")] = False,
) -> None:
    """Write the index from the units that are done; exit code 1 while some are missing.

    Example: datagen farm collect paper --deep
    """
    from datagen.farm.collect import collect

    index = collect(folder, deep, lambda path: typer.echo(f"removed {path}: nothing rests on it"))
    typer.echo(f"{folder}: {index.num_configurations} shards, {index.num_views} views")
    if index.missing:
        typer.echo(f"{len(index.missing)} units are not done, {index.missing[0]} the first of them", err=True)
        raise typer.Exit(1)
