# SPDX-License-Identifier: MIT
"""The subcommands of ``datagen farm``; heavy modules are imported when a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from datagen.farm.job_options import SlurmOptions
from datagen.foundation.command_line import group_with, with_options

FolderArgument = Annotated[Path, typer.Argument(help="Dataset folder.")]
EngineOption = Annotated[
    str, typer.Option(help="Queue of the jobs: slurm, pbs, or shell (a list of commands, only for submit).")
]

farm = typer.Typer(
    help="Run a plan on a cluster: submit, status, retry, cancel.",
    cls=group_with({"collect": "datagen run FOLDER --only index"}),
    no_args_is_help=True,
    rich_markup_mode=None,
)


@farm.command()
@with_options
def submit(
    folder: FolderArgument,
    options: SlurmOptions,
    engine: EngineOption = "slurm",
    space_check: Annotated[
        bool, typer.Option(help="Submit only if the disk has space for the estimated need.")
    ] = True,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only write the job scripts.")] = False,
) -> None:
    """Write job scripts for the unfinished units, and submit them.

    Example: datagen farm submit paper --engine slurm --cpus 8 --setup "source .venv/bin/activate"
    """
    from datagen.farm.submission import submit as submit_jobs

    submission = submit_jobs(folder, options, engine, dry_run, space_check)
    for script in submission.scripts:
        typer.echo(script)
    if submission.job_ids:
        typer.echo(f"{submission.num_units} units submitted as jobs {', '.join(submission.job_ids)}")
    else:
        why = "--dry-run only writes the scripts" if submission.num_units else "all units are done"
        typer.echo(f"{submission.num_units} units left, none submitted: {why}")


@farm.command("status")
def farm_status(
    folder: FolderArgument,
    cost: Annotated[float, typer.Option(min=0, help="Price of one unit's resources per hour.")] = 0.0,
) -> None:
    """Show units by state, rate, time left, cost and failure logs.

    Example: datagen farm status paper --cost 0.12
    """
    from datagen.farm.status import print_status

    print_status(folder, cost)


@farm.command()
def retry(folder: FolderArgument) -> None:
    """Clear recorded failures. The next submit or run includes these units again.

    Example: datagen farm retry paper && datagen farm submit paper
    """
    from datagen.farm.status import forget_failures

    typer.echo(f"{len(forget_failures(folder))} failed units will be tried again by the next run or submit")


@farm.command()
def cancel(folder: FolderArgument, engine: EngineOption = "slurm") -> None:
    """Cancel this folder's jobs in the queue; finished units are kept.

    Example: datagen farm cancel paper
    """
    from datagen.farm.submission import cancel as cancel_jobs

    ids = cancel_jobs(folder, engine)
    typer.echo(f"cancelled {', '.join(ids)}" if ids else "no jobs of this folder in the queue")
