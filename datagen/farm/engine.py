# SPDX-License-Identifier: MIT
"""Interface of ``datagen farm`` to batch queues: writes and submits job scripts, finds and cancels jobs.

An engine is a class that implements :class:`Engine`, with an entry in ``submission.ENGINES``. Even if a queue
repeats or requeues a job, ``work_unit`` commits each result exactly once.
"""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Protocol

from datagen.farm.job_options import SlurmOptions
from datagen.farm.worker import EXIT_INTERRUPTED
from datagen.formats.base import sha256_hex
from datagen.foundation.errors import input_error


@dataclass(frozen=True)
class Script:
    """A job script, with its file name in ``jobs/`` of the dataset folder."""

    name: str
    text: str


class Engine(Protocol):
    """Interface to a queue; ``program`` is its submission command, '' if the user runs the scripts."""

    program: str

    def check(self, root: Path, options: SlurmOptions) -> None:
        """Raise :class:`InputError` for options or a folder that the queue's scripts cannot express."""

    def units(self, root: Path, options: SlurmOptions, indices: Sequence[int]) -> list[Script]:
        """Scripts that run ``datagen run FOLDER --unit INDEX`` for each of the ascending ``indices``.

        A queue's scripts run a unit again after exit code 75 (interrupted).
        """

    def collect(self, root: Path, options: SlurmOptions) -> Script | None:
        """Script of the final job, which writes the index, verifies the dataset and reports; or None."""
        return None

    def send(self, script: Path, after: Sequence[str]) -> str:
        """Submit a script that starts when the jobs with ids ``after`` have ended; return its job id."""
        raise input_error(script, got="a list of commands", expected="a queue that accepts it")

    def jobs(self, root: Path) -> list[str]:
        """Ids of the pending and running jobs of the dataset folder ``root``."""
        return []

    def stop(self, root: Path, ids: Sequence[str]) -> None:
        """Cancel the jobs ``ids`` of the dataset folder ``root``."""
        return


def job_name(root: Path) -> str:
    """Return the name of a dataset folder's jobs, which is unique to the folder."""
    return f"datagen-{sha256_hex(str(root.resolve()).encode())[:10]}"


def with_setup(options: SlurmOptions, root: Path) -> str:
    """First shell lines of every job, with the user's setup code and the definition of ``$folder``."""
    setup = f"{options.setup.rstrip()}\n" if options.setup.strip() else ""
    return f"set -u\n{setup}folder={shlex.quote(str(root.resolve()))}"


class _ShellTemplate(Template):
    delimiter = "@"


def shell_script(template: str, root: Path, options: SlurmOptions, **values: object) -> str:
    """Text of a file in ``templates/`` with ``@{...}`` replaced by ``values``, the fields of ``options``, the
    folder's ``name``, the result of :func:`with_setup` and the exit code of interrupted units.
    """
    text = (files("datagen.farm") / "templates" / template).read_text(encoding="utf-8")
    shared = {**vars(options), "interrupted": EXIT_INTERRUPTED, "setup": with_setup(options, root)}
    return _ShellTemplate(text).substitute({**shared, "name": root.resolve().name, **values})


def ask(where: Path, expected: str, *command: str) -> str:
    """Run a queue's command and return its output.

    If it fails, raises :class:`InputError` with ``where``, ``expected`` and the error output.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        got = " ".join(done.stderr.split()) or f"exit code {done.returncode}"
        raise input_error(where, command[0], got, expected, "correct the options, or check the queue")
    return done.stdout
