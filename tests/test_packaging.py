# SPDX-License-Identifier: MIT
"""Installed packages: dependencies match the imports, and all data files are included.

``.ci/try_packages.py`` tests the built packages; these tests need no build.
"""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

from datagen.foundation.bundled import bundled_folder, bundled_names, object_package, resolve_bundled
from datagen.foundation.errors import InputError
from datagen.inspection.doctor import OPTIONAL, REQUIRED
from tests.conftest import REPOSITORY

if sys.version_info >= (3, 11):
    import tomllib
else:  # a dependency of pytest on these versions
    import tomli as tomllib

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
USER_EXTRAS = ("train", "heic", "raw", "gltf", "usd", "export", "blender")
PACKAGES = ("datagen", "mitsuba_plugins", "model", "blender_addon")
MODULES = {
    "opencv-contrib-python-headless": "cv2", "Pillow": "PIL", "PyYAML": "yaml", "python-fcl": "fcl",
    "scikit-image": "skimage", "fast-simplification": "fast_simplification", "pillow-heif": "pillow_heif",
    "opengl-basisu": "opengl_basisu", "usd-core": "pxr",
}  # fmt: skip
"""Import names that differ from the names of their distributions."""
BROUGHT_ALONG = {"drjit": "mitsuba", "mathutils": "bpy", "bpy_extras": "bpy"}
"""Modules installed by another distribution, which determines their version."""
PROVIDED = {"tensorboard": "torch.utils.tensorboard"}
"""Distributions that are imported only indirectly, and the module that imports each of them."""


def _names(requirements: list[str]) -> set[str]:
    return {re.split(r"[<>=!~;\[ ]", text)[0] for text in requirements}


def _imported() -> dict[str, str]:
    """Map the external modules that the packages import, by full and top-level name, to an importing file."""
    found: dict[str, str] = {}
    for package in PACKAGES:
        for path in sorted((REPOSITORY / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                names: list[str] = []
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                    names = [node.module]
                for name in names:
                    found.setdefault(name, str(path))
                    found.setdefault(name.split(".")[0], str(path))
    own = {*PACKAGES, *sys.stdlib_module_names}
    return {name: path for name, path in found.items() if name.split(".")[0] not in own}


def _module_of(distribution: str) -> str:
    return PROVIDED.get(distribution, MODULES.get(distribution, distribution))


def test_the_packages_import_every_dependency() -> None:
    """Only users' extras are checked: the others contain tools of tests, benchmarks and documentation."""
    imported = _imported()
    user_extras = [PROJECT["optional-dependencies"][extra] for extra in USER_EXTRAS]
    for distribution in _names([*PROJECT["dependencies"], *(r for extra in user_extras for r in extra)]):
        assert _module_of(distribution) in imported, f"nothing imports {distribution}"


def test_every_import_is_a_dependency() -> None:
    extras = PROJECT["optional-dependencies"]
    declared = _names([*PROJECT["dependencies"], *(r for e in USER_EXTRAS for r in extras[e])])
    modules = {_module_of(distribution).split(".")[0] for distribution in declared}
    for name, path in _imported().items():
        top = name.split(".")[0]
        assert BROUGHT_ALONG.get(top, top) in modules, f"{path} imports {name}, which no dependency brings"


def test_the_doctor_checks_the_requirements() -> None:
    assert set(REQUIRED) == _names(PROJECT["dependencies"]) | {"drjit"}
    for extra, (_, names) in OPTIONAL.items():
        assert set(names) <= _names(PROJECT["optional-dependencies"][extra])


def test_users_extras_pin_nothing() -> None:
    """Pins conflict with environments of other versions; constraints.txt has the tests' pins."""
    for extra in USER_EXTRAS:
        for requirement in PROJECT["optional-dependencies"][extra]:
            assert "==" not in requirement.split(";")[0], requirement
    assert not any("==" in requirement for requirement in PROJECT["dependencies"])
    pins = (REPOSITORY / "constraints.txt").read_text()
    assert re.search(r"^torch==[\d.]+$", pins, re.M)
    for script in ("Makefile", *(p.relative_to(REPOSITORY) for p in (REPOSITORY / ".ci").glob("*"))):
        path = REPOSITORY / script
        for line in path.read_text().splitlines() if path.is_file() else ():
            brings = re.search(r"(pip|\$\(PIP\)) .*(install|-e)", line) and "import" not in line
            assert not brings or "$(PIP)" in line or "--constraint" in line or "--no-deps" in line, line
    assert (
        "PIP := $(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt"
        in (REPOSITORY / "Makefile").read_text()
    )


def test_bundled_files_are_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert resolve_bundled(Path("smoke"), "recipes") == bundled_folder() / "recipes" / "smoke.yaml"
    assert resolve_bundled(Path("small"), "suites") == bundled_folder() / "suites" / "small.yaml"
    assert object_package("bundled:mug", tmp_path).is_dir()
    assert object_package("mug", tmp_path) == tmp_path / "mug"
    own = tmp_path / "smoke"
    own.mkdir()
    assert resolve_bundled(Path("smoke"), "recipes").is_file(), "`datagen run smoke --out smoke` continues"
    own.rmdir()
    own.touch()
    assert resolve_bundled(Path("smoke"), "recipes") == Path("smoke"), "a file of the user goes first"
    with pytest.raises(
        InputError, match=r"a file, or the name of a bundled file: .*demo.*smoke.*check the path"
    ):
        resolve_bundled(Path("smok"), "recipes")
    with pytest.raises(InputError, match="did you mean the bundled `smoke`"):
        resolve_bundled(Path("scenes/recipes/smoke.yaml"), "recipes")


def test_missing_data_files_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`datagen doctor` reports them too. Regression: it accepted a package without the library."""
    from datagen.foundation import bundled
    from datagen.inspection import doctor

    folder = tmp_path / "site-packages"
    (folder / "scenes" / "library").mkdir(parents=True)  # folders of another project
    monkeypatch.setattr(bundled, "__file__", str(folder / "datagen" / "foundation" / "bundled.py"))
    with pytest.raises(InputError, match="install the project again"):
        bundled_folder()
    finding = doctor.bundled_finding()
    assert finding.is_required and not finding.is_fine and "no such folder" in finding.value
    (folder / "datagen" / "scenes" / "library").mkdir(parents=True)
    assert bundled_folder() == folder / "datagen" / "scenes"
    assert not doctor.bundled_finding().is_fine, "an empty library is none"
    assert bundled_names("recipes") == []


def test_the_doctor_prints_the_extra_of_a_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    """The brackets of an extra must be escaped, because Rich interprets square brackets as styles."""
    from datagen.inspection.doctor import Finding, print_report

    remedy = "pip install 'scene-materials[train]'"
    print_report([Finding("torch", "not installed", False, False, remedy)])
    assert remedy in capsys.readouterr().out


def test_the_doctor_names_a_command_per_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from datagen.inspection import doctor

    monkeypatch.setenv("PATH", str(tmp_path))
    for title, program in doctor.PROGRAMS.items():
        finding = doctor.program_finding(title, *program)
        assert not finding.is_fine and not finding.is_required
        assert re.search(r"apt-get install|https://", finding.remedy), finding
    for system, command in (("darwin", "brew install colmap"), ("win32", "see the web site of COLMAP")):
        monkeypatch.setattr(doctor.sys, "platform", system)
        assert doctor.program_finding("COLMAP", *doctor.PROGRAMS["COLMAP"]).remedy.endswith(command)


@pytest.mark.parametrize(("version", "is_fine"), [("3.4.1", False), ("4.5.0", True), ("5.0.1", True)])
def test_the_doctor_detects_an_old_blender(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, is_fine: bool
) -> None:
    from datagen.inspection import doctor

    program = tmp_path / "blender"
    program.write_text(f"#!/bin/sh\necho Blender {version}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    finding = doctor.program_finding("Blender", *doctor.PROGRAMS["Blender"])
    assert finding.is_fine == is_fine and bool(finding.remedy) != is_fine


def test_the_doctor_detects_absent_checkpoints(monkeypatch: pytest.MonkeyPatch) -> None:
    from datagen.inspection import doctor

    assert doctor.checkpoint_finding().is_fine
    monkeypatch.setattr(doctor, "CHECKPOINTS", ("small.safetensors", "large.safetensors"))
    assert doctor.checkpoint_finding().value == "missing: large.safetensors"
