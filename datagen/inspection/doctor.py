# SPDX-License-Identifier: MIT
"""Checks the installation and prints the findings as a table: ``datagen doctor``."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from datagen.foundation.bundled import bundled_library, bundled_names
from datagen.foundation.errors import InputError
from datagen.library import find_packages
from datagen.rendering.denoiser import OPTIX_WEIGHTS, uses_optix
from mitsuba_plugins.variant import CPU_VARIANT, CUDA_VARIANT, REMEDY, choose_llvm, has_cuda, resolve_variant

REQUIRED = (
    "mitsuba", "drjit", "numpy", "scipy", "OpenEXR", "pyoidn", "embreex", "python-fcl", "pydantic", "typer",
    "rich", "PyYAML", "Pillow", "opencv-contrib-python-headless", "matplotlib", "xatlas", "numba", "psutil",
)  # fmt: skip
"""Python distributions required by the project, and Dr.Jit, which Mitsuba requires."""
OPTIONAL = {
    "train": ("training and inference", ("torch", "safetensors", "tensorboard")),
    "heic": ("photographs in HEIC", ("pillow-heif",)),
    "raw": ("raw photographs", ("rawpy",)),
    "gltf": ("glTF with meshopt or Basis Universal", ("meshopt", "opengl-basisu")),
    "usd": ("assets in USD", ("usd-core",)),
    "export": ("exports to Hypersim's layout", ("h5py",)),
    "blender": ("the exporter, FBX and USD, and UVs where xatlas fails (Python 3.11)", ("bpy",)),
    "notebook": ("the notebook in the tutorials", ("ipykernel", "nbclient")),
}
"""Optional extras of the project by name: purpose, and the distributions that they install."""
PROGRAMS = {
    "COLMAP": ("colmap", "cameras and meshes of your own photographs", "colmap"),
    "Slurm": ("sbatch", "`datagen farm submit` on a cluster, where it is installed", "slurm-client"),
    "PBS": ("qsub", "`datagen farm submit --engine pbs` on a cluster, where it is installed", ""),
    "Blender": ("blender", "the add-on in Blender's window (4.5 or later)", ""),
}
"""Optional programs by title: command, purpose and Debian package ('' if none)."""
MIN_BLENDER = (4, 5)
CHECKPOINTS = ("small.safetensors", "light.safetensors", "no-rp.safetensors")
_AGAIN = "install the project again: pip install --force-reinstall scene-materials, or -e . in a checkout"
MIN_FREE_GB = 2.0
_RENDER_PROBE = """
from mitsuba_plugins.variant import select_variant
select_variant()
import mitsuba as mi
import numpy as np
image = np.array(mi.render(mi.load_dict(mi.cornell_box()), spp=1))
assert np.isfinite(image).all() and image.mean() > 0
print(mi.variant())
"""
_DENOISER_PROBE = """
import numpy as np, pyoidn
noisy = np.random.default_rng(0).random((32, 32, 3), dtype=np.float32)
assert np.asarray(pyoidn.denoise(noisy, hdr=True)).std() < noisy.std()
"""


@dataclass(frozen=True)
class Finding:
    """A row of the report: a component, its version or state, and the remedy if the state is not fine."""

    name: str
    value: str
    is_fine: bool
    is_required: bool
    remedy: str = ""


def _probe(name: str, code: str, remedy: str) -> Finding:
    """Run ``code`` in a separate process, since native code may abort."""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    if result.returncode == 0:
        output = result.stdout.strip()
        return Finding(name, f"works ({output})" if output else "works", True, True)
    lines = [line for line in result.stderr.strip().splitlines() if line.strip()]
    last = lines[-1] if lines else f"exit code {result.returncode}"
    return Finding(name, last, False, True, remedy)


def examine() -> list[Finding]:
    """Examine the installation, and the free disk space of the current folder."""
    is_supported = sys.version_info >= (3, 10)
    findings = [Finding("Python", sys.version.split()[0], is_supported, True, "install Python 3.11")]
    findings.append(bundled_finding())
    findings += [_package(name, True, _AGAIN) for name in REQUIRED]
    for extra, (purpose, names) in OPTIONAL.items():
        remedy = f"for {purpose}: pip install 'scene-materials[{extra}]'"
        findings += [_package(name, False, remedy) for name in names]
    findings.append(checkpoint_finding())
    findings += [program_finding(title, *details) for title, details in PROGRAMS.items()]
    variant = _tried("variant", resolve_variant, True)
    findings += [variant, _tried("LLVM", _llvm, variant.value == CPU_VARIANT), gpu_finding()]
    findings.append(Finding("processors", str(os.cpu_count()), True, False))
    if all(f.is_fine for f in findings if f.is_required):
        findings.append(_probe("rendering", _RENDER_PROBE, f"see the message; if it concerns LLVM, {REMEDY}"))
        findings.append(_probe("denoiser", _DENOISER_PROBE, _AGAIN))
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    remedy = f"free {MIN_FREE_GB} GB, or choose another disk with --out"
    return [*findings, Finding("free disk", f"{free_gb:.1f} GB", free_gb >= MIN_FREE_GB, True, remedy)]


def _tried(name: str, look_up: Callable[[], str], is_required: bool) -> Finding:
    """Return the result of ``look_up``, or the :class:`InputError` that it raises, as a finding."""
    try:
        return Finding(name, look_up(), True, is_required)
    except InputError as error:
        (problem,) = error.problems
        found = f"{problem.got}; expected {problem.expected}"
        return Finding(name, found, False, is_required, problem.remedy)


def _llvm() -> str:
    llvm = choose_llvm()
    return f"{llvm.major} ({llvm.path})"


def bundled_finding() -> Finding:
    """Check whether the bundled library, recipes and suites are installed."""
    try:
        num = len(find_packages(bundled_library()))
        names = bundled_names("recipes")
        value = f"{num} assets, {len(names)} recipes, {len(bundled_names('suites'))} suites"
        return Finding("bundled library", value, num > 0 and bool(names), True, _AGAIN)
    except InputError as error:
        problem = error.problems[0]
        return Finding("bundled library", f"{problem.where}: {problem.got}", False, True, _AGAIN)


def checkpoint_finding() -> Finding:
    """Check whether the default networks of `materials infer` are installed, without importing ``model``."""
    package = importlib.util.find_spec("model")
    folders = [Path(p) / "checkpoints" for p in (package.submodule_search_locations or ())] if package else []
    lacking = [name for name in CHECKPOINTS if not any((folder / name).is_file() for folder in folders)]
    value = f"missing: {', '.join(lacking)}" if lacking else ", ".join(CHECKPOINTS)
    return Finding("bundled checkpoints", value, not lacking, False, _AGAIN)


def program_finding(title: str, command: str, purpose: str, debian: str) -> Finding:
    """Check whether a program is on the search path and, for Blender, recent enough."""
    path, remedy = shutil.which(command), f"for {purpose}: {_installing(title, debian)}"
    if path is None:
        return Finding(title, f"no {command}", False, False, remedy)
    if title == "Blender":
        found = re.search(r"Blender (\d+)\.(\d+)", _output_of([path, "--version"]))
        if found is None or (int(found[1]), int(found[2])) < MIN_BLENDER:
            return Finding(title, f"{found[0] if found else 'no version'} ({path})", False, False, remedy)
    return Finding(title, path, True, False)


def _output_of(command: list[str]) -> str:
    """Standard output of a program; '' if it is missing, cannot be executed, or takes over a minute."""
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=60).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ""


def _installing(title: str, debian: str) -> str:
    """The command that installs a program on this system, or the address of its web site."""
    commands = {
        "darwin": {"COLMAP": "brew install colmap", "Blender": "brew install --cask blender"},
        "win32": {"Blender": "winget install BlenderFoundation.Blender"},
    }
    elsewhere = {"Blender": "https://www.blender.org/download/lts/", "PBS": "https://openpbs.org"}
    if debian and sys.platform not in commands:
        return f"apt-get install {debian}"
    return commands.get(sys.platform, {}).get(title) or elsewhere.get(title, f"see the web site of {title}")


def _package(name: str, is_required: bool, remedy: str) -> Finding:
    try:
        return Finding(name, version(name), True, is_required)
    except PackageNotFoundError:
        return Finding(name, "not installed", False, is_required, remedy)


def gpu_finding() -> Finding:
    """Check for an NVIDIA GPU whose driver includes the OptiX denoiser."""
    if not has_cuda():
        return Finding("GPU", "none; rendering runs on the CPU", True, False)
    command = ["nvidia-smi", "--query-gpu=name,memory.total", "--format=csv,noheader"]
    found = "; ".join(_output_of(command).strip().splitlines()) or "NVIDIA driver found"
    if not uses_optix(CUDA_VARIANT):
        found += f"; OIDN denoises on the CPU, as {OPTIX_WEIGHTS} is missing"
        return Finding("GPU", found, False, False, "in a container, set NVIDIA_DRIVER_CAPABILITIES=all")
    return Finding("GPU", found, True, False)


def print_report(findings: list[Finding]) -> None:
    """Print the findings as a table."""
    from rich.table import Column, Table
    from rich.text import Text

    from datagen.foundation.progress import table_console

    table = Table(Column("what", overflow="fold"), Column("found", overflow="fold"), "", "remedy")
    for finding in findings:
        if finding.is_fine:
            mark, remedy = Text("ok", "green"), ""
        else:
            mark = Text("missing", "red") if finding.is_required else Text("optional", "yellow")
            remedy = finding.remedy
        table.add_row(finding.name, finding.value, mark, remedy)
    table_console().print(table)
