# SPDX-License-Identifier: MIT
"""Import of files that Blender reads (FBX, USD, .blend, glTF with Draco).

Blender's module converts them to glTF in a separate process; the limits for glTF files apply to the result.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from datagen.formats.base import MAX_TEXT_BYTES
from datagen.foundation.errors import input_error
from datagen.foundation.findings import Findings
from datagen.importers.common import ImportedAsset, ImportOptions
from datagen.importers.gltf import import_gltf

BLENDER_SUFFIXES = (".fbx", ".usd", ".usda", ".usdc", ".usdz", ".blend")
_SECONDS = 900
_MARK = "to_gltf: "


def uses_draco(path: Path) -> bool:
    """True if a glTF file uses Draco and Blender's decoder is installed; False above ``MAX_TEXT_BYTES``."""
    if importlib.util.find_spec("bpy") is None or path.stat().st_size > MAX_TEXT_BYTES:
        return False
    with path.open("rb") as file:
        return b"KHR_draco_mesh_compression" in file.read()


def import_by_blender(
    path: Path, out_library: Path, options: ImportOptions, *, split: bool
) -> list[ImportedAsset]:
    """Import a file with Blender, write packages below ``out_library``, and return their records.

    Images outside the file's folder and ``options.allowed`` are omitted. Raises :class:`InputError` if
    Blender's module is not installed or cannot read the file, or if :func:`import_gltf` refuses the result.
    """
    if importlib.util.find_spec("bpy") is None:
        remedy = (
            "pip install 'scene-materials[blender]' (Python 3.11), or export glTF (.glb) from the program "
            "that made it"
        )
        raise input_error(path, "", "no module bpy", "Blender's module, which reads this format", remedy)
    findings = Findings()
    with tempfile.TemporaryDirectory() as folder:
        converted = Path(folder) / f"{path.stem}.glb"
        command = [sys.executable, "-m", "blender_addon.to_gltf", str(path.resolve()), str(converted)]
        command += [str(root.resolve()) for root in options.allowed]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS)
        except subprocess.TimeoutExpired:
            got = f"not read by Blender within {_SECONDS} s"
            raise input_error(path, got=got, expected="a smaller file", remedy="simplify it") from None
        lines = (done.stdout + "\n" + done.stderr).splitlines()
        messages = [line.removeprefix(_MARK) for line in lines if line.startswith(_MARK)]
        if done.returncode != 0 or not converted.is_file():
            last = [line for line in lines if line.strip()][-1:]
            got = "; ".join(messages or last or [f"exit code {done.returncode}"])[:400]
            remedy = "open it in Blender, or export glTF from the program that made it"
            raise input_error(path, got=f"Blender: {got}", expected="a file that it can read", remedy=remedy)
        for sentence in messages:
            findings.approximate(sentence)
        if path.suffix.lower() == ".blend":
            findings.note(
                f"{path.stem}: procedural materials are not converted; python -m blender_addon bakes them"
            )
        as_gltf = replace(options, up="y")  # the up axis of the converted file
        return import_gltf(converted, out_library, as_gltf, split=split, origin=path, findings=findings)
