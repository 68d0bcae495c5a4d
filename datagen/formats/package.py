# SPDX-License-Identifier: MIT
"""Asset packages as containers: a folder or a zip with ``asset.json`` and the files that it names.

Opening a package reads ``asset.json`` and checks that the named files exist; pixels and vertices are checked
by ``datagen.asset_check``. Zips are read in place, never unpacked completely; links, devices, encrypted
members, zip bombs and members with paths outside the package are refused.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from datagen.formats.asset import (
    ASSET_FILE,
    MATERIAL_CHANNELS,
    EnvironmentAsset,
    Material,
    MaterialAsset,
    ObjectAsset,
    PanoramaAsset,
    Texture,
)
from datagen.formats.base import MAX_TEXT_BYTES, ModelT, canonical_json, parse_model, sha256_file, sha256_hex
from datagen.formats.lights import EnvironmentLight
from datagen.foundation.budget import Budget
from datagen.foundation.documents import ZIP_ERRORS, check_archive
from datagen.foundation.durable import publish
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from datagen.foundation.images import IMAGE_SUFFIXES
from datagen.foundation.paths import fault_of

AnyAsset = MaterialAsset | ObjectAsset | EnvironmentAsset | PanoramaAsset
_MODELS: dict[str, type[AnyAsset]] = {
    "material": MaterialAsset,
    "object": ObjectAsset,
    "environment": EnvironmentAsset,
    "panorama": PanoramaAsset,
}
ZIP_SUFFIX = ".zip"
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)  # the earliest time of the zip format; constant for deterministic bytes
_MESH_SUFFIXES = (".ply",)


@dataclass(repr=False, eq=False)
class Package:
    """An opened asset package, from :func:`open_package`; use it as a context manager if zipped.

    ``asset`` is the validated ``asset.json``, ``path`` the folder or zip. Names of files in it are
    '/'-separated relative paths.
    """

    path: Path
    asset: AnyAsset
    _data: Any
    _archive: zipfile.ZipFile | None
    _prefix: str
    _unpacked: Path | None = None

    def __enter__(self) -> Package:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Package({self.asset.kind} {self.asset.id!r} at {self.path})"

    @property
    def id(self) -> str:
        return self.asset.id

    def as_kind(self, kind: type[ModelT]) -> ModelT:
        """Return the asset, narrowed to the type ``kind``; the caller guarantees that it has this type."""
        assert isinstance(self.asset, kind)
        return self.asset

    def names(self) -> tuple[str, ...]:
        """Return the names of the files to which ``asset.json`` refers, sorted."""
        return tuple(sorted({name for _, name in referenced_files(self.asset)}))

    def local_file(self, name: str) -> Path:
        """Return the path on disk of a file; a file unpacked from a zip exists until :meth:`close`.

        Raises :class:`InputError` if the zip's member cannot be read.
        """
        if self._archive is None:
            return self.path / name
        if self._unpacked is None:
            self._unpacked = Path(tempfile.mkdtemp(prefix="asset-"))
        target = self._unpacked / name
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            partial = target.with_name(f".{target.name}.partial")
            try:
                with self._archive.open(self._prefix + name) as source, partial.open("wb") as sink:
                    shutil.copyfileobj(source, sink, 1 << 20)
            except (KeyError, *ZIP_ERRORS) as error:
                partial.unlink(missing_ok=True)
                raise self._unreadable(name, error) from None
            partial.replace(target)
        return target

    def read_bytes(self, name: str) -> bytes:
        """Read a file of the package. Raises :class:`InputError` if it cannot be read."""
        try:
            if self._archive is None:
                return (self.path / name).read_bytes()
            return self._archive.read(self._prefix + name)
        except (KeyError, *ZIP_ERRORS) as error:
            raise self._unreadable(name, error) from None

    def _unreadable(self, name: str, error: Exception) -> InputError:
        return input_error(self.path, name, str(error), "a readable file", "make the package again")

    @cached_property
    def sha256(self) -> str:
        """SHA-256, in hexadecimal, of the content of ``asset.json`` and of every file that it names.

        A folder and its zip have the same hash, independent of the layout of the JSON and of other files.
        """
        lines = [f"{sha256_hex(canonical_json(self._data))}  {ASSET_FILE}\n"]
        for name in self.names():
            if self._archive is None:
                digest = sha256_file(self.path / name)
            else:
                digest = sha256_hex(self.read_bytes(name))
            lines.append(f"{digest}  {name}\n")
        return sha256_hex("".join(lines).encode())

    def close(self) -> None:
        """Close the zip and remove unpacked files; do nothing for a folder or a closed package."""
        if self._unpacked is not None:
            shutil.rmtree(self._unpacked, ignore_errors=True)
            self._unpacked = None
        if self._archive is not None:
            self._archive.close()


def referenced_files(asset: AnyAsset) -> list[tuple[str, str]]:
    """List the files to which an asset refers, as pairs (field, file name) in a fixed order."""
    if isinstance(asset, PanoramaAsset):
        return [("image", asset.image)]
    if isinstance(asset, MaterialAsset):
        return _texture_files("material", asset.material)
    found = [file for name, m in asset.materials.items() for file in _texture_files(f"materials.{name}", m)]
    found += [(f"parts[{k}].mesh", part.mesh) for k, part in enumerate(asset.parts)]
    for k, light in enumerate(asset.lights):
        if isinstance(light, EnvironmentLight) and light.image is not None and light.asset is None:
            found.append((f"lights[{k}].image", light.image))
    return found


def _texture_files(prefix: str, material: Material) -> list[tuple[str, str]]:
    channels = ((channel, getattr(material, channel)) for channel in MATERIAL_CHANNELS)
    return [(f"{prefix}.{c}.texture", value.texture) for c, value in channels if isinstance(value, Texture)]


def open_package(path: str | Path, budget: Budget | None = None) -> Package:
    """Open an asset package: a folder, a zip, or the ``asset.json`` inside a folder.

    ``budget``: the budget of the enclosing import, if any. Checks the schema and that every named file is
    present, inside the package and of a known format. Raises :class:`InputError` with all problems.
    """
    path = Path(path)
    if path.name == ASSET_FILE:
        path = path.parent
    if path.is_dir():
        return _open_folder(path)
    if path.is_file():
        return _open_zip(path, budget)
    raise input_error(
        path, "", "no such file or folder", "an asset package (folder or zip)", "check the path"
    )


def is_package(path: Path) -> bool:
    """Return whether a path is a folder with ``asset.json``, or a zip with one at its root or in a folder."""
    if path.is_dir():
        return (path / ASSET_FILE).is_file()
    if path.suffix.lower() != ZIP_SUFFIX or not path.is_file():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return _find_prefix(archive.namelist()) is not None
    except ZIP_ERRORS:
        return False


def _parse(data: bytes, where: str) -> tuple[AnyAsset, Any]:
    if len(data) > MAX_TEXT_BYTES:
        raise input_error(where, got="over 256 MB", expected="an asset description")
    try:
        value = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise input_error(where, "", str(error)[:200], "valid JSON", "correct the file") from None
    kind = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in _MODELS:
        raise input_error(where, "kind", repr(kind), f"one of {', '.join(_MODELS)}", "re-export the asset")
    return parse_model(_MODELS[kind], value, where), value


def _format_problems(asset: AnyAsset, where: str) -> list[Problem]:
    problems = []
    for field, name in referenced_files(asset):
        suffixes = _MESH_SUFFIXES if field.endswith(".mesh") else IMAGE_SUFFIXES
        if not name.lower().endswith(suffixes):
            expected = f"a file ending in {' or '.join(suffixes)}"
            problems.append(Problem(where, field, repr(name), expected, "convert the file"))
    return problems


def _open_folder(folder: Path) -> Package:
    description = folder / ASSET_FILE
    if not description.is_file():
        raise input_error(folder, "", f"no {ASSET_FILE}", "an asset package", "check the path")
    if description.is_symlink():
        raise input_error(description, "", "a symbolic link", "a regular file", "copy the file")
    asset, data = _parse(description.read_bytes(), str(description))
    problems = _format_problems(asset, str(description))
    for field, name in referenced_files(asset):
        fault = _folder_fault(folder, name)
        if fault:
            expected = "a regular file in the package"
            problems.append(Problem(description, field, f"{name!r} ({fault})", expected, "restore it"))
    raise_problems(problems)
    return Package(folder, asset, data, None, "")


def _folder_fault(folder: Path, name: str) -> str:
    """Return the reason to refuse a file of a package folder; '' if it is a regular file without links."""
    real, fault = fault_of(folder, name)
    if real is None:
        return fault
    if real != folder.resolve() / name.replace("\\", "/"):
        return "a symbolic link"
    return "" if real.is_file() else "no such file"


def _find_prefix(names: list[str]) -> str | None:
    """Return the prefix of asset.json in a zip ('' or 'folder/'), or None unless exactly one exists."""
    hits = [n for n in names if n == ASSET_FILE or (n.endswith("/" + ASSET_FILE) and n.count("/") == 1)]
    return hits[0].removesuffix(ASSET_FILE) if len(hits) == 1 else None


def _open_zip(path: Path, budget: Budget | None) -> Package:
    try:
        archive = zipfile.ZipFile(path)
    except ZIP_ERRORS as error:
        raise input_error(path, got=str(error), expected="an asset package (folder or zip)") from None
    try:
        check_archive(archive, path, budget or Budget(path))
        members = {i.filename for i in archive.infolist() if not i.is_dir()}
        prefix = _find_prefix(sorted(members))
        if prefix is None:
            raise input_error(path, got=f"no single {ASSET_FILE}", expected="an asset package")
        where = f"{path}/{ASSET_FILE}"
        asset, data = _parse(archive.read(prefix + ASSET_FILE), where)
        problems = _format_problems(asset, where)
        for field, name in referenced_files(asset):
            if prefix + name not in members:
                got = f"{name!r} (no such file)"
                problems.append(Problem(where, field, got, "a file in the package", "make the package again"))
        raise_problems(problems)
    except BaseException as error:
        archive.close()
        if isinstance(error, InputError) or not isinstance(error, ZIP_ERRORS):
            raise
        raise input_error(path, got=str(error), expected="an intact zip", remedy="copy it again") from None
    return Package(path, asset, data, archive, prefix)


FileSource = bytes | Path


def package_in_memory(asset: AnyAsset, files: Mapping[str, bytes]) -> tuple[bytes, Package]:
    """Zip an asset and its files in memory; return the zip's bytes and the package opened from them.

    Equal content produces equal bytes. Raises :class:`InputError` if a file that the asset names is missing.
    """
    sink = io.BytesIO()
    _write_zip(sink, {ASSET_FILE: canonical_json(asset), **files})
    data = sink.getvalue()
    archive = zipfile.ZipFile(io.BytesIO(data))
    where = Path(f"{asset.id}{ZIP_SUFFIX}")
    parsed, value = _parse(archive.read(ASSET_FILE), str(where))
    missing = sorted({name for _, name in referenced_files(parsed)} - set(files))
    if missing:
        raise input_error(where, "files", ", ".join(missing), "every file that the asset names", "add them")
    return data, Package(where, parsed, value, archive, "")


def write_package(
    path: str | Path,
    asset: AnyAsset,
    files: Mapping[str, FileSource],
    *,
    overwrite: bool = False,
    validate: Callable[[Package], None] | None = None,
) -> Package:
    """Write a package atomically and open it. If the path ends in ``.zip``, the package is a zip.

    ``files`` maps names inside the package to bytes or to files on disk; it must contain every file that the
    asset names and may contain more (a licence text, a preview). ``validate`` is called with the package
    before it gets its final path, and may raise an error, so that nothing is written. Equal content produces
    equal zip bytes. Raises :class:`InputError` if ``path`` exists and ``overwrite`` is not set, or if a named
    file is missing from ``files``.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise input_error(path, "", "exists already", "a new path", "remove it or overwrite it")
    problems = [
        Problem(path, field, repr(name), "a file of the package", "add it")
        for field, name in referenced_files(asset)
        if name not in files
    ]
    for name in files:
        if name.startswith("/") or ":" in name or any(p in ("", ".", "..") for p in name.split("/")):
            problems.append(Problem(path, "files", repr(name), "a relative path inside the package"))
    if ASSET_FILE in files:
        problems.append(Problem(path, "files", ASSET_FILE, "no file of this name", "rename it"))
    raise_problems(problems)
    path.parent.mkdir(parents=True, exist_ok=True)
    content: dict[str, FileSource] = {ASSET_FILE: canonical_json(asset), **files}
    partial = path.with_name(
        f".{path.name}.{os.getpid()}.partial{ZIP_SUFFIX if path.suffix == ZIP_SUFFIX else ''}"
    )
    _remove(partial)
    try:
        (_write_zip if path.suffix == ZIP_SUFFIX else _write_folder)(partial, content)
        with open_package(partial) as package:
            if validate is not None:
                validate(package)
        _replace(partial, path)
    except BaseException as error:
        _remove(partial)
        if isinstance(error, InputError):  # the message must name the final path, not the temporary one
            final = [replace(p, where=str(p.where).replace(str(partial), str(path))) for p in error.problems]
            raise InputError(*final) from None
        if isinstance(error, OSError):
            expected, remedy = "free space and permission to write", "free space or choose another folder"
            raise input_error(path, got=str(error), expected=expected, remedy=remedy) from None
        raise
    return open_package(path)


def _write_folder(folder: Path, content: Mapping[str, FileSource]) -> None:
    folder.mkdir()
    for name in sorted(content):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        source = content[name]
        file = io.BytesIO(source) if isinstance(source, bytes) else source.open("rb")
        with file, target.open("wb") as sink:
            shutil.copyfileobj(file, sink, 1 << 20)


def _write_zip(target: Path | io.BytesIO, content: Mapping[str, FileSource]) -> None:
    with zipfile.ZipFile(target, "w") as archive:
        for name in sorted(content):
            info = zipfile.ZipInfo(name, _ZIP_TIME)
            info.external_attr = (stat.S_IFREG | 0o644) << 16
            info.create_system = 3  # Unix: otherwise the field depends on the system that writes the zip
            # images are compressed already
            stored = name.lower().endswith(IMAGE_SUFFIXES)
            info.compress_type = zipfile.ZIP_STORED if stored else zipfile.ZIP_DEFLATED
            source = content[name]
            with archive.open(info, "w", force_zip64=True) as sink:
                file = io.BytesIO(source) if isinstance(source, bytes) else source.open("rb")
                with file:
                    shutil.copyfileobj(file, sink, 1 << 20)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _replace(partial: Path, path: Path) -> None:
    """Rename ``partial`` to ``path``; an existing folder, which a rename cannot replace, is removed."""
    if path.is_dir() and not path.is_symlink():
        old = path.with_name(f".{path.name}.{os.getpid()}.old")
        _remove(old)
        path.rename(old)
        try:
            publish(partial, path)
        except BaseException:
            old.rename(path)
            raise
        _remove(old)
    else:
        publish(partial, path)
