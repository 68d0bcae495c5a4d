# SPDX-License-Identifier: GPL-3.0-or-later
"""The export that the operator, the panel and the command line run.

:func:`export_steps` is a generator: it yields its progress, and closing it cancels the export. In any case,
no temporary data remains in the file and no partial package on disk.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from .assembly import Progress, write_target
from .bake.execute import BakeSession
from .drivers import refuse_unevaluated_drivers
from .problems import ERROR, Problem, ProblemList
from .reading import Contents, Reader
from .settings import ExportSettings
from .targets import find_targets
from .version import fault_of_version
from .write import PackageWriter

REPORT_FILE = "fidelity.html"


@dataclass
class ExportResult:
    """Paths of the report and the packages, all problems, and counts of triangles and instances."""

    report: Path | None = None
    packages: list[Path] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    num_triangles: int = 0
    num_instances: int = 0


Steps = Generator[Progress, None, ExportResult]


def export(out_dir: Path, settings: ExportSettings | None = None) -> ExportResult:
    """Export the open file into ``out_dir``, a folder of packages. Errors raise :class:`ExportRefused`."""
    steps = export_steps(out_dir, settings or ExportSettings())
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            return stop.value


def check(settings: ExportSettings | None = None) -> list[Problem]:
    """Find the problems of an export without baking or writing packages."""
    problems = ProblemList()
    settings = settings or ExportSettings()
    _refuse_old_blender(problems)
    if problems.errors:
        return list(problems)
    with BakeSession() as session:
        reader = _reader(settings, session, problems)
        for target in find_targets(bpy.context.scene, settings, problems):
            reader.prepare(target)
    return list(problems)


def export_steps(out_dir: Path, settings: ExportSettings) -> Steps:
    """Export as :func:`export` does, and yield the progress before each step."""
    problems = ProblemList()
    _refuse_old_blender(problems)
    problems.refuse_errors()
    targets = find_targets(bpy.context.scene, settings, problems)
    problems.refuse_errors()
    result = ExportResult()
    with BakeSession() as session:
        prepared: list[Contents] = []
        reader = _reader(settings, session, problems)
        for index, target in enumerate(targets):
            yield Progress(0.1 * index / len(targets), f"reading {target.title}")
            prepared.append(reader.prepare(target))
        problems.refuse_errors()
        for index, contents in enumerate(prepared):
            folder = out_dir / contents.target.id
            with PackageWriter(folder) as writer:
                for progress in write_target(reader, contents, writer):
                    done = 0.1 + 0.9 * (index + progress.fraction) / len(prepared)
                    yield Progress(done, progress.text)
                problems.refuse_errors()
            result.packages.append(folder)
            result.num_triangles += contents.num_triangles
            result.num_instances += len(contents.gathered.instances)
    result.problems = list(problems)
    if settings.report:
        from .report.compare import report_steps

        result.report = out_dir / REPORT_FILE
        title = Path(bpy.data.filepath).stem or bpy.context.scene.name
        things = sorted(set().union(*(contents.target.owners for contents in prepared)))
        yield from report_steps(result.report, title, settings, reader.uv_layers(), things, result.problems)
    return result


def _refuse_old_blender(problems: ProblemList) -> None:
    fault = fault_of_version()
    if fault is not None:
        problems.add(ERROR, *fault)


def _reader(settings: ExportSettings, session: BakeSession, problems: ProblemList) -> Reader:
    refuse_unevaluated_drivers(problems)
    context = bpy.context
    return Reader(settings, session, problems, context.scene, context.evaluated_depsgraph_get)
