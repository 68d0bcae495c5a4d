# SPDX-License-Identifier: MIT
"""The command ``datagen``: parses, calls one function a verb, prints. Heavy imports happen in the verbs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from datagen.exports.command import export
from datagen.farm.commands import farm
from datagen.farm.new_recipe import recipe as recipe_verbs
from datagen.foundation.command_line import VersionOption, run_command
from datagen.tradeoff.command import tradeoff

if TYPE_CHECKING:
    from datagen.farm.local import Event, RunSummary
    from datagen.formats.recipe import Recipe
    from datagen.library import Library

app = typer.Typer(
    name="datagen",
    help="Make scene-scale material datasets: assets are recombined, rendered with ground truth, and packed.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
)


@app.callback()
def _datagen(version: VersionOption = False) -> None:
    """Make scene-scale material datasets: assets are recombined, rendered with ground truth, and packed."""


LibraryOption = Annotated[
    Optional[list[str]],  # noqa: UP045 - typer reads this at run time, on Python 3.10 too
    typer.Option("--library", help='Library folder, repeatable; "bundled" is the project\'s own.'),
]
RecipeArgument = Annotated[Path, typer.Argument(help="Recipe file (YAML), or the name of a bundled one.")]
FolderArgument = Annotated[Path, typer.Argument(help="Dataset folder.")]
WorkersOption = Annotated[int, typer.Option("--workers", min=1, help="Processes to use.")]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Check recipe, library and LLVM, print the resolved recipe, stop.")
]
OutOption = Annotated[Path, typer.Option("--out", help="Dataset folder to write.")]


def _load_recipe(path: Path, library: list[str] | None, overrides: dict[str, object]) -> tuple[Path, Recipe]:
    """The recipe's file, which may be a bundled one, and the recipe with flags over file over defaults."""
    from datagen.formats.base import parse_model, read_yaml
    from datagen.formats.recipe import Recipe
    from datagen.foundation.bundled import resolve_bundled

    path = resolve_bundled(path, "recipes")
    recipe = read_yaml(Recipe, path)
    changes = {key: value for key, value in overrides.items() if value is not None}
    if library:
        changes["library"] = tuple(library)
    if changes:
        recipe = parse_model(Recipe, {**recipe.model_dump(), **changes}, f"{path} with the given options")
    return path, recipe


def _open_library(recipe: Recipe, base: Path) -> Library:
    from datagen.library import Library, resolve_library_paths

    return Library(resolve_library_paths(recipe.library, base))


@app.command()
def doctor() -> None:
    """Say what is installed and what will be used; the exit code tells whether rendering can work.

    Example: datagen doctor
    """
    from datagen.inspection.doctor import examine, print_report

    findings = examine()
    print_report(findings)
    raise typer.Exit(0 if all(f.is_fine or not f.is_required for f in findings) else 1)


@app.command()
def library(
    paths: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Argument(help='Library folders; "bundled" (the default) is the project\'s own.'),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Read every mesh and texture as well.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """List the assets of libraries with class, size and licence; --check finds what is wrong with them.

    Example: datagen library bundled my-library --check
    """
    from datagen.inspection.library_table import print_library

    raise typer.Exit(print_library(paths or ["bundled"], check, as_json))


@app.command("import")
def import_command(
    path: Annotated[
        Path,
        typer.Argument(
            help="Mitsuba scene, glTF, OBJ, PLY, STL, FBX, USD, .blend or Sweet Home 3D file, texture "
            "folder, or a folder of these."
        ),
    ],
    library: Annotated[Path, typer.Option("--library", help="Library folder to import into.")],
    kind: Annotated[str, typer.Option(help="auto, environment, object or material.")] = "auto",
    asset_id: Annotated[str, typer.Option("--id", help="Id of the asset; from its name if left out.")] = "",
    title: Annotated[str, typer.Option(help="Title of the asset.")] = "",
    license_: Annotated[
        str, typer.Option("--license", help="SPDX licence, if none is found beside it.")
    ] = "",
    author: Annotated[str, typer.Option(help="Author, if none is found beside it.")] = "",
    source: Annotated[str, typer.Option(help="Where it comes from.")] = "",
    evaluation_only: Annotated[
        bool, typer.Option("--evaluation-only", help="Never offer it to plans that make training data.")
    ] = False,
    category: Annotated[str, typer.Option(help="Category of an object; guessed if left out.")] = "",
    classes: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--class", help="Material class, repeatable; guessed if left out."),
    ] = None,
    up: Annotated[str, typer.Option(help="Axis that points up in the file: auto, y or z.")] = "auto",
    unit_scale: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(help="Metres in a unit of the file; guessed for OBJ, PLY and STL."),
    ] = None,
    tile_size: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(help="Side of a material's tile in metres."),
    ] = None,
    dielectric: Annotated[str, typer.Option(help="See-through materials: refuse or replace.")] = "refuse",
    dielectric_as: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(help="MATERIAL=STAND-IN for one see-through material, repeatable."),
    ] = None,
    missing: Annotated[str, typer.Option(help="Files that are not there: refuse or replace.")] = "refuse",
    annotations: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="YAML that states support surfaces, openings, light slots and camera regions."),
    ] = None,
    define: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(help="NAME=VALUE for a $name of a Mitsuba scene, repeatable."),
    ] = None,
    allow: Annotated[
        Optional[list[Path]],  # noqa: UP045
        typer.Option("--allow", help="Another folder that the source may name files in, repeatable."),
    ] = None,
    as_zip: Annotated[bool, typer.Option("--zip", help="Write packages as zips.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace assets of the same id.")] = False,
    split: Annotated[
        bool, typer.Option("--split", help="An object for each separate thing of a glTF.")
    ] = False,
) -> None:
    """Turn other people's files into asset packages, and say what is only approximated.

    Example: datagen import staircase/scene.xml --library my-library --dielectric replace
    """
    from datagen.importers.common import ImportedAsset, ImportOptions
    from datagen.importers.dispatch import import_asset
    from datagen.importers.summary import summary_lines
    from datagen.importers.sweet_home_report import ImportWatch

    options = _parse_import_options(
        ImportOptions,
        kind=kind,
        asset_id=asset_id,
        title=title,
        license=license_,
        author=author,
        source=source,
        evaluation_only=evaluation_only,
        category=category,
        classes=tuple(classes or ()),
        up=up,
        unit_scale=unit_scale,
        tile_size_m=tile_size,
        dielectric=dielectric,
        dielectric_as=_pairs("--dielectric-as", dielectric_as),
        missing=missing,
        annotations=annotations,
        defines=_pairs("--define", define),
        allowed=tuple(allow or ()),
        as_zip=as_zip,
        overwrite=overwrite,
    )

    def tell(asset: ImportedAsset) -> None:
        for line in summary_lines(asset):
            typer.echo(line)

    with ImportWatch() as watch:
        imported = import_asset(path, library, options, split=split, on_done=tell, watch=watch)
    typer.echo(f"{len(imported)} assets imported into {library}")


def _pairs(option: str, values: list[str] | None) -> dict[str, str]:
    from datagen.foundation.errors import input_error

    pairs = {}
    for value in values or ():
        name, separator, what = value.partition("=")
        if not separator or not name:
            raise input_error(option, got=repr(value), expected="NAME=VALUE", remedy="write it so")
        pairs[name] = what
    return pairs


def _parse_import_options(options_type: type, **values: object) -> Any:
    """Options of an import, their types and choices checked."""
    from pydantic import TypeAdapter, ValidationError

    from datagen.foundation.errors import InputError, Problem

    try:
        return TypeAdapter(options_type).validate_python(values)
    except ValidationError as error:
        problems = [
            Problem(
                "datagen import",
                "--" + str(e["loc"][0] if e["loc"] else "").removesuffix("_m").replace("_", "-"),
                repr(e.get("input")),
                e["msg"].lower().removeprefix("input should be "),
                "correct the option",
            )
            for e in error.errors()
        ]
        raise InputError(*problems) from None


@app.command()
def plan(
    recipe_path: RecipeArgument,
    out: OutOption,
    workers: WorkersOption = 1,
    library: LibraryOption = None,
    seed: Annotated[Optional[int], typer.Option(help="Seed, instead of the recipe's.")] = None,  # noqa: UP045
    configurations: Annotated[Optional[int], typer.Option(help="How many configurations.")] = None,  # noqa: UP045
    views: Annotated[Optional[int], typer.Option(help="Views a configuration.")] = None,  # noqa: UP045
    dry_run: DryRunOption = False,
) -> None:
    """Assemble a recipe's configurations into a dataset folder, without rendering.

    Example: datagen plan smoke --out smoke
    """
    recipe_path, recipe = _load_recipe(
        recipe_path, library, {"seed": seed, "configurations": configurations, "views": views}
    )
    if dry_run:
        _check_recipe(recipe, recipe_path.parent)
        _print_recipe(recipe)
        return
    _plan(recipe, recipe_path.parent, out, workers)


def _check_recipe(recipe: Recipe, base: Path) -> None:
    """Everything that a run would refuse before it begins."""
    from datagen.farm.planning import check_start

    with _open_library(recipe, base) as opened:
        check_start(recipe, opened)


def _print_recipe(recipe: Recipe) -> None:
    import yaml

    typer.echo(yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False), nl=False)


def _plan(recipe: Recipe, base: Path, out: Path, workers: int) -> None:
    from datagen.farm.planning import create_plan, notes_before, read_configurations
    from datagen.foundation.progress import ProgressBar
    from datagen.inspection.plan_summary import plan_summary

    opened = _open_library(recipe, base)
    for note in notes_before(recipe, opened):
        typer.echo(f"note: {note}", err=True)
    with ProgressBar("assembling", recipe.configurations, "configurations") as progress:
        created = create_plan(recipe, opened, out, workers, lambda done, total: progress.set(done))
    typer.echo(f"{out}: {len(created.units)} units, {sum(u.num_views for u in created.units)} views planned")
    summary = plan_summary(read_configurations(out, created))
    if summary:
        typer.echo(summary)


@app.command()
def run(
    recipe_path: RecipeArgument,
    out: OutOption,
    workers: WorkersOption = 1,
    library: LibraryOption = None,
    seed: Annotated[Optional[int], typer.Option(help="Seed, instead of the recipe's.")] = None,  # noqa: UP045
    configurations: Annotated[Optional[int], typer.Option(help="How many configurations.")] = None,  # noqa: UP045
    views: Annotated[Optional[int], typer.Option(help="Views a configuration.")] = None,  # noqa: UP045
    attempts: Annotated[int, typer.Option(min=1, help="Tries a unit before it is set aside.")] = 3,
    sheets: Annotated[bool, typer.Option(help="Write a contact sheet a configuration.")] = True,
    space_check: Annotated[
        bool, typer.Option(help="Refuse to begin where the disk is too small for the estimate.")
    ] = True,
    preview: Annotated[
        bool, typer.Option("--preview", help="Keep OUT/preview.html current: last views, rate, failures.")
    ] = False,
    dry_run: DryRunOption = False,
) -> None:
    """Plan, render, gather statistics and pack; interrupt at any moment, continue by the same command.

    Example: datagen run smoke --out smoke --workers 2
    """
    recipe_path, recipe = _load_recipe(
        recipe_path, library, {"seed": seed, "configurations": configurations, "views": views}
    )
    if dry_run:
        _check_recipe(recipe, recipe_path.parent)
        _print_recipe(recipe)
        return
    _plan(recipe, recipe_path.parent, out, workers)
    if space_check:
        from datagen.farm.folder import DatasetFolder
        from datagen.farm.space import check_space

        check_space(DatasetFolder(out), workers)
    _run_stages(out, workers, ("render", "stats", "pack"), attempts, preview=preview)
    from datagen.farm.collect import collect

    index = collect(out)
    if sheets:
        _write_sheets(out)
    typer.echo(
        f"{out}: {index.num_configurations} shards, {index.num_views} views, "
        f"{index.num_bytes / 1e6:,.0f} MB; index in {out / 'index.json'}"
    )


def _write_sheets(out: Path) -> None:
    from datagen.inspection.contact_sheet import write_dataset_sheets

    written = write_dataset_sheets(out)
    typer.echo(f"{out}: contact sheets in {out / 'sheets'} ({len(written)} new)")


def _run_stages(
    out: Path,
    workers: int,
    stages: tuple[str, ...],
    attempts: int = 3,
    only: tuple[int, ...] | None = None,
    preview: bool = False,
) -> RunSummary:
    """Run stages of all units with a bar, and with a page if asked for; ends the command with 75 when
    interrupted, 1 when units failed."""
    from datagen.farm.folder import DatasetFolder
    from datagen.farm.local import EXIT_INTERRUPTED, LocalOptions, run_local
    from datagen.foundation.progress import ProgressBar

    folder = DatasetFolder(out)
    plan = folder.read_plan()
    units = [unit for unit in plan.units if only is None or unit.index in only]
    views_of = {unit.id: unit.num_views for unit in units}
    finished = {unit.id: float(unit.num_views) for unit in units if folder.is_done(unit)}
    shares = {"render": 0.85, "stats": 0.15} if "render" in stages and "stats" in stages else {}

    done_before = int(sum(finished.values()))
    page = None
    if preview:
        from datagen.inspection.preview import Preview

        page = Preview(out, sum(views_of.values()), done_before)
        page.update(done_before)
        typer.echo(f"preview: {page.path.absolute().as_uri()}")
    with ProgressBar("+".join(stages), sum(views_of.values()), before=done_before) as progress:

        def on_event(event: Event) -> None:
            kind, unit, stage, done, total = event
            if kind == "progress":
                before = 0.85 * total if stage == "stats" and "render" in shares else 0.0
                finished[unit] = before + done * shares.get(stage, 1.0)
            elif kind == "done":
                finished[unit] = float(views_of[unit])
            else:
                what = "is tried again" if kind == "retry" else "is set aside"
                progress.say(f"{unit} {what} ({done}/{total}): {stage}")
                if page is not None:
                    page.say(f"{unit} {what} ({done}/{total}): {stage}")
            progress.set(int(sum(finished.values())))
            if page is not None:
                page.update(int(sum(finished.values())))

        options = LocalOptions(workers=workers, attempts=attempts, stages=stages, only=only)
        summary = run_local(out, options, on_event)
    if page is not None:
        page.update(int(sum(finished.values())), is_over=True)
    if summary.interrupted:
        typer.echo("interrupted; what is finished is kept, the same command goes on from here", err=True)
        raise typer.Exit(EXIT_INTERRUPTED)
    if summary.disk_full:
        typer.echo(
            f"{summary.disk_full}; the run stops, what is finished is kept: make room, then the same",
            err=True,
        )
        typer.echo("command goes on from here", err=True)
        raise typer.Exit(1)
    if summary.set_aside:
        for record in summary.failures:
            typer.echo(
                f"{record.id} failed {record.attempts} times: {record.reason}\n"
                f"  log: {out / record.log}\n  try it alone: {record.command}",
                err=True,
            )
        raise typer.Exit(1)
    return summary


@app.command()
def estimate(
    recipe_path: RecipeArgument,
    workers: WorkersOption = 1,
    library: LibraryOption = None,
    out: Annotated[Path, typer.Option(help="Where the dataset would go, for the free disk.")] = Path(),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Predict time, disk and memory of a recipe from two timed samples; exit code 1 if the disk is too small.

    Example: datagen estimate paper --workers 2
    """
    import shutil

    from datagen.foundation.progress import ProgressBar
    from datagen.inspection.estimate import estimate as run_estimate
    from datagen.inspection.estimate import print_estimate

    recipe_path, recipe = _load_recipe(recipe_path, library, {})
    opened = _open_library(recipe, recipe_path.parent)
    with ProgressBar("timing samples", 2, "samples") as progress:
        result = run_estimate(recipe, opened, lambda done, total: progress.set(done))
    existing = next(p for p in (out.absolute(), *out.absolute().parents) if p.exists())
    has_room = print_estimate(result, workers, shutil.disk_usage(existing).free, as_json)
    raise typer.Exit(0 if has_room else 1)


@app.command()
def render(folder: FolderArgument, workers: WorkersOption = 1) -> None:
    """Render the views of a planned dataset folder that are not there yet.

    Example: datagen render smoke --workers 2
    """
    _run_stages(folder, workers, ("render",))


@app.command()
def stats(folder: FolderArgument, workers: WorkersOption = 1) -> None:
    """Gather the multi-view statistics of rendered views.

    Example: datagen stats smoke
    """
    _run_stages(folder, workers, ("stats",))


@app.command()
def pack(folder: FolderArgument, workers: WorkersOption = 1) -> None:
    """Pack complete views into shards and write the index.

    Example: datagen pack smoke
    """
    _run_stages(folder, workers, ("pack",))
    from datagen.farm.collect import collect

    index = collect(folder)
    typer.echo(f"{folder}: {index.num_configurations} shards, {index.num_views} views")


@app.command()
def unit(
    folder: FolderArgument,
    index: Annotated[int, typer.Argument(help="Index of the unit in the plan.", min=0)],
    attempts: Annotated[
        int, typer.Option(min=0, help="Tries in processes of their own; 0 runs it once, in this process.")
    ] = 0,
) -> None:
    """Run one unit: what job scripts call (--attempts 3), and how a failure is reproduced.

    Exit codes: 0 done, 75 interrupted (run it again), 1 failed.

    Example: datagen unit smoke 0
    """
    from datagen.farm.local import run_unit_here

    if attempts:
        _run_stages(folder, 1, ("render", "stats", "pack"), attempts, (index,))
        return
    raise typer.Exit(
        run_unit_here(folder, index, report=lambda stage, done, total: print(f"{stage} {done}/{total}"))
    )


@app.command()
def verify(
    path: Annotated[Path, typer.Argument(help="Dataset folder, or one shard.")],
    library: LibraryOption = None,
    workers: WorkersOption = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the whole report as JSON.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Let warnings fail as well.")] = False,
    recheck: Annotated[
        int, typer.Option(min=0, help="Render so many random views again by plain path tracing, and compare.")
    ] = 0,
    recheck_samples: Annotated[
        int, typer.Option(min=4, help="Paths a pixel of each, a multiple of 4.")
    ] = 256,
) -> None:
    """Look for semantic faults in a dataset; exit code 1 if there are any.

    Example: datagen verify smoke --workers 2 --recheck 3
    """
    from datagen.inspection.verify import verify_command
    from datagen.library import resolve_library_paths

    paths = resolve_library_paths(library, Path.cwd()) if library else None
    raise typer.Exit(verify_command(path, paths, workers, as_json, strict, recheck, recheck_samples))


@app.command()
def report(
    folder: FolderArgument,
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder for the page; report/ inside the dataset if left out."),
    ] = None,
    pixels: Annotated[str, typer.Option(help="Views whose pixels are written: a number, or all.")] = "400",
    sources: Annotated[bool, typer.Option(help="Also the source views of each pixel's statistics.")] = True,
    check: Annotated[bool, typer.Option("--verify/--no-verify", help="Verify the dataset first.")] = True,
    cost: Annotated[float, typer.Option(min=0, help="Price of an hour of a unit's resources.")] = 0.0,
    workers: WorkersOption = 1,
    library: LibraryOption = None,
    predictions: Annotated[
        Optional[list[Path]],  # noqa: UP045
        typer.Option(help="Folder of predicted maps to show against the truth, repeatable."),
    ] = None,
    label: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(help="Name for the predictions, repeatable, in their order."),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be written and stop.")] = False,
) -> None:
    """Write a page that shows what a dataset holds, with a viewer; it opens from disk in any browser.

    Example: datagen report smoke --workers 2
    """
    from datagen.inspection.report.command import parse_pixels, report_command
    from datagen.inspection.report.predictions import parse_methods
    from datagen.inspection.report.writing import ReportOptions
    from datagen.library import resolve_library_paths

    methods = parse_methods(predictions or (), label or ())
    options = ReportOptions(parse_pixels(pixels), sources, check, cost, workers, methods)
    paths = resolve_library_paths(library, Path.cwd()) if library else None
    raise typer.Exit(report_command(folder, out, options, paths, dry_run))


@app.command()
def sheet(folder: FolderArgument) -> None:
    """Write a contact sheet for each finished configuration.

    Example: datagen sheet smoke
    """
    _write_sheets(folder)


@app.command()
def schema(
    out: Annotated[Path, typer.Option("--out", help="Folder for the schemas.")] = Path("docs/schemas"),
) -> None:
    """Write the JSON Schemas of all file formats.

    Example: datagen schema --out docs/schemas
    """
    from datagen.formats.schemas import write_schemas

    for path in write_schemas(out):
        typer.echo(path)


app.command()(tradeoff)
app.command()(export)
app.add_typer(farm, name="farm")
app.add_typer(recipe_verbs, name="recipe")


def main() -> None:
    """Entry point."""
    run_command(app)


if __name__ == "__main__":
    main()
