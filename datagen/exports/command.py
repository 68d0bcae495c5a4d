# SPDX-License-Identifier: MIT
"""The subcommand ``datagen export``, which defers heavy imports."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from datagen.foundation.progress import Bars

FORMATS = {
    "hypersim": (
        "HypersimFiles",
        "folders like Hypersim's: an HDF5 file per frame and quantity (extra `export`)",
    ),
    "nerfstudio": ("export_nerfstudio", "a folder per room with transforms.json, images, depth and points"),
    "coco": ("CocoFiles", "boxes and masks of objects"),
    "bop": ("BopFiles", "3D boxes, poses and meshes of objects (needs the library)"),
    "flow": ("export_flow", "optical flow between views that overlap, with masks of visible points"),
}
"""Name of the writer and description of each format; the writer's module has the name of the format.

A writer is a class with ``add`` (called for each room) and ``finish``, or a function called for each room."""


def export(
    layout: Annotated[
        Literal["hypersim", "nerfstudio", "coco", "bop", "flow"],
        typer.Argument(metavar="FORMAT", help=f"One of {', '.join(FORMATS)}."),
    ],
    folder: Annotated[Path, typer.Argument(help="Dataset folder.")],
    out: Annotated[Path, typer.Option(help="Folder to write.")],
    split: Annotated[
        Literal["train", "validation", "test"] | None, typer.Option(help="Only this split; default: all.")
    ] = None,
    configuration: Annotated[
        list[str] | None, typer.Option(help="Id of a configuration, repeatable; default: all.")
    ] = None,
    library: Annotated[
        list[str] | None, typer.Option(help="Library folder, repeatable; default: those of the dataset.")
    ] = None,
    neighbours: Annotated[int, typer.Option(min=1, help="Flow: number of target views per view.")] = 2,
    min_overlap: Annotated[
        float, typer.Option(min=0, max=1, help="Flow: minimum share of a view that is visible in the other.")
    ] = 0.2,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the planned output and stop.")] = False,
) -> None:
    """Write a dataset in the layout of another tool: Hypersim, nerfstudio, COCO, BOP, or optical flow.

    Example: datagen export coco rooms --out rooms-coco
    """
    from datagen.exports.rooms import Export, claim_folder, open_rooms
    from datagen.farm.folder import library_of, rooms_of
    from datagen.library import Library, resolve_library_paths

    rooms = open_rooms(folder, split, configuration or ())
    writer_name, description = FORMATS[layout]
    typer.echo(f"{out}: {len(rooms)} configurations as {layout}: {description}")
    if dry_run:
        return
    with ExitStack() as stack:
        if library:
            paths = [*resolve_library_paths(library, Path.cwd()), *rooms_of(folder)]
        else:
            paths = library_of(folder) or []
        opened = stack.enter_context(Library(paths)) if paths else None
        job = Export(rooms, out, opened, neighbours, min_overlap)
        writer: Any = getattr(import_module(f"datagen.exports.{layout}"), writer_name)
        files = writer(job) if isinstance(writer, type) else None
        add = partial(writer, job) if files is None else files.add
        selection = {"split": split or "all", "configurations": sorted(configuration or ()) or "all"}
        claim_folder(out, layout, folder, selection)
        with Bars("configurations") as bars:
            for number, room in enumerate(rooms):
                bars.tell(layout, number, len(rooms))
                add(room)
            bars.tell(layout, len(rooms), len(rooms))
        if files is not None:
            files.finish()
    typer.echo(f"{out}: {job.num_files} files written")
