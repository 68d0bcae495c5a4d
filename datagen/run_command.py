# SPDX-License-Identifier: MIT
"""The subcommands ``plan``, ``run`` and ``estimate`` of ``datagen``; heavy modules are imported on use."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from datagen.foundation.bundled import bundled_names, resolve_bundled
from datagen.foundation.command_line import with_options
from datagen.foundation.errors import input_error
from datagen.foundation.progress import Bars
from datagen.inspection.commands import WorkersOption, write_sheets

if TYPE_CHECKING:
    from datagen.farm.local import Event, RunSummary
    from datagen.formats.recipe import Recipe
    from datagen.library import Library

STAGES = ("render", "stats", "pack")

RecipeArgument = Annotated[Path, typer.Argument(help="Recipe file (YAML), or the name of a bundled recipe.")]
LibraryOption = Annotated[
    list[str] | None,
    typer.Option(
        "--library", help='Library folder, repeatable; "bundled" is the one installed with the project.'
    ),
]
DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Check the input, print the plan, stop.")]


@dataclass(frozen=True)
class RecipeChanges:
    """Options that override keys of a recipe; None keeps the recipe's value."""

    library: LibraryOption = None
    seed: Annotated[int | None, typer.Option(help="Seed, instead of the recipe's.")] = None
    configurations: Annotated[int | None, typer.Option(help="Number of configurations.")] = None
    views: Annotated[int | None, typer.Option(help="Views per configuration.")] = None

    def load(self, path: Path) -> tuple[Path, Recipe]:
        """Read a recipe by path or bundled name; return its path and the recipe with these changes."""
        from datagen.formats.base import parse_model, read_yaml
        from datagen.formats.recipe import Recipe

        path = resolve_bundled(path, "recipes")
        recipe = read_yaml(Recipe, path)
        changes = {key: value for key, value in asdict(self).items() if value is not None}
        if changes:
            changes |= {"library": tuple(changes["library"])} if "library" in changes else {}
            recipe = parse_model(Recipe, {**recipe.model_dump(), **changes}, f"{path} with the given options")
        return path, recipe


@dataclass(frozen=True)
class RunOptions:
    """Options of a run: by default, all stages of all units."""

    only: Annotated[
        Literal["render", "stats", "pack", "index"] | None,
        typer.Option(help="Only this stage: views, their multi-view statistics, shards, or the index."),
    ] = None
    unit: Annotated[int | None, typer.Option(min=0, help="Only this unit, by its index in the plan.")] = None
    attempts: Annotated[
        int,
        typer.Option(
            min=0, help="Attempts per unit before it counts as failed; 0: run --unit once in this process."
        ),
    ] = 3
    deep: Annotated[bool, typer.Option("--deep", help="Check the hash of every shard before indexing.")] = (
        False
    )
    sheets: Annotated[bool, typer.Option(help="Write a contact sheet for each configuration.")] = True
    space_check: Annotated[
        bool, typer.Option(help="Start only if the disk has space for the estimated need.")
    ] = True
    preview: Annotated[
        bool, typer.Option("--preview", help="Update OUT/preview.html: latest views, rate, failures.")
    ] = False

    @property
    def stages(self) -> tuple[str, ...]:
        """Stages to run for each unit; empty if only the index is requested."""
        return STAGES if self.only is None else tuple(stage for stage in STAGES if stage == self.only)


@with_options
def plan(
    recipe_path: RecipeArgument,
    out: Annotated[Path, typer.Option(help="Dataset folder to write.")],
    changes: RecipeChanges,
    workers: WorkersOption = 1,
    dry_run: DryRunOption = False,
) -> None:
    """Plan a recipe's configurations in a dataset folder. Nothing is rendered.

    Example: datagen plan smoke --out smoke
    """
    _plan(recipe_path, changes, out, workers, dry_run)


@with_options
def run(
    source: Annotated[
        Path, typer.Argument(metavar="RECIPE|FOLDER", help="Recipe, with --out; or a folder with a plan.")
    ],
    changes: RecipeChanges,
    options: RunOptions,
    out: Annotated[Path | None, typer.Option(help="Dataset folder to write; only with a recipe.")] = None,
    workers: WorkersOption = 1,
    dry_run: DryRunOption = False,
) -> None:
    """Plan, render, compute statistics, pack and index. The same command continues an interrupted run.

    Job scripts use --unit; --unit with --attempts 0 reproduces a failure. Exit codes: 0 done, 75 interrupted
    (run it again), 1 failed.

    Example: datagen run smoke --out smoke --workers 2
    """
    if out is not None:
        _plan(source, changes, out, workers, dry_run)
        if dry_run:
            return
    else:
        _check_planned(source, changes)
        out = source
        if dry_run:
            _print_left(out, options)
            return
    if options.attempts == 0:
        if options.unit is None:
            raise typer.BadParameter("0 runs one unit in this process: give --unit", param_hint="--attempts")
        from datagen.farm.worker import run_unit_here

        def report(stage: str, done: int, total: int) -> None:
            print(f"{stage} {done}/{total}")

        raise typer.Exit(run_unit_here(out, options.unit, options.stages, report))
    if "render" in options.stages and options.unit is None and options.space_check:
        from datagen.farm.folder import DatasetFolder
        from datagen.farm.space import check_space

        check_space(DatasetFolder(out), workers)
    if options.stages:
        _run_stages(out, workers, options)
    if options.unit is None and options.only in (None, "pack", "index"):
        _write_index(out, options.deep, has_sheets=options.sheets and options.only is None)


def _check_planned(folder: Path, changes: RecipeChanges) -> None:
    """Raise :class:`InputError` if a recipe or its options are given without ``--out``."""
    if folder.is_file() or (not folder.exists() and str(folder) in bundled_names("recipes")):
        raise input_error("--out", got="missing", expected="the dataset folder to write", remedy="add it")
    given = [name for name, value in asdict(changes).items() if value is not None]
    if given:
        expected = "a recipe and --out; a folder with a plan contains its recipe"
        raise input_error(f"--{given[0]}", got=str(folder), expected=expected, remedy="leave the option out")


def _plan(recipe_path: Path, changes: RecipeChanges, out: Path, workers: int, dry_run: bool) -> None:
    """Plan a recipe or, if ``dry_run``, check for anything that would stop a run and print the recipe."""
    recipe_path, recipe = changes.load(recipe_path)
    if not dry_run:
        plan_recipe(recipe, recipe_path.parent, out, workers)
        return
    import yaml

    from datagen.farm.planning import check_start

    with _open_library(recipe, recipe_path.parent) as opened:
        check_start(recipe, opened)
    typer.echo(yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False), nl=False)


def _open_library(recipe: Recipe, base: Path) -> Library:
    from datagen.library import Library, resolve_library_paths

    return Library(resolve_library_paths(recipe.library, base))


def plan_recipe(recipe: Recipe, base: Path, out: Path, workers: int) -> None:
    """Plan ``recipe``, whose paths are relative to ``base``, in the folder ``out``, and print a summary."""
    from datagen.farm.planning import create_plan, read_configurations
    from datagen.inspection.report.summary import plan_summary

    def tell(note: str) -> None:
        typer.echo(f"note: {note}", err=True)

    opened = _open_library(recipe, base)
    with Bars("configurations") as bars:
        created = create_plan(recipe, opened, out, workers, partial(bars.tell, "plan"), tell)
    typer.echo(f"{out}: {len(created.units)} units, {sum(u.num_views for u in created.units)} views planned")
    summary = plan_summary(read_configurations(out, created))
    if summary:
        typer.echo(summary)


def _print_left(out: Path, options: RunOptions) -> None:
    from datagen.farm.folder import DatasetFolder

    folder = DatasetFolder(out)
    units = [unit for unit in folder.read_plan().units if options.unit in (None, unit.index)]
    left = sum(not folder.is_done(unit) for unit in units)
    typer.echo(f"{out}: {left} of {len(units)} units are not done: {', '.join(options.stages) or 'index'}")


def _write_index(out: Path, deep: bool, has_sheets: bool) -> None:
    """Write the index and, if requested, contact sheets; exit with code 1 if units are missing."""
    from datagen.farm.collect import collect

    def removed(path: Path) -> None:
        typer.echo(f"removed {path}, left by a killed attempt")

    with Bars("units") as bars:
        index = collect(out, deep, removed, partial(bars.tell, "index"))
    if has_sheets:
        write_sheets(out)
    typer.echo(
        f"{out}: {index.num_configurations} shards, {index.num_views} views, "
        f"{index.num_bytes / 1e6:,.0f} MB; index in {out / 'index.json'}"
    )
    if index.missing:
        typer.echo(f"{len(index.missing)} units are not done; the first is {index.missing[0]}", err=True)
        raise typer.Exit(1)


def _run_stages(out: Path, workers: int, options: RunOptions) -> None:
    """Run stages of units with a progress bar and, if requested, the preview page.

    Exits with code 75 if interrupted and 1 if units failed.
    """
    from datagen.farm.folder import DatasetFolder
    from datagen.farm.local import LocalOptions, run_local

    folder, only = DatasetFolder(out), None if options.unit is None else (options.unit,)
    units = [unit for unit in folder.read_plan().units if only is None or unit.index in only]
    views_of = {unit.id: unit.num_views for unit in units}
    finished = {unit.id: float(unit.num_views) for unit in units if folder.is_done(unit)}
    shares = {"render": 0.85, "stats": 0.15} if options.only is None else {}

    done_before = int(sum(finished.values()))
    page = None
    if options.preview:
        from datagen.inspection.preview import Preview

        page = Preview(out, sum(views_of.values()), done_before)
        page.update(done_before)
        typer.echo(f"preview: {page.path.absolute().as_uri()}")
    with Bars("views") as bars:
        tell = partial(bars.tell, "+".join(options.stages), total=sum(views_of.values()))
        tell(done_before)

        def on_event(event: Event) -> None:
            kind, unit, stage, done, total = event
            if kind == "progress":
                before = 0.85 * total if stage == "stats" and shares else 0.0
                finished[unit] = before + done * shares.get(stage, 1.0)
            elif kind == "done":
                finished[unit] = float(views_of[unit])
            else:
                outcome = "is tried again" if kind == "retry" else "has failed"
                text = f"{unit} {outcome} ({done}/{total}): {stage}"
                bars.say(text)
                if page is not None:
                    page.say(text)
            tell(int(sum(finished.values())))
            if page is not None:
                page.update(int(sum(finished.values())))

        local = LocalOptions(workers=workers, attempts=options.attempts, stages=options.stages, only=only)
        summary = run_local(out, local, on_event)
    if page is not None:
        page.update(int(sum(finished.values())), is_over=True)
    _exit_unless_done(out, summary)


def _exit_unless_done(out: Path, summary: RunSummary) -> None:
    """Print why a run stopped or failed, and exit; do nothing if all units are done."""
    from datagen.farm.worker import EXIT_INTERRUPTED

    if summary.interrupted:
        typer.echo("interrupted; finished views are kept, and the same command continues", err=True)
        raise typer.Exit(EXIT_INTERRUPTED)
    if summary.disk_full:
        typer.echo(
            f"{summary.disk_full}; the run stops, and finished views are kept: free space, then continue\n"
            "with the same command",
            err=True,
        )
        raise typer.Exit(1)
    for record in summary.failures:
        typer.echo(
            f"{record.id} failed {record.attempts} times: {record.reason}\n"
            f"  log: {out / record.log}\n  reproduce: {record.command}",
            err=True,
        )
    if summary.failures:
        raise typer.Exit(1)


def estimate(
    recipe_path: RecipeArgument,
    workers: WorkersOption = 1,
    library: LibraryOption = None,
    out: Annotated[
        Path, typer.Option(help="Planned dataset folder; its disk is checked for free space.")
    ] = Path(),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Predict time, disk and memory of a recipe from timed samples.

    The exit code is 1 if the disk is too small.

    Example: datagen estimate paper --workers 2
    """
    from datagen.inspection.estimate import estimate as run_estimate
    from datagen.inspection.estimate import print_estimate

    recipe_path, recipe = RecipeChanges(library).load(recipe_path)
    opened = _open_library(recipe, recipe_path.parent)
    with Bars("samples") as bars:
        result = run_estimate(recipe, opened, partial(bars.tell, "time samples"))
    existing = next(p for p in (out.absolute(), *out.absolute().parents) if p.exists())
    has_space = print_estimate(result, workers, shutil.disk_usage(existing).free, as_json)
    raise typer.Exit(0 if has_space else 1)
