# SPDX-License-Identifier: MIT
"""The shape of the project: which package may import which, what start-up costs, licences, schemas."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

PACKAGES = ("datagen", "mitsuba_plugins", "model", "blender_addon")
FOUNDATION = "datagen.foundation"
BELOW_ALL = (FOUNDATION, "datagen.formats")
BELOW_ALL_MAY = {
    "numpy",
    "OpenEXR",
    "pydantic",
    "yaml",
    "PIL",
    "cv2",
    "matplotlib",
    "rich",
    "datagen",
    "typing_extensions",
}


def _sources() -> list[Path]:
    return [path for package in PACKAGES for path in sorted((REPOSITORY / package).rglob("*.py"))]


def _module(path: Path) -> str:
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imports(path: Path) -> set[str]:
    """Absolute names of every module that a file imports, anywhere in it, but for type checking."""
    tree = ast.parse(path.read_text())
    found: set[str] = set()
    skipped = {
        child
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for child in ast.walk(node)
    }
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module)
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def _violations(rule) -> list[str]:
    return [
        f"{_module(path)} imports {name}"
        for path in _sources()
        for name in sorted(_imports(path))
        if rule(_module(path), name)
    ]


def _is_in(name: str, *packages: str) -> bool:
    return any(name == p or name.startswith(p + ".") for p in packages)


def test_foundation_imports_nothing_above_it() -> None:
    standard = sys.stdlib_module_names

    def breaks(module: str, name: str) -> bool:
        if not _is_in(module, *BELOW_ALL):
            return False
        top = name.split(".")[0]
        if top == "datagen":
            floor = (FOUNDATION,) if _is_in(module, FOUNDATION) else BELOW_ALL
            return name != "datagen" and not _is_in(name, *floor)
        return top not in standard and top not in BELOW_ALL_MAY

    assert _violations(breaks) == []


@pytest.mark.parametrize(
    ("packages", "forbidden"),
    [
        (("mitsuba_plugins",), ("torch", "datagen.rendering", "datagen.assembly", "model", "bpy")),
        (("model.training",), ("mitsuba", "drjit", "bpy", "mitsuba_plugins")),
        (("datagen",), ("model", "torch", "bpy", "blender_addon")),
        (("blender_addon",), ("datagen", "model", "mitsuba_plugins", "torch", "mitsuba", "pydantic")),
        (("datagen.formats", "datagen.multiview", "datagen.assembly"), ("datagen.cli", "datagen.farm")),
    ],
)
def test_imports_run_one_way(packages: tuple[str, ...], forbidden: tuple[str, ...]) -> None:
    assert _violations(lambda module, name: _is_in(module, *packages) and _is_in(name, *forbidden)) == []


def test_plugins_stand_on_the_foundation() -> None:
    def breaks(module: str, name: str) -> bool:
        return _is_in(module, "mitsuba_plugins") and _is_in(name, "datagen") and not _is_in(name, FOUNDATION)

    assert [x for x in _violations(breaks) if not x.endswith(" imports datagen")] == []


def test_the_import_rule_can_fail() -> None:
    """The twin of the rules above: an import that exists is found."""
    found = _violations(
        lambda module, name: module == "datagen.foundation.exr" and name == "datagen.foundation.errors"
    )
    assert found == ["datagen.foundation.exr imports datagen.foundation.errors"]


@pytest.mark.parametrize("command", ["datagen.cli", "model.cli"])
def test_help_imports_nothing_heavy(command: str) -> None:
    code = (
        f"import sys; import {command}; "
        "print([m for m in ('mitsuba', 'drjit', 'torch', 'numpy', 'matplotlib', 'scipy', 'trimesh', 'cv2', "
        "'pydantic', 'OpenEXR') if m in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"


def test_every_source_names_its_licence() -> None:
    missing = []
    for folder in (*PACKAGES, "tests", "benchmarks", "scenes"):
        for path in sorted((REPOSITORY / folder).rglob("*.py")):
            text = path.read_text()
            line = next((x for x in text.splitlines()[:3] if "SPDX-License-Identifier:" in x), None)
            needs_gpl = any(_is_in(name, "bpy", "bmesh", "mathutils") for name in _imports(path))
            if line is None or (needs_gpl and "GPL-3.0-or-later" not in line):
                missing.append(str(path.relative_to(REPOSITORY)))
    assert missing == []


def test_schemas_in_the_docs_are_current() -> None:
    from datagen.formats.schemas import json_schemas

    for name, schema in json_schemas().items():
        path = REPOSITORY / "docs" / "schemas" / f"{name}.schema.json"
        assert json.loads(path.read_text()) == schema, f"{path.name} is stale: run `datagen schema`"
