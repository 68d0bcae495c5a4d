# SPDX-License-Identifier: MIT
"""Reader of Sweet Home 3D catalogues (.sh3f): zips of models and ``PluginFurnitureCatalog.properties``.

Property ``width#12`` is the width of the twelfth piece. Sizes are in centimetres: width along the model's x,
height along y, depth along z. ``modelRotation`` is a row-major 3 x 3 matrix that rotates the model.
"""

from __future__ import annotations

import math
import re
import zipfile
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.budget import Budget
from datagen.foundation.documents import ZIP_ERRORS, check_archive
from datagen.foundation.errors import InputError, Problems, input_error, raise_problems

CATALOGUE_FILE = "PluginFurnitureCatalog.properties"
MAX_SIDE_CM = 20_000.0  # longer sides indicate a wrong unit
_KEY = re.compile(r"(?P<name>[A-Za-z]+)#(?P<number>\d+)$")
_ESCAPE = re.compile(r"\\(u[0-9a-fA-F]{4}|.)", re.S)
_LICENSES = (
    (re.compile(r"publicdomain/zero|choose/zero|\bCC[ -]?0\b|Creative Commons Zero", re.I), "CC0-1.0"),
    (re.compile(r"licenses/by/3\.0/us|Attribution 3\.0 United States", re.I), "CC-BY-3.0-US"),
    (
        re.compile(r"licenses/by/(?P<v>[234]\.0)(?!/us)|Attribution (?P<w>[234]\.0)(?! United)", re.I),
        "CC-BY-",
    ),
    (re.compile(r"Free Art License|Licence Art Libre", re.I), "LAL-1.3"),
)
_HOLDER = re.compile(r"(?:Copyright\s*)?(?:©|\(C\))\s*(?:Copyrights?\s*)?(?P<holder>[^\n]+)", re.I)


@dataclass(frozen=True)
class Piece:
    """An entry of a catalogue. ``size_m``: width, depth, height; ``rotation``: (3, 3) or None.

    ``elevation_m``: height above the floor; a piece with a positive elevation hangs.
    """

    id: str
    name: str
    model: str
    size_m: tuple[float, float, float]
    category: str = ""
    tags: tuple[str, ...] = ()
    elevation_m: float = 0.0
    rotation: NDArray[np.float64] | None = None
    is_door_or_window: bool = False
    is_light: bool = False
    is_stairs: bool = False
    creator: str = ""
    license: str = ""


@dataclass(frozen=True)
class Origin:
    """Provenance of a catalogue: its id, provider, SPDX licence and rights holder; '' if unknown."""

    id: str = ""
    provider: str = ""
    license: str = ""
    holder: str = ""


@dataclass
class Catalogue:
    """An open catalogue; ``problems``: errors of invalid entries, by piece id or name."""

    path: Path
    archive: zipfile.ZipFile
    origin: Origin
    pieces: list[Piece] = field(default_factory=list)
    problems: dict[str, InputError] = field(default_factory=dict)
    _folders: dict[PurePosixPath, dict[str, str]] | None = None

    def __enter__(self) -> Catalogue:
        return self

    def __exit__(self, *_: object) -> None:
        self.archive.close()

    def read(self, member: str) -> bytes:
        """Return a member's content. Raises :class:`InputError` if it is missing or damaged."""
        where = f"{self.path}/{member}"
        try:
            return self.archive.read(member)
        except KeyError:
            raise input_error(
                where, got="no such file in the catalogue", expected="the model", remedy="export it again"
            ) from None
        except ZIP_ERRORS as error:
            raise input_error(where, "", str(error), "a readable file", "copy it again") from None

    def beside(self, model: str) -> dict[str, str]:
        """Return the archive members in a model's folder, by lower-case base name."""
        if self._folders is None:
            self._folders = {}
            for name in self.archive.namelist():
                path = PurePosixPath(name)
                if not name.endswith("/"):
                    self._folders.setdefault(path.parent, {})[path.name.lower()] = name
        return self._folders.get(PurePosixPath(model).parent, {})

    def size_in_archive(self, member: str) -> int:
        """Return the compressed size of a member in bytes; 0 if it is missing."""
        try:
            return self.archive.getinfo(member).compress_size
        except KeyError:
            return 0


def open_catalogue(path: Path, budget: Budget) -> Catalogue:
    """Open a .sh3f file and read its pieces; ``budget`` applies to the whole file.

    Raises :class:`InputError` if it is not a catalogue.
    """
    expected = f"a Sweet Home 3D furniture library: a zip that contains {CATALOGUE_FILE}"
    try:
        archive = zipfile.ZipFile(path)
    except ZIP_ERRORS as error:
        raise input_error(path, got=str(error), expected=expected, remedy="copy it again") from None
    try:
        check_archive(archive, path, budget)
        if CATALOGUE_FILE not in archive.namelist():
            raise input_error(path, got=f"no {CATALOGUE_FILE}", expected=expected, remedy="check the file")
        catalogue = Catalogue(path, archive, Origin())
        table = parse_properties(catalogue.read(CATALOGUE_FILE))
        licence_text = "".join(
            catalogue.read(n).decode("utf-8", "replace")[:4000]
            for n in archive.namelist()
            if "/" not in n and n.lower().startswith("license")
        )
        catalogue.origin = _origin(table, licence_text)
        _read_pieces(catalogue, table)
    except BaseException:
        archive.close()
        raise
    return catalogue


def parse_properties(data: bytes) -> dict[str, str]:
    """Parse a Java properties file, including comments, continuation lines and escapes, to a dictionary.

    The text is decoded as UTF-8 if valid, else as ISO 8859-1, as in Java.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    table: dict[str, str] = {}
    pending = ""
    for raw in text.splitlines():
        line = pending + raw.lstrip(" \t\f")
        if not pending and (not line or line[0] in "#!"):
            continue
        if (len(line) - len(line.rstrip("\\"))) % 2:
            pending = line[:-1]
            continue
        pending = ""
        match = re.match(r"((?:\\.|[^\\=:\s])*)\s*[=:]?\s*(.*)", line, re.S)
        assert match is not None  # the pattern matches every line, since all its parts may be empty
        table[_unescaped(match[1])] = _unescaped(match[2]).strip()
    return table


def _unescaped(text: str) -> str:
    def value(match: re.Match[str]) -> str:
        body = match[1]
        if len(body) == 5:
            return chr(int(body[1:], 16))
        return {"t": "\t", "n": "\n", "r": "\r", "f": "\f"}.get(body, body)

    return _ESCAPE.sub(value, text)


def spdx_license(text: str) -> str:
    """Return the SPDX identifier of the licence that a text names; '' if it names none or several."""
    found = set()
    for pattern, name in _LICENSES:
        for match in pattern.finditer(text):
            groups = match.groupdict()
            version = groups.get("v") or groups.get("w") or ""
            found.add(name + version)
    return found.pop() if len(found) == 1 else ""


def _origin(table: dict[str, str], licence_text: str) -> Origin:
    stated = table.get("license", "")
    holder = _HOLDER.search(stated)
    return Origin(
        id=table.get("id", ""),
        provider=table.get("provider", ""),
        license=spdx_license(stated) or spdx_license(licence_text),
        holder=holder["holder"].strip() if holder else "",
    )


def _read_pieces(catalogue: Catalogue, table: dict[str, str]) -> None:
    entries: dict[int, dict[str, str]] = {}
    for key, value in table.items():
        match = _KEY.match(key)
        if match:
            entries.setdefault(int(match["number"]), {})[match["name"]] = value
    for number in sorted(entries):
        entry = entries[number]
        label = entry.get("id") or entry.get("name") or f"#{number}"
        try:
            catalogue.pieces.append(_piece(entry, label, catalogue.path))
        except InputError as error:
            catalogue.problems[label] = error
    if not entries:
        raise input_error(catalogue.path, got="no pieces", expected="entries such as name#1 and model#1")


def _piece(entry: dict[str, str], label: str, path: Path) -> Piece:
    problems = Problems(f"{path}: {label}")

    def number(key: str, low: float, fallback: float | None = None) -> float:
        text = entry.get(key, "")
        if not text and fallback is not None:
            return fallback
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= MAX_SIDE_CM or (low == 0 and value == 0 and fallback is None):
            expected = f"centimetres up to {MAX_SIDE_CM:g}"
            problems.add(key, repr(text), expected, "correct the catalogue")
        return round(value / 100, 9)

    size = (number("width", 0), number("depth", 0), number("height", 0))
    elevation = number("elevation", -MAX_SIDE_CM, 0.0)
    model = entry.get("model", "").lstrip("/")
    if not model or ".." in PurePosixPath(model).parts:
        problems.add("model", repr(model), "the path of a model in the catalogue", "add it")
    elif not model.lower().endswith(".obj"):
        problems.add("model", repr(model), "a Wavefront OBJ model", "convert it in Sweet Home 3D")
    rotation = None
    if entry.get("modelRotation"):
        try:
            rotation = np.array([float(x) for x in entry["modelRotation"].split()]).reshape(3, 3)
        except ValueError:
            rotation = np.full((3, 3), np.nan)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=0.01):
            got = repr(entry["modelRotation"])
            problems.add("modelRotation", got, "the nine numbers of a rotation matrix", "correct it")
    raise_problems(problems)
    return Piece(
        id=label,
        name=entry.get("name") or label,
        model=model,
        size_m=size,
        category=entry.get("category", ""),
        tags=tuple(t.strip() for t in entry.get("tags", "").split(",") if t.strip()),
        elevation_m=elevation,
        rotation=rotation,
        is_door_or_window=entry.get("doorOrWindow", "") == "true",
        is_light="lightSourceX" in entry,
        is_stairs="staircaseCutOutShape" in entry,
        creator=entry.get("creator", ""),
        license=spdx_license(entry.get("license", "")),
    )
