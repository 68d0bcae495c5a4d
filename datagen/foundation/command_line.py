# SPDX-License-Identifier: MIT
"""Common parts of the commands: options declared as dataclasses, removed subcommands, and exit codes.

An option's type, default and help are declared once, by an annotated field of a dataclass. A subcommand takes
the dataclass as a parameter, and :func:`with_options` turns its fields into command-line options.
"""

from __future__ import annotations

import errno
import inspect
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperGroup
from typer.models import OptionInfo, ParameterInfo

from datagen.foundation.errors import DISK_FULL, InputError, Problem, input_error

T = TypeVar("T")

_REMEDIES = {
    errno.ENOENT: "check the path",
    errno.EACCES: "choose a readable and writable path, or change its permissions",
    errno.EPERM: "choose a readable and writable path, or change its permissions",
    errno.EROFS: "choose a path on a writable file system",
    errno.EEXIST: "choose another name, or remove the existing file",
    errno.ENOTDIR: "a part of the path is a file; choose a folder",
    errno.EISDIR: "name a file",
    errno.ENAMETOOLONG: "choose a shorter name",
}


def _print_version(is_given: bool) -> None:
    if is_given:
        from datagen.foundation.versions import DISTRIBUTION, pixel_versions

        typer.echo(f"{DISTRIBUTION} {pixel_versions()[DISTRIBUTION]}")
        raise typer.Exit


VersionOption = Annotated[
    bool,
    typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
]


LibraryPaths = Annotated[list[Path], typer.Argument(metavar="LIBRARY...", help="Library folders.")]


def finite(value: float | None) -> float | None:
    """Typer callback that refuses NaN and infinity, which pass typer's check of an option's minimum."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not finite")
    return value


QuietOption = Annotated[bool, typer.Option("--quiet", help="Show no progress.")]


def run_command(app: Callable[[], object]) -> None:
    """Run a command; print a message instead of a traceback for errors that the user can correct.

    Exit codes: 2 for bad input, including inaccessible files; 1 for a full disk and, silently, a broken pipe.
    """
    try:
        app()
    except InputError as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:
        sys.stderr.close()
        raise SystemExit(1) from None
    except OSError as error:
        is_full = error.errno in DISK_FULL
        if not is_full and (error.filename is None or error.errno not in _REMEDIES):
            raise
        remedy = _REMEDIES.get(error.errno or 0, "make room; finished results are kept")
        print(
            Problem(error.filename or "disk", "", (error.strerror or "").lower(), "", remedy), file=sys.stderr
        )
        raise SystemExit(1 if is_full else 2) from None


def run_function(function: Callable[..., None]) -> None:
    """Run a function as the command of ``python -m MODULE``; its parameters become options."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command()(function)
    run_command(app)


def group_with(moved: Mapping[str, str]) -> type[TyperGroup]:
    """Return a Typer group class for ``moved``, which maps removed subcommands to their replacements."""

    class Group(TyperGroup):
        """Group that raises :class:`InputError` for a removed subcommand, with its replacement."""

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            if args and args[0] in moved:
                verb = f"{ctx.command_path} {args[0]}"
                raise input_error(verb, got=f"is now `{moved[args[0]]}`")
            return super().resolve_command(ctx, args)

    return Group


def with_options(verb: Callable[..., T]) -> Callable[..., T]:
    """Wrap the function ``verb`` for typer: fields of its dataclass parameters become options.

    Fields without a typer annotation keep their defaults; ``tuple[X, ...]`` is a repeatable option.
    """
    hints = get_type_hints(verb, include_extras=True)
    shown: list[inspect.Parameter] = []
    taken: dict[str, tuple[type, list[str]]] = {}  # parameter -> its dataclass, and the options in it
    repeatable: set[str] = set()
    for parameter in inspect.signature(verb).parameters.values():
        hint = hints[parameter.name]
        if is_dataclass(hint) and isinstance(hint, type):
            options = _options_of(hint)
            taken[parameter.name] = hint, [name for name, *_ in options]
        else:
            options = [(parameter.name, hint, parameter.default)]
        for name, kind, default in options:
            if get_origin(kind) is Annotated and _is_repeatable(kind):
                repeatable.add(name)
            shown.append(_shown(name, kind, default))

    @wraps(verb)
    def called(**given: Any) -> T:
        given |= {name: tuple(given[name] or ()) for name in repeatable}
        for name, (kind, options) in taken.items():
            given[name] = kind(**{option: given.pop(option) for option in options})
        return verb(**given)

    called.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    called.__annotations__ = {option.name: option.annotation for option in shown}
    return called


def _options_of(kind: type) -> list[tuple[str, Any, Any]]:
    """Return the name, annotation and default of each field of a dataclass that declares an option."""
    hints = get_type_hints(kind, include_extras=True)
    return [
        (
            field.name,
            hints[field.name],
            inspect.Parameter.empty if field.default is MISSING else field.default,
        )
        for field in fields(kind)
        if any(isinstance(extra, ParameterInfo) for extra in get_args(hints[field.name])[1:])
    ]


def declared_options(kind: type) -> dict[str, tuple[str, float | None]]:
    """Return the command-line name and minimum (or None) of a dataclass's options, by field name."""
    found = {}
    for name, hint, _ in _options_of(kind):
        (option,) = (extra for extra in get_args(hint)[1:] if isinstance(extra, OptionInfo))
        declared = option.default if isinstance(option.default, str) else "--" + name.replace("_", "-")
        found[name] = declared, option.min
    return found


def _is_repeatable(hint: Any) -> bool:
    kind = get_args(hint)[0]
    return get_origin(kind) is tuple and get_args(kind)[1:] == (...,)


def _shown(name: str, hint: Any, default: Any) -> inspect.Parameter:
    """Return a parameter for typer: tuples become lists, and values with a parser become strings."""
    if get_origin(hint) is Annotated:
        kind, *extras = get_args(hint)
        if any(isinstance(extra, ParameterInfo) and extra.parser is not None for extra in extras):
            kind = str
        elif _is_repeatable(hint):
            kind, default = list[get_args(kind)[0]], list(default) or None  # type: ignore[misc]
        hint = Annotated[(kind, *extras)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hint)
