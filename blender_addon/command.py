# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line of the export."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from .problems import ExportRefused, Problem
from .settings import KINDS, ExportSettings

if TYPE_CHECKING:
    from .export import ExportResult, Progress

REFUSED, CANCELLED = 2, 130
_BAR_WIDTH = 30
_LOG_INTERVAL_S = 30.0


def version() -> str:
    """The extension's version, from its manifest."""
    manifest = Path(__file__).with_name("blender_manifest.toml").read_text(encoding="utf-8")
    found = re.search(r'^version = "(.+)"$', manifest, re.MULTILINE)
    return found[1] if found else "unknown"


def build_parser(program: str = "python -m blender_addon") -> argparse.ArgumentParser:
    """Parser of the command's arguments, with the defaults of :class:`ExportSettings`."""
    default = ExportSettings()
    parser = argparse.ArgumentParser(
        prog=program,
        description="Export a .blend file as asset packages.",
        epilog=f"Example: {program} room.blend --out packages --license CC0-1.0 --report",
    )
    parser.add_argument("--version", action="version", version=f"scene_materials {version()}")
    parser.add_argument("blend", type=Path, nargs="?", help="the file (inside Blender: the open one)")
    parser.add_argument("--out", type=Path, help="folder for the packages")
    parser.add_argument("--kind", choices=KINDS, default=default.kind, help="auto: as the file's tags state")
    parser.add_argument("--only", action="append", default=[], metavar="NAME", help="export only this asset")
    parser.add_argument("--tolerance", type=float, default=default.tolerance,
                        help="mean change of a channel below which its texture is not enlarged")  # fmt: skip
    parser.add_argument("--max-texture", dest="max_texture_px", type=int, default=default.max_texture_px,
                        metavar="PX", help="maximum side of a texture, a power of two")  # fmt: skip
    parser.add_argument("--texture-bits", type=int, choices=(8, 16), default=default.texture_bits,
                        help="bits per channel of textures")  # fmt: skip
    parser.add_argument("--bake-normals", action="store_true", help="bake bump and normal maps")
    parser.add_argument("--license", default="", help="SPDX identifier, if the file's tags have none")
    parser.add_argument("--author", default="", help="author, if the file's tags have none")
    parser.add_argument(
        "--source", default="", help="origin, such as a web address, if the file's tags have none"
    )
    parser.add_argument("--report", action="store_true", help="write fidelity.html to the folder --out")
    parser.add_argument(
        "--report-python",
        default="",
        metavar="EXE",
        help="Python executable with this project installed, for the report",
    )
    parser.add_argument("--check", action="store_true", help="list the problems, and write nothing")
    return parser


@contextlib.contextmanager
def quiet_stdout() -> Iterator[None]:
    """Context that discards standard output, including Cycles', which bypasses Python."""
    sys.stdout.flush()
    saved = os.dup(1)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(saved, 1)
        os.close(saved)
        os.close(null)


class ProgressLine:
    """Prints progress to standard error: a bar on a terminal; otherwise a line every 30 seconds."""

    def __init__(self) -> None:
        self.is_terminal = sys.stderr.isatty()
        self.started = self.printed = time.monotonic()

    def __call__(self, progress: Progress) -> None:
        now = time.monotonic()
        elapsed, fraction = now - self.started, progress.fraction
        left = f"{elapsed / fraction - elapsed:4.0f} s left" if fraction > 0.02 else ""
        if self.is_terminal:
            filled = int(fraction * _BAR_WIDTH)
            bar = "#" * filled + "." * (_BAR_WIDTH - filled)
            print(f"\r\033[K[{bar}] {fraction:4.0%} {left} {progress.text[:60]}", end="", file=sys.stderr)
        elif now - self.printed >= _LOG_INTERVAL_S:
            self.printed = now
            print(f"{time.strftime('%H:%M:%S')} {fraction:4.0%} {left} {progress.text}", file=sys.stderr)

    def end(self) -> None:
        """Remove the bar from the terminal."""
        if self.is_terminal:
            print("\r\033[K", end="", file=sys.stderr)


def _list(problems: Sequence[Problem]) -> None:
    for problem in problems:
        print(problem, file=sys.stderr)


def run(arguments: argparse.Namespace) -> int:
    """Export the open file; returns the exit code: 0, ``REFUSED`` or ``CANCELLED``."""
    from .export import check, export_steps

    try:
        names = {field.name for field in fields(ExportSettings)}
        given = {name: value for name, value in vars(arguments).items() if name in names}
        settings = ExportSettings(**{**given, "only": tuple(arguments.only)})
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return REFUSED
    if arguments.check:
        with quiet_stdout():
            problems = check(settings)
        _list(problems)
        return REFUSED if any(p.severity == "error" for p in problems) else 0
    if arguments.out is None:
        print("error: --out is missing; give the folder for the packages", file=sys.stderr)
        return REFUSED
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        print(f"error: {arguments.out}: {error.strerror}; choose another --out", file=sys.stderr)
        return REFUSED
    steps, show = export_steps(arguments.out, settings), ProgressLine()
    result: ExportResult | None = None
    try:
        with quiet_stdout():
            while result is None:
                try:
                    show(next(steps))
                except StopIteration as stop:
                    result = stop.value
    except ExportRefused as refused:
        show.end()
        _list(refused.problems)
        return REFUSED
    except OSError as error:
        show.end()
        print(f"error: {error}; make room, or choose another --out", file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        steps.close()
        print("\ncancelled: nothing was written", file=sys.stderr)
        return CANCELLED
    show.end()
    _list(result.problems)
    for path in [*result.packages, *([result.report] if result.report else [])]:
        print(path)
    return 0


def leave(code: int) -> NoReturn:
    """End the process with ``code``, without Blender's own clean-up.

    If the open file has a scripted driver, that clean-up waits forever for the finished Python interpreter.
    """
    try:
        sys.stdout.flush()
        sys.stderr.flush()
        bpy = sys.modules.get("bpy")
        if bpy is not None and Path(bpy.app.tempdir).name.startswith("blender_"):
            shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
    finally:
        os._exit(code)


def main(argv: Sequence[str] | None = None) -> int:
    """Open a file with the bpy module from PyPI and export it; returns the exit code."""
    arguments = build_parser().parse_args(argv)
    if arguments.blend is None or not arguments.blend.is_file():
        print(f"error: {arguments.blend}: no such file; give the path of a .blend file", file=sys.stderr)
        return REFUSED
    try:
        import bpy
    except ImportError:
        print("error: Blender's module bpy is missing; pip install bpy==4.5.*", file=sys.stderr)
        return REFUSED
    try:
        with quiet_stdout():
            # The file is untrusted: its scripts stay disabled, regardless of the preferences.
            path = str(arguments.blend.resolve())
            bpy.ops.wm.open_mainfile(filepath=path, load_ui=False, use_scripts=False)
    except RuntimeError:
        print(f"error: {arguments.blend}: Blender cannot open it; give a .blend file", file=sys.stderr)
        return REFUSED
    return run(arguments)
