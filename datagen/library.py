# SPDX-License-Identifier: MIT
"""Libraries: asset packages in folders, indexed by id, and summaries of their contents.

Opening a library reads only descriptions (``asset.json``), neither meshes nor images.
"""

from __future__ import annotations

import copy
import difflib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

from datagen.asset_check import CheckReport, check_package
from datagen.formats.asset import EnvironmentAsset, MaterialAsset, ObjectAsset, PanoramaAsset
from datagen.formats.base import canonical_json, sha256_hex
from datagen.formats.package import AnyAsset, Package, is_package, open_package
from datagen.foundation.bundled import bundled_library
from datagen.foundation.errors import InputError, Problem
from datagen.foundation.progress import Advance, no_advance

AssetKind = Literal["environment", "object", "material", "panorama"]
_MAX_DEPTH = 4  # depth of the search for packages below a library's root


def resolve_library_paths(names: Iterable[str], base: Path) -> tuple[Path, ...]:
    """Resolve the names of library folders: "bundled", absolute paths, or paths relative to ``base``.

    A path that does not exist below ``base`` is relative to the working directory.
    """
    resolved = []
    for name in names:
        if name == "bundled":
            resolved.append(bundled_library())
        else:
            path = Path(name).expanduser()
            below = base / path
            resolved.append((below if below.exists() else path).resolve())
    return tuple(resolved)


class Library:
    """Asset packages of one or more folders, indexed by id.

    ``paths`` are packages (folders or zip files), or folders that are searched for packages. Raises
    :class:`InputError` with all unreadable packages, duplicate ids and missing folders.
    """

    def __init__(self, paths: Iterable[str | Path]):
        self.paths = tuple(Path(p) for p in paths)
        self._packages: dict[str, Package] = {}
        problems: list[Problem] = []
        for package in _opened(_packages_of(self.paths, problems), problems):
            self._packages.setdefault(package.id, package)
        if problems:
            self.close()
            raise InputError(*problems)

    def __enter__(self) -> Library:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._packages)

    def __contains__(self, asset_id: object) -> bool:
        return asset_id in self._packages

    def __iter__(self) -> Iterator[Package]:
        """Yield the packages in the order of their ids."""
        return (self._packages[asset_id] for asset_id in sorted(self._packages))

    @cached_property
    def sha256(self) -> str:
        """SHA-256, in hexadecimal, of the content of all packages, independent of their paths."""
        return sha256_hex(canonical_json({package.id: package.sha256 for package in self}))

    def package(self, asset_id: str) -> Package:
        """Return the package with this id. Raises :class:`InputError`, with similar ids, if there is none."""
        if asset_id in self._packages:
            return self._packages[asset_id]
        near = difflib.get_close_matches(asset_id, self._packages, 3)
        hint = f"did you mean {', '.join(near)}?" if near else "add its folder with --library"
        where = ", ".join(str(p) for p in self.paths) or "empty library"
        raise InputError(Problem(where, "asset", repr(asset_id), "an asset of the library", hint))

    def including(self, package: Package) -> Library:
        """Return a copy of this library with ``package``, which replaces a package of the same id."""
        other = copy.copy(self)
        other._packages = {**self._packages, package.id: package}
        other.__dict__.pop("sha256", None)
        return other

    def root_of(self, package: Package) -> Path:
        """Return the element of :attr:`paths` in which a package was found."""
        return next(root for root in self.paths if package.path.is_relative_to(root))

    def select(self, kind: AssetKind, *, for_training: bool = True) -> list[Package]:
        """List a kind's packages, sorted by id; ``for_training`` omits those marked ``evaluation_only``."""
        return [
            package
            for package in self
            if package.asset.kind == kind
            and not (for_training and package.asset.provenance.usage == "evaluation_only")
        ]

    def categories(self, *, for_training: bool = True) -> list[str]:
        """List the objects' categories, sorted; ``for_training`` omits ``evaluation_only`` objects."""
        objects = self.select("object", for_training=for_training)
        return sorted({p.asset.category for p in objects if isinstance(p.asset, ObjectAsset)})

    def close(self) -> None:
        """Close every package."""
        for package in self._packages.values():
            package.close()


def find_packages(root: Path) -> list[Path]:
    """List the packages in a folder, up to four levels deep, sorted; names starting with '.' are skipped."""
    if is_package(root):
        return [root]
    found: list[Path] = []
    for folder, names, files in os.walk(root):
        here = Path(folder)
        names[:] = sorted(n for n in names if not n.startswith("."))
        if len(here.relative_to(root).parts) >= _MAX_DEPTH:
            names[:] = []
        packages = [n for n in names if (here / n / "asset.json").is_file()]
        found += [here / n for n in packages]
        names[:] = [n for n in names if n not in packages]
        zips = sorted(f for f in files if f.lower().endswith(".zip") and not f.startswith("."))
        found += [here / f for f in zips if is_package(here / f)]
    return sorted(found)


def _packages_of(roots: Iterable[Path], problems: list[Problem]) -> list[Path]:
    """List the packages' paths in all ``roots``; add missing folders and other files to ``problems``."""
    found: list[Path] = []
    for root in roots:
        if not root.exists():
            remedy = "check the path or import assets"
            problems.append(Problem(root, "", "no such folder", "a library folder", remedy))
        elif root.is_file() and not is_package(root):
            expected = "a library folder or a package"
            problems.append(Problem(root, "", "no asset package", expected, "check the path"))
        else:
            found += find_packages(root)
    return found


def _opened(paths: Iterable[Path], problems: list[Problem]) -> Iterator[Package]:
    """Yield the packages at ``paths``; add unreadable packages and duplicate ids to ``problems``."""
    seen: dict[str, Path] = {}
    for path in paths:
        try:
            package = open_package(path)
        except InputError as error:
            problems.extend(error.problems)
            continue
        first = seen.setdefault(package.id, path)
        if first.resolve() != path.resolve():
            expected = f"a unique id; {first} has the same"
            problems.append(Problem(path, "id", repr(package.id), expected, "rename one"))
        yield package


def asset_classes(asset: AnyAsset) -> tuple[str, ...]:
    """Return a material's classes, or the main classes of an object's or room's slots; () for a panorama."""
    if isinstance(asset, PanoramaAsset):
        return ()
    if isinstance(asset, MaterialAsset):
        return asset.material.classes
    return tuple(sorted({c for material in asset.materials.values() for c in material.classes[:1]}))


@dataclass(frozen=True)
class AssetSummary:
    """A row in the table of assets; ``detail``: category, classes, time of day, or counts of room content."""

    id: str
    kind: AssetKind
    title: str
    detail: str
    license: str
    author: str
    usage: str
    sha256: str
    path: Path


def summarize(package: Package, *, with_hash: bool = True) -> AssetSummary:
    """Summarise a package; its hash, which requires reading all files, is '' unless ``with_hash``."""
    asset = package.asset
    if isinstance(asset, ObjectAsset):
        detail = asset.category
    elif isinstance(asset, EnvironmentAsset):
        detail = (
            f"{len(asset.parts)} parts, {len(asset.support_surfaces)} supports, "
            f"{len(asset.light_slots)} light slots, "
            f"{len(asset.openings)} openings, {len(asset.cameras)} cameras"
        )
    elif isinstance(asset, PanoramaAsset):
        detail = asset.daytime
    else:
        detail = ", ".join(asset_classes(asset))
    provenance = asset.provenance
    return AssetSummary(
        asset.id,
        asset.kind,
        asset.title,
        detail,
        provenance.license,
        provenance.author,
        provenance.usage,
        package.sha256 if with_hash else "",
        package.path,
    )


def describe_library(paths: Iterable[str | Path], *, with_hash: bool = False) -> list[AssetSummary]:
    """Summarise all assets of the libraries ``paths``, ordered by kind, then id."""
    order = get_args(AssetKind)
    with Library(paths) as library:
        lines = [summarize(package, with_hash=with_hash) for package in library]
        return sorted(lines, key=lambda line: (order.index(line.kind), line.id))


def check_library(paths: Iterable[str | Path], progress: Advance = no_advance) -> CheckReport:
    """Report the faults of all packages, even unreadable ones; ``progress(done, total)`` counts packages."""
    errors: list[Problem] = []
    warnings: list[Problem] = []
    found = _packages_of(map(Path, paths), errors)

    def counted() -> Iterator[Path]:
        for number, path in enumerate(found):
            progress(number, len(found))
            yield path

    for package in _opened(counted(), errors):
        with package:
            report = check_package(package)
            errors.extend(report.errors)
            warnings.extend(report.warnings)
    progress(len(found), len(found))
    return CheckReport(tuple(errors), tuple(warnings), len(found))
