# SPDX-License-Identifier: MIT
"""Runs the trials of a sweep, each of one setting on one configuration, and renders references for them.

Worker processes compute the results, stored as ``OUT/references/KEY`` and ``OUT/trials/KEY-SETTING.json``; an
interrupted sweep continues from them, and other sweeps in the same folder reuse them.
"""

from __future__ import annotations

import json
import os
import platform
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import typer

from datagen.farm.folder import DatasetFolder
from datagen.formats.base import canonical_json, sha256_hex, write_bytes_atomically
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import QUALITIES
from datagen.foundation.errors import Problem, Problems, input_error, raise_problems
from datagen.foundation.paths import output_problems
from datagen.foundation.versions import pixel_versions
from datagen.library import Library
from datagen.tradeoff.reference import MAX_SAMPLES, Reference, make_reference, reference_key, sized
from datagen.tradeoff.settings import SWEEPS, Setting, base_setting, planned_settings
from datagen.tradeoff.trial import Trial, measure
from mitsuba_plugins.variant import CPU_VARIANT, CUDA_VARIANT, VARIANTS, has_cuda, resolve_variant

MIN_SIDE_PX, MAX_SIDE_PX = 8, 16384


@dataclass(frozen=True)
class SweepOptions:
    """Options of a sweep: settings, configurations and references."""

    configurations: Annotated[
        tuple[int, ...], typer.Option("--configuration", help="Index of a configuration, repeatable.")
    ] = (0,)
    size: Annotated[tuple[int, int], typer.Option(help="Resolution: WIDTH HEIGHT in pixels.")] = (160, 96)
    views: Annotated[int, typer.Option(min=1, help="Views per configuration, evenly spaced.")] = 4
    reference_samples: Annotated[
        int, typer.Option(min=16, help="Paths per pixel in each of the two reference images.")
    ] = 512
    sweeps: Annotated[
        tuple[str, ...], typer.Option("--sweep", help="Field to vary: NAME or NAME=VALUE,VALUE, repeatable.")
    ] = tuple(SWEEPS)
    with_factorial: Annotated[
        bool,
        typer.Option(
            "--factorial/--no-factorial",
            help="Measure all combinations of samples, auxiliary samples, denoiser and irradiance cache.",
        ),
    ] = True
    variant: Annotated[
        str | None, typer.Option(help="Mitsuba variant of the base point; default: the fastest available.")
    ] = None


@dataclass(frozen=True)
class Subject:
    """A configuration at the sweep's resolution, with its library and reference."""

    configuration: Configuration
    library_paths: tuple[str, ...]
    reference: Reference
    reference_samples: int

    def trial_path(self, out: Path, setting: Setting) -> Path:
        """Path of a trial's result, named after the reference and a hash of setting and software versions."""
        meaning = QUALITIES[setting.quality] if setting.quality else None  # type: ignore[index]
        key = sha256_hex(canonical_json([asdict(setting), meaning, pixel_versions()]))[:16]
        return out / "trials" / f"{self.reference.folder.name}-{key}.json"


class Sweep:
    """A sweep over configurations of a planned dataset folder; ``unavailable``: settings that need a GPU.

    Raises :class:`InputError` for faults of options or folder.
    """

    def __init__(self, folder: Path, out: Path, options: SweepOptions):
        self.out, self.options = out, options
        _check(out, options)
        self.base = base_setting(resolve_variant(options.variant))
        self.settings = planned_settings(self.base, options.sweeps, options.with_factorial)
        self.unavailable = tuple(s for s in self.settings if s.variant == CUDA_VARIANT and not has_cuda())
        self.settings = [s for s in self.settings if s not in self.unavailable]
        self.subjects = self._find_subjects(DatasetFolder(folder))

    def _find_subjects(self, folder: DatasetFolder) -> list[Subject]:
        options = self.options
        units = folder.read_plan().units
        problems = Problems(folder.root)
        for index in options.configurations:
            if not 0 <= index < len(units):
                problems.add("--configuration", index, f"0 ... {len(units) - 1}")
        raise_problems(problems)
        paths = tuple(map(str, folder.library_paths()))
        subjects = []
        for index in dict.fromkeys(options.configurations):
            configuration = sized(folder.read_configuration(units[index]), options.size, options.views)
            key = reference_key(configuration, options.reference_samples)
            reference = Reference(self.out / "references" / key, len(configuration.cameras))
            subjects.append(Subject(configuration, paths, reference, options.reference_samples))
        return subjects

    def pending(self) -> list[tuple[Subject, Setting]]:
        """Pairs (subject, setting) without a stored trial, in order."""
        pairs = product(self.subjects, self.settings)
        return [(s, setting) for s, setting in pairs if not s.trial_path(self.out, setting).is_file()]

    def missing_views(self) -> int:
        """Number of reference views that are not yet stored."""
        return sum(s.reference.num_views - s.reference.num_made for s in self.subjects)

    def trials(self) -> list[Trial]:
        """All stored trials of this sweep."""
        paths = (s.trial_path(self.out, setting) for s, setting in product(self.subjects, self.settings))
        return [read_trial(path) for path in paths if path.is_file()]

    def description(self) -> dict[str, str]:
        """Conditions of the sweep for its report, by name."""
        options = self.options
        views = " or ".join(dict.fromkeys(str(s.reference.num_views) for s in self.subjects))
        return {
            "configurations": ", ".join(s.configuration.id for s in self.subjects),
            "views": f"{views} of {options.size[0]}x{options.size[1]} per configuration",
            "reference": f"2 x {options.reference_samples} paths per pixel",
            "base": ", ".join(f"{name} {value}" for name, value in asdict(self.base).items() if value != ""),
            "machine": f"{os.cpu_count()} cores, {platform.processor() or platform.machine()}",
            "versions": ", ".join(f"{name} {version}" for name, version in pixel_versions().items()),
        }

    def run(self, report: Callable[[str, int], None] = lambda what, done: None) -> list[Trial]:
        """Compute the missing references and trials, and return all trials of the sweep.

        ``report(what, steps)`` is called when views or trials are finished. Raises :class:`RuntimeError` if a
        worker process dies; finished results are kept, as after an interrupt.
        """
        for subject in self.subjects:
            if not subject.reference.is_complete:
                reported = subject.reference.num_made
                with _worker() as pool:
                    future = pool.submit(_make_reference, subject)
                    is_done = False
                    while not is_done:
                        is_done = bool(wait([future], timeout=0.5).done)
                        made = subject.reference.num_made
                        if made > reported:
                            report(f"{subject.configuration.id}: reference", made - reported)
                            reported = made
                    future.result()
        (self.out / "trials").mkdir(parents=True, exist_ok=True)
        for variant in (CPU_VARIANT, CUDA_VARIANT):
            todo = [(subject, s) for subject, s in self.pending() if s.variant == variant]
            if not todo:
                continue
            with _worker() as pool:
                for subject, setting in todo:
                    trial = pool.submit(_measure, subject, setting).result()
                    path = subject.trial_path(self.out, setting)
                    write_bytes_atomically(path, canonical_json(asdict(trial)))
                    report(f"{subject.configuration.id}: {setting.text(self.base)}", 1)
        return self.trials()


def _check(out: Path, options: SweepOptions) -> None:
    """Raise :class:`InputError` with all faults of the output folder and the options."""
    problems = output_problems(out, (out / "references").is_dir(), "one of an earlier sweep")
    if min(options.size) < MIN_SIDE_PX or max(options.size) > MAX_SIDE_PX:
        got, expected = "{} x {}".format(*options.size), f"sides of {MIN_SIDE_PX} ... {MAX_SIDE_PX} pixels"
        problems.append(Problem("--size", "", got, expected, "correct it"))
    if options.reference_samples > MAX_SAMPLES:
        got, expected = str(options.reference_samples), f"at most {MAX_SAMPLES}"
        problems.append(Problem("--reference-samples", "", got, expected, "correct it"))
    if options.variant is not None and options.variant not in VARIANTS:
        expected = f"one of {', '.join(VARIANTS)}"
        problems.append(Problem("--variant", "", repr(options.variant), expected, "correct it"))
    elif options.variant == CUDA_VARIANT and not has_cuda():
        problems.append(Problem("--variant", "", options.variant, "a GPU, or llvm_ad_rgb", "leave it out"))
    raise_problems(problems)


def read_trial(path: Path) -> Trial:
    """Read a stored trial. Raises :class:`InputError` if the file is unreadable or not a trial."""
    try:
        return Trial(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise input_error(path, "", str(error), "a trial", "remove the file and run again") from None


@contextmanager
def _worker() -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of one new process, for one Mitsuba variant. Raises ``RuntimeError`` if it dies."""
    pool = ProcessPoolExecutor(1, get_context("spawn"), _start_worker)
    try:
        yield pool
    except BrokenProcessPool:
        raise RuntimeError(
            "the rendering process has died (out of memory, or killed); finished results are kept, and the "
            "same command continues"
        ) from None
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends the worker


def _make_reference(subject: Subject) -> None:
    with Library(subject.library_paths) as library:
        make_reference(subject.configuration, library, subject.reference, subject.reference_samples)


def _measure(subject: Subject, setting: Setting) -> Trial:
    with Library(subject.library_paths) as library:
        return measure(subject.configuration, library, subject.reference, setting)
