# SPDX-License-Identifier: MIT
"""Base of all JSON and YAML files of the project: strict models, readable errors, canonical bytes."""

from __future__ import annotations

import hashlib
import json
import os
import reprlib
import stat
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from datagen.formats.yaml_places import YamlPlaces, syntax_error
from datagen.foundation.durable import publish
from datagen.foundation.errors import InputError, Problem

MAX_TEXT_BYTES = 256 * 1024 * 1024  # larger than any valid JSON or YAML file
_MAX_YAML_BYTES = 512 * 1024  # YAML files are hand-written; parsing this size takes 5 s
_MAX_SLUG = 200  # leaves room for a suffix in a file name


class StrictModel(BaseModel):
    """Base of every file model: unknown keys are errors, instances are immutable, NaN and Inf are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, allow_inf_nan=False)


def _check_slug(value: str) -> str:
    known = all(c in "abcdefghijklmnopqrstuvwxyz0123456789_-." for c in value)
    if not known or value in ("", ".") or ".." in value or len(value) > _MAX_SLUG:
        raise ValueError(f"expected lower-case letters, digits, '_', '-' and '.' only, at most {_MAX_SLUG}")
    return value


def _check_relative_path(value: str) -> str:
    path = value.replace("\\", "/")  # files written on Windows
    if (
        not path.isprintable()  # the operating system ends a name at a NUL, Python does not
        or ":" in path
        or any(p in ("", ".", "..") for p in path.split("/"))
    ):
        raise ValueError("expected a relative path inside the folder, without '..'")
    return path


def _check_affine(rows: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
    if tuple(rows[3]) != (0.0, 0.0, 0.0, 1.0):
        raise ValueError("expected a 4x4 matrix whose last row is 0 0 0 1")
    return rows


Slug = Annotated[str, AfterValidator(_check_slug)]
"""Identifier that is a valid file name on any system."""
RelativePath = Annotated[str, AfterValidator(_check_relative_path)]
"""Path inside a package, '/'-separated (backslashes are converted); never leaves the package."""
Unit = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Vector3 = tuple[float, float, float]
UnitColor = tuple[Unit, Unit, Unit]
"""Linear Rec.709, each component in [0, 1]."""


def _check_clip(limits: tuple[float, float] | None) -> tuple[float, float] | None:
    if limits is not None and not limits[0] < limits[1]:
        raise ValueError("expected the near limit to be below the far limit")
    return limits


ClipRange = Annotated[
    tuple[NonNegative, Positive] | None,
    AfterValidator(_check_clip),
    Field(exclude_if=lambda limits: limits is None),
]
"""Near and far clipping distance of a camera in metres, along its optical axis; None = no limits.

None is not written: files without limits keep the bytes that they had before this field existed."""
Radiometric3 = tuple[NonNegative, NonNegative, NonNegative]
"""Radiance in W/(m^2 sr), intensity in W/sr or irradiance in W/m^2, linear Rec.709."""
_Row = tuple[float, float, float, float]
Matrix4 = Annotated[tuple[_Row, _Row, _Row, _Row], AfterValidator(_check_affine)]
"""Affine transform as four rows; the last is 0 0 0 1."""
IDENTITY4: Matrix4 = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def check_unique(what: str, items: Sequence[Any]) -> None:
    """Raise a ``ValueError`` that mentions ``what`` unless the ``name`` of every item is unique."""
    if len({item.name for item in items}) != len(items):
        raise ValueError(f"expected the names of {what} to be unique")


ModelT = TypeVar("ModelT", bound=BaseModel)
Location = tuple[int | str, ...]
"""Keys and indices from the root of a file to a field."""


# Bounded, since nested YAML aliases can make the repr of a small file exhaust the memory.
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 3, 120, 120


def _field_path(location: Location) -> str:
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else (f".{part}" if text else str(part))
    return text


def problems_of(where: str | Path | Callable[[Location], str], error: ValidationError) -> list[Problem]:
    """Convert pydantic's validation errors to problems.

    ``where``: the file, or a function from a field's location to a text such as ``FILE:LINE``.
    """
    problems = []
    for entry in error.errors(include_url=False):
        position = where(entry["loc"]) if callable(where) else where
        got = "" if entry["type"] == "missing" else _SHORT.repr(entry.get("input"))
        expected = entry["msg"].removeprefix("Value error, ")
        expected = expected[0].lower() + expected[1:]
        expected = expected.removeprefix("expected ").removeprefix("input should be ")
        if entry["loc"] == ("format",) and entry["type"] == "literal_error":
            # a file of another kind, whose further errors are meaningless
            return [
                Problem(position, "format", got, expected, "this is another kind of file; check the path")
            ]
        if entry["type"] == "extra_forbidden":
            expected, remedy = "no such key", "correct its spelling or remove it"
        elif entry["type"] == "model_type":
            expected, remedy = "keys and values", "check that this is the right file"
        elif entry["type"] == "missing":
            expected, remedy = "this key to be present", "add it"
        else:
            remedy = "correct the value"
        problems.append(Problem(position, _field_path(entry["loc"]), got, expected, remedy))
    return problems


def parse_model(model: type[ModelT], data: Any, where: str | Path) -> ModelT:
    """Validate plain data from ``where`` as a ``model``. Raises :class:`InputError` with all problems."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise InputError(*problems_of(where, error)) from None


def _read_text(path: Path) -> str:
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError
        if not stat.S_ISREG(status.st_mode):  # a pipe would block for ever, a device never ends
            raise InputError(Problem(path, "", "a pipe or a device", "a text file", "check the path"))
        if status.st_size > MAX_TEXT_BYTES:
            raise InputError(Problem(path, "", "a file of over 256 MB", "a text file", "check the path"))
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(Problem(path, "", "no such file", "a readable file", "check the path")) from None
    except IsADirectoryError:
        raise InputError(Problem(path, "", "a folder", "a file", "name a file in it")) from None
    except UnicodeDecodeError:
        raise InputError(Problem(path, "", "not text", "a UTF-8 text file", "check the path")) from None
    except OSError as error:
        got = (error.strerror or str(error)).lower()
        raise InputError(Problem(path, "", got, "a readable file", "check path and permissions")) from None


def read_json(model: type[ModelT], path: Path) -> ModelT:
    """Read a JSON file as a ``model``. Raises :class:`InputError` with every problem."""
    text = _read_text(path)
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(Problem(path, "", str(error), "valid JSON", "correct the file")) from None
    return parse_model(model, data, path)


def read_yaml(model: type[ModelT], path: Path) -> ModelT:
    """Read a YAML file as a ``model``. Raises :class:`InputError` with line and column of every problem."""
    text = _read_text(path)
    if len(text) > _MAX_YAML_BYTES:
        raise InputError(Problem(path, "", f"{len(text)} characters", "a YAML file of at most 512 kB"))
    try:
        data = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:  # ValueError: a date such as 2026-11-31
        where, got = syntax_error(path, error) if isinstance(error, yaml.YAMLError) else (path, str(error))
        raise InputError(Problem(where, "", got, "valid YAML", "correct the file")) from None
    try:
        return model.model_validate(data if data is not None else {})
    except ValidationError as error:
        raise InputError(*problems_of(YamlPlaces(path, text), error)) from None


def differences(old: Any, new: Any, field: str = "") -> list[tuple[str, str, str]]:
    """List the leaves that differ between two trees of plain data, as texts (field, old value, new value)."""
    if isinstance(old, dict) and isinstance(new, dict):
        found = []
        for key in dict.fromkeys((*old, *new)):
            name = f"{field}.{key}" if field else str(key)
            found += differences(old.get(key), new.get(key), name)
        return found
    are_lists = isinstance(old, list | tuple) and isinstance(new, list | tuple) and len(old) == len(new)
    if are_lists and any(isinstance(item, dict | list | tuple) for item in (*old, *new)):
        pairs = enumerate(zip(old, new, strict=True))
        return [entry for k, (a, b) in pairs for entry in differences(a, b, f"{field}[{k}]")]
    return [] if old == new else [(field, _brief(old), _brief(new))]


def _brief(value: Any) -> str:
    if value is None:
        return "nothing"
    return value if isinstance(value, str) else _SHORT.repr(value)


def canonical_json(data: BaseModel | dict[str, Any] | list[Any]) -> bytes:
    """Encode equal data as equal bytes: UTF-8 JSON with sorted keys, two-space indent and a final newline.

    Floats are written by ``repr``, which round-trips; NaN and Inf raise ``ValueError``.
    """
    value = data.model_dump(mode="json") if isinstance(data, BaseModel) else data
    text = json.dumps(value, sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False)
    return (text + "\n").encode()


def sha256_hex(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path) -> str:
    """SHA-256 of a file's content in hexadecimal, read in blocks."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):  # Python 3.10 has no hashlib.file_digest
            digest.update(block)
    return digest.hexdigest()


def write_bytes_atomically(path: Path, data: bytes, *, parents: bool = False) -> None:
    """Write a file atomically, even across a power failure: write, flush and rename a temporary file.

    ``parents``: create missing folders first.
    """
    if parents:
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        temporary.write_bytes(data)
        publish(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)  # errors of write and flush lack it
        raise


def quantized(value: float, digits: int = 9) -> float:
    """Round ``value`` to ``digits`` significant digits, for readable and reproducible files."""
    return float(f"{value:.{digits}g}") + 0.0  # turns -0.0 into 0.0


def matrix4(matrix: NDArray[np.float64]) -> Matrix4:
    """Round a (4, 4) affine matrix to 12 significant digits, with an exact last row 0 0 0 1."""
    rows = [tuple(quantized(float(x), 12) for x in row) for row in matrix[:3]]
    return cast(Matrix4, (*rows, (0.0, 0.0, 0.0, 1.0)))


def vector3(values: NDArray[Any] | list[float], digits: int = 9) -> Vector3:
    """Round three numbers to ``digits`` significant digits."""
    x, y, z = (quantized(float(v), digits) for v in values)
    return x, y, z
