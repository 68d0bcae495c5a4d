# SPDX-License-Identifier: MIT
"""The command ``datagen``: its subcommands, and the replacements of removed subcommands."""

from __future__ import annotations

import typer

from datagen.exports.command import export
from datagen.farm.commands import farm
from datagen.farm.new_recipe import recipe
from datagen.foundation.command_line import VersionOption, group_with, run_command
from datagen.importers.command import import_command
from datagen.inspection.commands import doctor, library, report, verify
from datagen.run_command import estimate, plan, run

MOVED = {
    **{stage: f"datagen run FOLDER --only {stage}" for stage in ("render", "stats", "pack")},
    "unit": "datagen run FOLDER --unit INDEX",
    "sheet": "datagen report FOLDER --sheets-only",
    "schema": "python -m datagen.formats.schemas",
    "tradeoff": "python -m datagen.tradeoff",
}
"""Removed subcommands, and the commands that replace them."""

app = typer.Typer(
    name="datagen",
    help="Make scene-scale material datasets: assets are recombined, rendered with ground truth, and packed.",
    cls=group_with(MOVED),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback()
def _datagen(version: VersionOption = False) -> None:
    """Make scene-scale material datasets: recombine assets, render them with ground truth, and pack them."""


for verb in (doctor, library, import_command, plan, run, estimate, verify, report, export):
    app.command(verb.__name__.removesuffix("_command"))(verb)
app.add_typer(farm, name="farm")
app.add_typer(recipe, name="recipe")


def main() -> None:
    """Run the command ``datagen``."""
    run_command(app)


if __name__ == "__main__":
    main()
