# SPDX-License-Identifier: GPL-3.0-or-later
"""The command ``python -m scenes.sources``, which builds, previews and lists the bundled library's assets."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m scenes.sources",
        description="Build the bundled library from its sources, and preview them.",
        epilog="Example: python -m scenes.sources build --out scenes/library --only teapot",
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    build = verbs.add_parser("build", help="model and export packages")
    build.add_argument("--out", type=Path, required=True, help="the library's folder")
    build.add_argument(
        "--only", action="append", default=[], metavar="ID", help="build only this asset (repeatable)"
    )
    build.add_argument("--kind", action="append", default=[], choices=("material", "object", "environment"))
    build.add_argument(
        "--quality", type=int, default=1, choices=(1, 2, 4, 8), help="factor of the textures' resolution"
    )
    build.add_argument("--verbose", action="store_true", help="print the approximations of the export")
    preview = verbs.add_parser("preview", help="render a source with Cycles")
    preview.add_argument("id")
    preview.add_argument("--out", type=Path, required=True, help="a PNG file")
    preview.add_argument("--samples", type=int, default=24)
    preview.add_argument("--width", type=int, default=480)
    preview.add_argument("--camera", type=float, nargs=6, metavar=("X", "Y", "Z", "TX", "TY", "TZ"))
    gallery = verbs.add_parser("gallery", help="render one picture per kind, with every asset")
    gallery.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    gallery.add_argument("--kind", action="append", default=[], choices=("material", "object", "environment"))
    panoramas = verbs.add_parser("panoramas", help="reduce environment maps to the bundled panoramas")
    panoramas.add_argument("--out", type=Path, required=True, help="the library's folder")
    panoramas.add_argument(
        "--maps", type=Path, required=True, help="folder of Poly Haven's 1k Radiance files"
    )
    panoramas.add_argument(
        "--blender-maps", type=Path, required=True, help="Blender's datafiles/studiolights/world"
    )
    verbs.add_parser("list", help="list ids by kind")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    arguments = _parser().parse_args(argv)
    if arguments.verb == "panoramas":
        return _panoramas(arguments.maps, arguments.blender_maps, arguments.out)
    from scenes.sources.build import sources

    known = sources()
    if arguments.verb == "list":
        from scenes.sources.panoramas import PANORAMAS

        for name, kind in (*known.items(), *((panorama.id, "panorama") for panorama in PANORAMAS)):
            print(kind, name)
        return 0
    asked = [arguments.id] if arguments.verb == "preview" else getattr(arguments, "only", [])
    unknown = sorted(set(asked) - set(known))
    if unknown:
        print(f"error: no source named {', '.join(unknown)}; `list` prints all", file=sys.stderr)
        return 2
    folder = arguments.out.parent if arguments.verb == "preview" else arguments.out
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        print(f"error: {folder}: {error.strerror}; choose another --out", file=sys.stderr)
        return 2
    if arguments.verb == "preview":
        from scenes.sources.preview import render_preview

        render_preview(arguments.id, arguments.out, arguments.samples, arguments.width, arguments.camera)
        return 0
    if arguments.verb == "gallery":
        from scenes.sources.gallery import write_gallery

        for path in write_gallery(
            arguments.out, tuple(arguments.kind) or ("environment", "object", "material")
        ):
            print(path)
        return 0
    return _build(arguments, known)


def _panoramas(maps: Path, blender_maps: Path, out: Path) -> int:
    from datagen.foundation.errors import InputError
    from scenes.sources.panoramas import write_panoramas

    try:
        for path in write_panoramas(maps, blender_maps, out):
            print(path)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _build(arguments: argparse.Namespace, known: dict[str, str]) -> int:
    from blender_addon.command import quiet_stdout
    from blender_addon.problems import ExportRefused
    from scenes.sources.build import FOLDERS, build

    names = [
        name
        for name, kind in known.items()
        if (not arguments.only or name in arguments.only) and (not arguments.kind or kind in arguments.kind)
    ]
    failed = 0
    started = time.monotonic()
    for index, name in enumerate(names):
        try:
            with quiet_stdout():
                package, problems = build(name, arguments.out, arguments.quality)
        except ExportRefused as refused:
            failed += 1
            print(f"{name}: refused\n{refused}", file=sys.stderr)
            continue
        size = sum(f.stat().st_size for f in package.rglob("*") if f.is_file())
        print(
            f"[{index + 1}/{len(names)} {time.monotonic() - started:4.0f} s] {name} {size // 1024} KB",
            flush=True,
        )
        if arguments.verbose:
            for problem in problems:
                print("   ", problem)
    if not arguments.only and not arguments.kind:
        _remove_orphans(arguments.out, known, FOLDERS)
    return 1 if failed else 0


def _remove_orphans(out: Path, known: dict[str, str], folders: dict[str, str]) -> None:
    """Remove the packages in ``out`` that have no source."""
    for kind, folder in folders.items():
        for package in sorted((out / folder).glob("*/asset.json")):
            if known.get(package.parent.name) != kind:
                print(f"removing {package.parent}: it has no source")
                shutil.rmtree(package.parent)
