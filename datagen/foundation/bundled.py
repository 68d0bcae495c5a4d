# SPDX-License-Identifier: MIT
"""Bundled data: library, recipes and a small suite, in a checkout or an installation.

The data is the repository's folder ``scenes/``, installed as ``datagen/scenes`` (setup.py).
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from datagen.foundation.errors import input_error

BundledKind = Literal["recipes", "suites"]


def bundled_folder() -> Path:
    """The folder of the bundled data. Raises :class:`InputError` if the installation lacks it."""
    installed, checkout = _places()
    if (installed / "library").is_dir():
        return installed
    if (checkout / "library").is_dir() and (checkout.parent / "pyproject.toml").is_file():
        return checkout
    remedy = "install the project again: pip install --force-reinstall --no-deps scene-materials"
    raise input_error(installed, "", "no such folder", "the bundled library, recipes and suites", remedy)


def _places() -> tuple[Path, Path]:
    """Candidate folders of the bundled data: in an installation and in a checkout."""
    package = Path(__file__).resolve().parents[1]
    return package / "scenes", package.parent / "scenes"


def is_bundled(package: Path) -> bool:
    """Whether an asset package is in the bundled library, installed or in a checkout."""
    return any(package.resolve().is_relative_to((place / "library").resolve()) for place in _places())


def bundled_library() -> Path:
    """Folder of the bundled library."""
    return bundled_folder() / "library"


def bundled_names(kind: BundledKind) -> list[str]:
    """Names of the bundled recipes or suites, sorted."""
    return sorted(path.stem for path in (bundled_folder() / kind).glob("*.yaml"))


def resolve_bundled(path: Path, kind: BundledKind) -> Path:
    """File that a command's argument names: ``path`` itself, or the bundled file with that name.

    Raises :class:`InputError` with the bundled names if it is neither.
    """
    if path.exists():
        return path
    names = bundled_names(kind)
    if str(path) in names:
        return bundled_folder() / kind / f"{path}.yaml"
    remedy = f"did you mean the bundled `{path.stem}`?" if path.stem in names else "check the path"
    expected = f"a file, or the name of a bundled file: {', '.join(names)}"
    raise input_error(path, "", "no such file", expected, remedy)


def object_package(name: str, folder: Path) -> Path:
    """Path of an object package; ``name`` is ``bundled:ID`` or a path relative to ``folder``."""
    kind, _, asset_id = name.partition(":")
    return bundled_library() / "objects" / asset_id if kind == "bundled" else folder / name
