# SPDX-License-Identifier: MIT
"""Resource requests of job scripts, checked before a script is written.

Both Slurm, for the ``#SBATCH`` directives, and bash parse a script line by line. User input must therefore
match a pattern, or contain no character that ends a line, a quotation or a comment.
"""

from __future__ import annotations

import re
import subprocess
import unicodedata
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import typer

from datagen.foundation.command_line import declared_options
from datagen.foundation.errors import InputError, Problem, Problems, raise_problems

_WHERE = "farm submit"
_UNSAFE_CATEGORIES = {"Cc", "Cs", "Zl", "Zp"}  # control characters, surrogates, line and paragraph separators
_NAMES = re.compile(r"[\w.@+][\w.@+-]*(,[\w.@+][\w.@+-]*)*")
_MAIL_TYPES = re.compile(r"[A-Za-z_0-9]+(,[A-Za-z_0-9]+)*")

# Syntax of sbatch, with an example of each
_FORMS: dict[str, tuple[re.Pattern[str], str]] = {
    "time_limit": (re.compile(r"\d+|\d+:\d\d(:\d\d)?|\d+-\d+(:\d\d){0,2}", re.ASCII), "04:00:00 or 1-12"),
    "memory": (re.compile(r"\d+[KMGT]?", re.ASCII), "8G or 8000M"),
    "partition": (_NAMES, "a name, or names with commas"),
    "account": (_NAMES, "a name"),
    "qos": (_NAMES, "a name"),
    "constraint": (re.compile(r"[\w.&|*()\[\],:!+ -]+"), "features, as in 'a100&ib'"),
    "exclude": (re.compile(r"[\w.,\[\]-]+"), "nodes, as in node[1-3],node7"),
    "mail_user": (re.compile(r"[\w.@+-]+(,[\w.@+-]+)*"), "an address"),
    "mail_type": (_MAIL_TYPES, "END, FAIL, ..."),
}
_FORM_OF = {"collect_time": "time_limit", "collect_memory": "memory", "collect_partition": "partition"}
_RESERVED = {
    "job-name", "array", "output", "error", "input", "requeue", "no-requeue", "signal", "open-mode",
    "dependency", "chdir", "wrap", "parsable", "test-only", "wait", "hold", "ignore-pbs", "help", "version",
    "time", "mem", "cpus-per-task", "gres", "partition", "account", "qos", "constraint", "exclude",
    "mail-user", "mail-type",
}  # fmt: skip
"""Options of sbatch that the scripts set or for which :class:`SlurmOptions` has a field."""


@dataclass(frozen=True)
class SlurmOptions:
    """Resource requests of the job scripts, with times and memory in Slurm's syntax.

    ``notice_s`` seconds before its time limit, a unit is signalled to finish its view, then requeued.
    ``setup`` is shell code that makes ``datagen`` callable on a node. Plans longer than ``max_array`` (the
    cluster's MaxArraySize) become several array jobs. The final job (index, verify, report) shares account,
    qos, exclude, mail and, by default, partition. Invalid values raise :class:`InputError`.
    """

    time_limit: Annotated[
        str, typer.Option("--time", help="Time limit of a unit, such as 04:00:00 or 1-12.")
    ] = "04:00:00"
    memory: Annotated[str, typer.Option(help="Memory of a unit.")] = "8G"
    cpus: Annotated[int, typer.Option(min=1, help="Processors of a unit.")] = 4
    gpus: Annotated[int, typer.Option(min=0, help="GPUs of a unit.")] = 0
    throttle: Annotated[
        int, typer.Option(min=0, help="Maximum number of units running at once; 0: no limit.")
    ] = 0
    notice_s: Annotated[
        int,
        typer.Option(
            "--notice", min=1, help="Seconds before the time limit at which a unit is told to stop."
        ),
    ] = 120
    attempts: Annotated[int, typer.Option(min=1, help="Attempts per unit before it counts as failed.")] = 3
    setup: Annotated[str, typer.Option(help="Shell commands that make `datagen` callable on a node.")] = ""
    partition: Annotated[str, typer.Option(help="Slurm partition, or PBS queue.")] = ""
    account: Annotated[str, typer.Option(help="Account to charge.")] = ""
    max_array: Annotated[
        int, typer.Option(min=2, help="Largest job array of the cluster (MaxArraySize).")
    ] = 1001
    qos: Annotated[str, typer.Option(help="Slurm quality of service.")] = ""
    constraint: Annotated[str, typer.Option(help="Required features of the units' nodes.")] = ""
    exclude: Annotated[str, typer.Option(help="Nodes to leave out.")] = ""
    mail_user: Annotated[str, typer.Option(help="Address for Slurm's e-mails.")] = ""
    mail_type: Annotated[str, typer.Option(help="Events that Slurm e-mails about, such as END,FAIL.")] = ""
    sbatch_options: Annotated[
        tuple[str, ...],
        typer.Option(
            "--sbatch-option", help="Additional sbatch option of the units: NAME or NAME=VALUE, repeatable."
        ),
    ] = ()
    collect_time: Annotated[
        str, typer.Option(help="Time limit of the final job (index, verify, report).")
    ] = "04:00:00"
    collect_memory: Annotated[str, typer.Option(help="Memory of the final job.")] = "4G"
    collect_cpus: Annotated[int, typer.Option(min=1, help="Processors of the final job.")] = 1
    collect_partition: Annotated[
        str, typer.Option(help="Partition of the final job; default: --partition.")
    ] = ""
    collect_options: Annotated[
        tuple[str, ...], typer.Option("--collect-option", help="Like --sbatch-option, but for the final job.")
    ] = ()

    def __post_init__(self) -> None:
        problems, options = Problems(_WHERE), declared_options(SlurmOptions)
        for field in fields(self):
            form, value = _FORMS.get(_FORM_OF.get(field.name, field.name)), getattr(self, field.name)
            if form is not None and (value or field.default) and not form[0].fullmatch(value):
                got, expected = repr(value), f"a value such as {form[1]}"
                problems.add(options[field.name][0], got, expected, "correct it")
        for name, (option, least) in options.items():
            if least is not None and (type(value := getattr(self, name)) is not int or value < least):
                problems.add(option, repr(value), f"a whole number from {least}", "correct it")
        problems += _wrong_setup(self.setup)
        for name in ("sbatch_options", "collect_options"):
            problems += [p for text in getattr(self, name) for p in _wrong_option(options[name][0], text)]
        raise_problems(problems)


def seconds_of(time_limit: str) -> int:
    """Convert a time limit to seconds from Slurm's syntax: M, M:S, H:M:S, D-H, D-H:M or D-H:M:S."""
    days, dash, rest = time_limit.rpartition("-")
    parts = [int(part) for part in rest.split(":")]
    if dash:
        hours, minutes, seconds = [*parts, 0, 0][:3]
    elif len(parts) == 3:
        hours, minutes, seconds = parts
    else:
        hours, (minutes, seconds) = 0, [*parts, 0][:2]
    return ((int(days or 0) * 24 + hours) * 60 + minutes) * 60 + seconds


def option_name(field: str) -> str:
    """Return the command-line option of a field of :class:`SlurmOptions`."""
    return declared_options(SlurmOptions)[field][0]


def _wrong_setup(setup: str) -> list[Problem]:
    """Return the problem of ``setup``, if any: control characters, invalid bash, or an incomplete command,
    which bash would continue on the following lines.
    """
    if not setup.strip():
        return []
    remedy = "write complete bash commands, such as: source .venv/bin/activate"
    bad = next((c for c in setup if c not in "\n\t" and unicodedata.category(c) in _UNSAFE_CATEGORIES), None)
    if bad is not None:
        return [Problem(_WHERE, "--setup", f"{bad!r} in {setup!r}", "lines of text", remedy)]
    checked = subprocess.run(["bash", "-n"], input=setup, text=True, capture_output=True)
    fault = " ".join(checked.stderr.split())  # including warnings, as for an unterminated here-document
    if (len(setup) - len(setup.rstrip("\\"))) % 2:
        fault = "a backslash at its end, which joins it with the next line"
    if checked.returncode != 0 or fault:
        return [Problem(_WHERE, "--setup", fault or repr(setup), "complete commands", remedy)]
    return []


def split_option(text: str) -> tuple[str, str | None]:
    """Split NAME or NAME=VALUE, with or without leading dashes, into name and value (None if absent)."""
    name, separator, value = text.removeprefix("--").partition("=")
    return name, value if separator else None


def _wrong_option(option: str, text: str) -> list[Problem]:
    name, value = split_option(text)
    expected = "NAME or NAME=VALUE as sbatch's long options"
    if not re.fullmatch(r"[a-z][a-z0-9-]*", name):
        return [Problem(_WHERE, option, repr(text), expected, "correct it")]
    if name in _RESERVED:
        return [Problem(_WHERE, option, repr(text), "an option that the scripts do not set", "leave it out")]
    if value is not None and not can_be_directive(value):
        return [Problem(_WHERE, option, repr(text), f"{expected}, without quotes or \\", "correct it")]
    return []


def is_one_line(text: str) -> bool:
    """Return whether a text is a single line, encodable in UTF-8, without control characters."""
    return not any(unicodedata.category(character) in _UNSAFE_CATEGORIES for character in text)


def can_be_directive(text: str) -> bool:
    """Return whether Slurm reads ``text``, double-quoted in a directive, unchanged.

    Slurm treats a backslash as an escape, which in file names disables the replacement of ``%a``.
    """
    return is_one_line(text) and '"' not in text and "\\" not in text


def check_folder(root: Path, engine: str) -> None:
    """Raise :class:`InputError` for a folder whose path the scripts of ``engine`` cannot contain."""
    path = str(root.resolve())
    remedy = "rename the folder, or reach it by another path"
    if not is_one_line(path):
        expected = "a path without line ends and control characters, in UTF-8"
        raise InputError(Problem(_WHERE, "folder", ascii(path), expected, remedy))
    if engine == "slurm" and not can_be_directive(path):
        expected = "a path without double quotes and backslashes, which Slurm's directives cannot contain"
        raise InputError(Problem(_WHERE, "folder", path, expected, remedy))
