# SPDX-License-Identifier: MIT
"""Paths of the bundled data (library, recipes and suites) in a checkout or an installation.

The data is the repository's folder ``scenes/``, installed as ``datagen/scenes`` (setup.py).
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from datagen.foundation.errors import input_error

BundledKind = Literal["recipes", "suites"]


def bundled_folder() -> Path:
    """Return the folder of the bundled data. Raises :class:`InputError` if it does not exist."""
    installed, checkout = _candidates()
    if (installed / "library").is_dir():
        return installed
    if (checkout / "library").is_dir() and (checkout.parent / "pyproject.toml").is_file():
        return checkout
    remedy = "install the project again: pip install --force-reinstall --no-deps scene-materials"
    raise input_error(installed, "", "no such folder", "the bundled library, recipes and suites", remedy)


def _candidates() -> tuple[Path, Path]:
    """Return the folders of the bundled data in an installation and in a checkout, existing or not."""
    package = Path(__file__).resolve().parents[1]
    return package / "scenes", package.parent / "scenes"


def is_bundled(package: Path) -> bool:
    """Return whether the path of an asset package is inside the bundled library."""
    return any(package.resolve().is_relative_to((folder / "library").resolve()) for folder in _candidates())


def bundled_library() -> Path:
    """Return the folder of the bundled library; raises like :func:`bundled_folder`."""
    return bundled_folder() / "library"


def bundled_names(kind: BundledKind) -> list[str]:
    """Return the names of the bundled recipes or suites, sorted."""
    return sorted(path.stem for path in (bundled_folder() / kind).glob("*.yaml"))


def resolve_bundled(path: Path, kind: BundledKind) -> Path:
    """Return the path of the bundled recipe or suite named ``path`` or, if none has this name, ``path``.

    An existing file takes precedence over a bundled name; a folder does not, since ``datagen run smoke --out
    smoke`` creates one. Raises :class:`InputError` if ``path`` is neither a bundled name nor exists.
    """
    if path.is_file():
        return path
    names = bundled_names(kind)
    if str(path) in names:
        return bundled_folder() / kind / f"{path}.yaml"
    if path.exists():
        return path
    remedy = f"did you mean the bundled `{path.stem}`?" if path.stem in names else "check the path"
    expected = f"a file, or the name of a bundled file: {', '.join(names)}"
    raise input_error(path, "", "no such file", expected, remedy)


def object_package(name: str, folder: Path) -> Path:
    """Return the path of an object package named ``bundled:ID`` or by a path relative to ``folder``."""
    kind, _, asset_id = name.partition(":")
    return bundled_library() / "objects" / asset_id if kind == "bundled" else folder / name
