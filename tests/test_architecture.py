# SPDX-License-Identifier: MIT
"""Architecture: allowed imports between packages, start-up cost, licences and schemas."""

from __future__ import annotations

import ast
import functools
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

PACKAGES = ("datagen", "mitsuba_plugins", "model", "blender_addon")
SOURCES = (*PACKAGES, "oracles", "benchmarks", "tests", "scenes/sources")

_GROUND = "datagen.foundation datagen.formats"
_LIBRARY = f"{_GROUND} datagen.library"
_TRACED = "datagen.multiview.compiled datagen.geometry mitsuba_plugins.arrays"
_RENDER = f"{_LIBRARY} datagen.multiview datagen.rendering mitsuba_plugins"
_NETWORKS = "model.networks model.own_network model.confidence"
_ATLAS = "model.reconstruction.atlas datagen.geometry"

# Package -> modules or whole packages of the project that it may import in addition to itself.
MATRIX = {
    package: frozenset(allowed.split())
    for package, allowed in {
        "datagen.foundation": "",
        "datagen.formats": "datagen.foundation",
        "datagen.asset_check": _GROUND,
        "datagen.library": f"{_GROUND} datagen.asset_check",
        "datagen.multiview": "datagen.foundation mitsuba_plugins",
        "datagen.geometry": f"{_GROUND} datagen.multiview mitsuba_plugins",
        "datagen.light": f"datagen.foundation {_TRACED} mitsuba_plugins",
        "datagen.parametric": _GROUND,
        "datagen.assembly": f"{_LIBRARY} datagen.parametric mitsuba_plugins",
        "datagen.rendering": f"{_LIBRARY} mitsuba_plugins",
        "datagen.importers": f"{_GROUND} datagen.asset_check mitsuba_plugins",
        "datagen.farm": f"{_RENDER} datagen.assembly datagen.geometry datagen.light",
        "datagen.inspection": f"{_RENDER} datagen.farm",
        "datagen.tradeoff": f"{_RENDER} datagen.farm",
        "datagen.exports": f"{_LIBRARY} datagen.farm.folder",
        "datagen.run_command": f"{_LIBRARY} datagen.farm datagen.inspection",
        "datagen.cli": "datagen.foundation datagen.exports datagen.farm datagen.importers datagen.inspection "
        "datagen.run_command",
        "datagen.__main__": "datagen.cli",
        "mitsuba_plugins": "datagen.foundation",
        "blender_addon": "",
        "model.devices": "datagen.foundation",
        "model.shading": "",
        "model.networks": _GROUND,
        "model.bilateral_solver": "datagen.formats",
        "model.confidence": "model.bilateral_solver",
        "model.checkpoint": f"{_GROUND} {_NETWORKS} model.bilateral_solver",
        "model.loading": _GROUND,
        "model.named_code": "",
        "model.own_network": "datagen.foundation model.named_code model.networks",
        "model.events": "datagen.foundation model.named_code",
        "model.publish": "datagen.foundation model.checkpoint",
        "model.training": f"{_GROUND} {_NETWORKS} model.bilateral_solver model.checkpoint model.events "
        "model.shading",
        "model.reconstruction.captures": f"{_LIBRARY} datagen.farm.folder datagen.rendering.capture_geometry",
        "model.reconstruction.atlas": "datagen.foundation datagen.multiview.compiled",
        "model.reconstruction.check": f"{_GROUND} mitsuba_plugins datagen.geometry "
        "model.reconstruction.captures",
        "model.reconstruction.found_lights": "",
        "model.reconstruction.stages": "datagen.foundation datagen.geometry "
        "model.reconstruction.infer_options model.reconstruction.found_lights",
        "model.reconstruction.predict": f"{_GROUND} datagen.multiview datagen.geometry datagen.light "
        f"{_NETWORKS} model.checkpoint model.devices model.reconstruction.infer_options "
        "model.reconstruction.stages",
        "model.reconstruction.albedo_level": "datagen.foundation datagen.geometry datagen.light "
        "model.reconstruction.radiometry model.reconstruction.stages",
        "model.reconstruction.light": f"{_GROUND} {_TRACED} datagen.light model.reconstruction.found_lights "
        "model.reconstruction.stages model.reconstruction.radiometry",
        "model.reconstruction.radiometry": "datagen.foundation datagen.geometry datagen.light "
        "model.reconstruction.stages",
        "model.reconstruction.unwrap": f"datagen.foundation datagen.multiview.compiled {_ATLAS}",
        "model.reconstruction.mesh": f"{_GROUND} {_TRACED} model.reconstruction.stages",
        "model.reconstruction.merge": f"datagen.foundation datagen.multiview {_ATLAS} "
        "mitsuba_plugins.arrays model.reconstruction.unwrap",
        "model.reconstruction.export": f"{_GROUND} {_ATLAS} mitsuba_plugins "
        "model.reconstruction.found_lights",
        "model.reconstruction.report_page": "datagen.foundation model.reconstruction.found_lights "
        "model.reconstruction.infer_options model.reconstruction.stages",
        "model.reconstruction.atlas_page": f"{_GROUND} model.reconstruction.export",
        "model.reconstruction.render": f"{_LIBRARY} datagen.rendering model.reconstruction.atlas_page",
        "model.reconstruction.infer_options": "datagen.foundation model.reconstruction.merge "
        "model.reconstruction.found_lights",
        "model.reconstruction.infer": f"{_GROUND} datagen.multiview mitsuba_plugins {_ATLAS} "
        "model.reconstruction.check model.reconstruction.albedo_level model.reconstruction.light "
        "model.reconstruction.radiometry model.reconstruction.unwrap model.reconstruction.merge "
        "model.reconstruction.export model.reconstruction.infer_options model.reconstruction.poses "
        "model.reconstruction.mesh model.reconstruction.report_page model.reconstruction.stages",
        "model.reconstruction.poses": "datagen.foundation datagen.geometry model.reconstruction.stages",
        "model.reconstruction.photos": f"{_GROUND} datagen.multiview.compiled model.reconstruction.captures "
        "model.reconstruction.infer model.reconstruction.infer_options model.reconstruction.render "
        "model.reconstruction.stages",
        "model.reconstruction.commands": "datagen.foundation datagen.library model.checkpoint model.events "
        "model.reconstruction",
        "model.evaluation": f"{_LIBRARY} datagen.assembly datagen.farm datagen.geometry datagen.importers "
        "datagen.rendering mitsuba_plugins model.own_network model.checkpoint model.training "
        "model.reconstruction",
        "model.schemas": f"{_GROUND} model.evaluation model.training",
        "model.cli": "datagen.foundation model",
        "oracles": _RENDER,
        "benchmarks": "datagen mitsuba_plugins model blender_addon oracles",
        "scenes": f"{_GROUND} blender_addon",
        "tests": "datagen mitsuba_plugins model blender_addon oracles",
        "tests.benchmarks": "datagen model oracles benchmarks tests",
    }.items()
}
FORBIDDEN = {
    "datagen": ("torch", "bpy"),
    "mitsuba_plugins": ("torch", "bpy"),
    "model.training": ("mitsuba", "drjit", "bpy"),
    "blender_addon": ("torch", "mitsuba", "pydantic"),
}
"""Third-party packages that packages of the project must not import."""
GROUND_MAY = {
    "numpy", "OpenEXR", "pydantic", "yaml", "PIL", "cv2", "matplotlib", "rich", "typer", "psutil",
    "meshopt", "opengl_basisu",  # decoders of glTF, imported on demand
}  # fmt: skip
"""Third-party modules that ``datagen.foundation`` and ``datagen.formats`` may import."""


def _sources() -> list[Path]:
    return [path for folder in SOURCES for path in sorted((REPOSITORY / folder).rglob("*.py"))]


def _module(path: Path) -> str:
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def _modules() -> frozenset[str]:
    return frozenset(_module(path) for path in _sources())


@dataclass(frozen=True)
class _Source:
    """A parsed file. ``imports`` are the absolute names of modules that it imports, except for type checking;
    ``froms`` are line, module and names of each ``from`` import; ``names`` are all names that it binds."""

    imports: frozenset[str]
    froms: tuple[tuple[int, str, tuple[str, ...]], ...]
    names: frozenset[str]


def _statements(tree: ast.Module) -> Iterator[tuple[ast.AST, bool]]:
    """Yield each statement of a module, including those in functions, and whether it is for type checking."""
    left: list[tuple[ast.AST, bool]] = [(tree, False)]
    while left:
        node, is_typing = left.pop()
        yield node, is_typing
        is_typing |= isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            left += [(child, is_typing) for child in getattr(node, field, ())]


@functools.cache
def _source(path: Path) -> _Source:
    imports: set[str] = set()
    froms: list[tuple[int, str, tuple[str, ...]]] = []
    bound: set[str] = set()
    for node, is_typing in _statements(ast.parse(path.read_text(encoding="utf-8"))):
        named: set[str] = set()
        if isinstance(node, ast.Import):
            named = {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names = tuple(alias.name for alias in node.names)
            froms.append((node.lineno, node.module, names))
            named = {f"{node.module}.{name}" for name in names} & _modules() or {node.module}
        imports |= set() if is_typing else named
        if isinstance(node, ast.Import | ast.ImportFrom):
            bound |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            bound.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            bound |= {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}
    return _Source(frozenset(imports), tuple(froms), frozenset(bound))


def _imports(path: Path) -> frozenset[str]:
    return _source(path).imports


def _names_of(module: str) -> frozenset[str]:
    """Names that a module of the project binds."""
    path = REPOSITORY.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return _source(file).names if file.is_file() else frozenset()


def _is_in(name: str, *packages: str) -> bool:
    return any(name == p or name.startswith(p + ".") for p in packages)


def _row(module: str, matrix: dict[str, frozenset[str]]) -> str | None:
    """The most specific package of the matrix that contains a module, or None."""
    return max((package for package in matrix if _is_in(module, package)), key=len, default=None)


def _outside(matrix: dict[str, frozenset[str]]) -> list[str]:
    """Imports between the project's modules that the matrix does not allow, and modules without a row."""
    found = []
    for path in _sources():
        module, names = _module(path), _imports(path)
        if module in ("datagen", "model", "model.reconstruction", "scenes"):
            continue  # contains only a docstring
        package = _row(module, matrix)
        if package is None:
            found.append(f"{module} has no row in the matrix")
            continue
        found += [
            f"{module} imports {name}"
            for name in sorted(names & _modules())
            if not _is_in(name, package, *matrix[package])
        ]
    return found


def _rows_of(allowed: frozenset[str]) -> set[str]:
    return {package for package in MATRIX if any(_is_in(package, a) or _is_in(a, package) for a in allowed)}


def test_every_import_is_in_the_matrix() -> None:
    assert _outside(MATRIX) == []


@pytest.mark.parametrize(
    ("package", "withdrawn"),
    [
        ("datagen.formats", "datagen.foundation"),
        ("mitsuba_plugins", "datagen.foundation"),
        ("model.reconstruction.merge", "model.reconstruction.unwrap"),
        ("model.evaluation", "datagen.importers"),
        ("benchmarks", "model"),
    ],
)
def test_the_matrix_can_fail(package: str, withdrawn: str) -> None:
    """Injected fault: if a permission in use is withdrawn, exactly the imports that need it are reported."""
    found = _outside({**MATRIX, package: MATRIX[package] - {withdrawn}})
    assert found
    for line in found:
        importer, imported = line.split(" imports ")
        assert _is_in(importer, package) and _is_in(imported, withdrawn), line


def test_every_permission_is_used() -> None:
    unused = {(package, name) for package, allowed in MATRIX.items() for name in allowed}
    for path in _sources():
        package = _row(_module(path), MATRIX)
        for name in _imports(path):
            unused -= {(package, a) for p, a in unused if p == package and _is_in(name, a)}
    assert unused == set()


def test_modules_import_each_other_in_no_circle() -> None:
    """``static_order`` raises CycleError for a cycle; imports within functions count."""
    imported = {_module(path): _imports(path) & _modules() for path in _sources()}
    assert set(TopologicalSorter(imported).static_order()) == _modules()
    module, (name, *_) = next((m, sorted(names)) for m, names in imported.items() if names)
    with pytest.raises(CycleError):
        list(TopologicalSorter({**imported, name: {module}}).static_order())


def test_a_package_without_a_row_is_found() -> None:
    found = _outside({package: allowed for package, allowed in MATRIX.items() if package != "datagen.farm"})
    assert "datagen.farm.folder has no row in the matrix" in found


def test_the_matrix_has_no_cycle() -> None:
    """Packages can be ordered such that each imports only earlier ones. Top-level commands are exempt, and so
    are rows that allow whole packages."""
    left = {package: _rows_of(allowed) - {package} for package, allowed in MATRIX.items()}
    for command in ("model.cli", "model.reconstruction.commands"):
        left.pop(command)  # at the top: no package imports it
    for package in ("benchmarks", "tests", "tests.benchmarks", "model.evaluation"):
        left[package] = set()
    while left:
        ready = {package for package, above in left.items() if not above & left.keys()}
        assert ready, f"a circle among {sorted(left)}"
        for package in ready:
            del left[package]


def test_every_imported_name_exists() -> None:
    """Imports within functions are included, since they may never run in a test."""
    missing = []
    for path in _sources():
        for line, module, names in _source(path).froms:
            if not _is_in(module, "datagen", "model", "mitsuba_plugins", "benchmarks", "oracles", "tests"):
                continue
            missing += [
                f"{_module(path)}:{line}: {module}.{name}"
                for name in names
                if f"{module}.{name}" not in _modules() and name not in _names_of(module)
            ]
    assert missing == []


def _private(tree: ast.Module) -> list[str]:
    """Private members that code accesses as attributes, by import, or by name in ``setattr`` or ``patch``."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) not in ("self", "cls", "os"):
            found.append(node.attr)
        elif isinstance(node, ast.ImportFrom):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.Call) and re.search("(tr|patch|object)$", ast.unparse(node.func)):
            found += [str(a.value).split(".")[-1] for a in node.args if isinstance(a, ast.Constant)]
    return [name for name in found if re.match("_(?!_|replace$|asdict$|fields$)", name)]


def test_tests_access_no_private_member() -> None:
    paths = sorted((REPOSITORY / "tests").rglob("*.py"))
    found = {_module(path): _private(ast.parse(path.read_text(encoding="utf-8"))) for path in paths}
    assert {module: names for module, names in found.items() if names} == {}


@pytest.mark.parametrize(
    "code",
    [
        "module._name",
        "self.thing._name()",
        "from module import _name",
        "monkeypatch.setattr(module, '_name', 1)",
        "mock.patch('module._name')",
    ],
)
def test_a_private_member_is_found(code: str) -> None:
    assert _private(ast.parse(code)) == ["_name"]


def test_the_foundation_has_few_dependencies() -> None:
    found = [
        f"{_module(path)} imports {name}"
        for path in _sources()
        for name in sorted(_imports(path))
        if _is_in(_module(path), "datagen.foundation", "datagen.formats")
        and name.split(".")[0] not in sys.stdlib_module_names | GROUND_MAY | {"datagen", "typing_extensions"}
    ]
    assert found == []


@pytest.mark.parametrize("package", FORBIDDEN)
def test_packages_import_nothing_forbidden(package: str) -> None:
    found = [
        f"{_module(path)} imports {name}"
        for path in _sources()
        for name in sorted(_imports(path))
        if _is_in(_module(path), package) and _is_in(name, *FORBIDDEN[package])
    ]
    assert found == []


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
    for folder in (*PACKAGES, "oracles", "tests", "benchmarks", "scenes"):
        for path in sorted((REPOSITORY / folder).rglob("*.py")):
            text = path.read_text()
            line = next((x for x in text.splitlines()[:3] if "SPDX-License-Identifier:" in x), None)
            needs_gpl = any(_is_in(name, "bpy", "bmesh", "mathutils") for name in _imports(path))
            if line is None or (needs_gpl and "GPL-3.0-or-later" not in line):
                missing.append(str(path.relative_to(REPOSITORY)))
    assert missing == []


def test_schemas_in_the_docs_are_current() -> None:
    from datagen.formats.schemas import json_schemas
    from model.schemas import json_schemas as schemas_of_model

    for name, schema in {**json_schemas(), **schemas_of_model()}.items():
        path = REPOSITORY / "docs" / "schemas" / f"{name}.schema.json"
        assert json.loads(path.read_text()) == schema, (
            f"{path.name} is stale: python -m datagen.formats.schemas; python -m model.schemas"
        )
