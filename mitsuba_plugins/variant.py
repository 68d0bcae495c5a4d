# SPDX-License-Identifier: MIT
"""Choice of the Mitsuba variant and its LLVM library, once per process.

With LLVM 14 to 16, Mitsuba aborts the whole process ("Cannot select: fminimum"), which no exception handler
can catch. The newest library is therefore chosen *before* mitsuba is imported, and an error that states the
remedy is raised if it is too old.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from datagen.foundation.errors import input_error

MIN_LLVM_MAJOR = 19
CPU_VARIANT = "llvm_ad_rgb"
CUDA_VARIANT = "cuda_ad_rgb"
VARIANTS = (CPU_VARIANT, CUDA_VARIANT)
_LIBRARY_NAME = re.compile(r"libLLVM(?:-|\.so\.)(\d+)(?:\.\d+)*(?:\.so)?(?:\.\d+)*$")
_UNVERSIONED_NAMES = ("libLLVM.dylib", "LLVM-C.dll")
"""File names without a version (macOS, Windows); such a library is loaded to query its version."""
SEARCH_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm/lib",
    "/usr/local/opt/llvm/lib",
    "C:/Program Files/LLVM/bin",
)
_COMMANDS = {"darwin": "macOS: brew install llvm", "win32": "Windows: winget install LLVM.LLVM"}
REMEDY = (
    f"install LLVM 19 or later ({_COMMANDS.get(sys.platform, 'Debian/Ubuntu: apt-get install libllvm19')}), "
    "or point DRJIT_LIBLLVM_PATH at its libLLVM shared library"
)


@dataclass(frozen=True)
class LlvmLibrary:
    """A shared LLVM library: its path and major version."""

    path: Path
    major: int


def find_llvm_libraries() -> list[LlvmLibrary]:
    """List the shared LLVM libraries in the usual folders of all platforms, newest first."""
    found: dict[Path, LlvmLibrary] = {}
    folders = [Path(f) for f in SEARCH_FOLDERS] + sorted(Path("/usr/lib").glob("llvm-*/lib"))
    for folder in folders:
        for path in sorted(p for pattern in ("libLLVM*", "LLVM-C.dll") for p in folder.glob(pattern)):
            match = _LIBRARY_NAME.match(path.name)
            major = int(match[1]) if match else None
            if path.name in _UNVERSIONED_NAMES:
                major = llvm_major(path)
            if major is not None:
                real = path.resolve()
                found.setdefault(real, LlvmLibrary(real, major))
    return sorted(found.values(), key=lambda lib: (-lib.major, str(lib.path)))


def llvm_major(path: Path) -> int | None:
    """Return the major version of a library, or None if it cannot be loaded or is older than LLVM 16."""
    try:
        library = ctypes.CDLL(str(path))
        get_version = library.LLVMGetVersion  # since LLVM 16
    except (OSError, AttributeError):
        return None
    major, minor, patch = ctypes.c_uint(), ctypes.c_uint(), ctypes.c_uint()
    get_version(ctypes.byref(major), ctypes.byref(minor), ctypes.byref(patch))
    return major.value


def choose_llvm() -> LlvmLibrary:
    """Return the LLVM library for Mitsuba: ``DRJIT_LIBLLVM_PATH`` if set, else the newest one found.

    Raises :class:`InputError` if it is missing or older than LLVM 19.
    """
    override = os.environ.get("DRJIT_LIBLLVM_PATH")
    if override:
        path = Path(override)
        major = llvm_major(path)
        if major is None or major < MIN_LLVM_MAJOR:
            got = "no loadable LLVM of 16 or later" if major is None else f"LLVM {major}"
            expected = f"LLVM {MIN_LLVM_MAJOR} or later"
            raise input_error("LLVM", "DRJIT_LIBLLVM_PATH", f"{override}, {got}", expected, REMEDY)
        return LlvmLibrary(path, major)
    libraries = find_llvm_libraries()
    if libraries and libraries[0].major >= MIN_LLVM_MAJOR:
        return libraries[0]
    have = ", ".join(f"{lib.major} ({lib.path})" for lib in libraries) or "none"
    raise input_error("LLVM", "", f"found {have}", f"{MIN_LLVM_MAJOR} or later", REMEDY)


def has_cuda() -> bool:
    """Return whether the NVIDIA driver reports a GPU, without importing mitsuba."""
    if shutil.which("nvidia-smi") is None and not Path("/dev/nvidia0").exists():
        return False
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0


def resolve_variant(name: str | None = None) -> str:
    """Return the variant that :func:`select_variant` would choose if none is active.

    Does not import mitsuba. Raises :class:`InputError` for an unsupported name.
    """
    name = None if name == "auto" else name
    name = name or os.environ.get("SCENE_MATERIALS_VARIANT") or (CUDA_VARIANT if has_cuda() else CPU_VARIANT)
    if name not in VARIANTS:
        remedy = "unset SCENE_MATERIALS_VARIANT, or correct the name"
        raise input_error("variant", "", repr(name), f"one of {', '.join(VARIANTS)}", remedy)
    return name


def check_variant(name: str | None = None) -> None:
    """Check variant and LLVM as :func:`select_variant` does, but without importing mitsuba."""
    if resolve_variant(name) == CPU_VARIANT:
        choose_llvm()


def select_variant(name: str | None = None) -> str:
    """Set the Mitsuba variant of this process and return its name. Repeated calls are cheap.

    ``name`` is one of :data:`VARIANTS`. None and ``auto`` choose the active variant, else the value of the
    environment variable ``SCENE_MATERIALS_VARIANT``, else CUDA if there is a GPU, else LLVM. Raises
    ``RuntimeError`` if another variant is active, and :class:`InputError` if the name is unsupported or LLVM
    is missing or too old.
    """
    if "mitsuba" in sys.modules:
        import mitsuba as mi

        active = mi.variant()
        if active is not None:
            if name not in (None, "auto", active):
                raise RuntimeError(
                    f"variant {active} is already active in this process; expected {name}; "
                    "use one variant per process"
                )
            return active
    name = resolve_variant(name)
    if name == CPU_VARIANT:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(choose_llvm().path)
    import mitsuba as mi

    mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Warn)
    return name
