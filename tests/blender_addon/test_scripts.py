# SPDX-License-Identifier: GPL-3.0-or-later
"""Untrusted .blend files: none of their code is run, and the exporter exits when it is done."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

LEAVES_WITHIN_S = 10.0

_MAKE = """
import os, sys
import bpy
folder = sys.argv[1]
bpy.ops.wm.read_factory_settings(use_empty=False)
driver = bpy.data.objects["Cube"].driver_add("location", 0).driver
driver.type = "SCRIPTED"
driver.expression = f'__import__("os").system("touch {folder}/driver") + 1.0'
text = bpy.data.texts.new("autorun.py")
text.write(f"open({folder + '/autorun'!r}, 'w').close()\\nimport threading, time\\n"
           "threading.Thread(target=time.sleep, args=(600,)).start()\\n")
text.use_module = True
bpy.ops.wm.save_as_mainfile(filepath=folder + "/scripts.blend")
sys.stdout.flush()
os._exit(0)
"""
_WITH_SCRIPTS_ALLOWED = """
import sys
import bpy
bpy.context.preferences.filepaths.use_scripts_auto_execute = True
from blender_addon.command import leave, main
leave(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def blend(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("bpy", reason="needs Blender's module")
    folder = tmp_path_factory.mktemp("stranger")
    subprocess.run([sys.executable, "-c", _MAKE, str(folder)], check=True, capture_output=True, timeout=300)
    return folder / "scripts.blend"


def _export(blend: Path, out: Path, *words: str, allowed: bool = False) -> tuple[int, str, float]:
    """Run the exporter; return its exit code, its output, and the seconds from its last line to its exit."""
    start = ["-c", _WITH_SCRIPTS_ALLOWED] if allowed else ["-m", "blender_addon"]
    log = out.with_suffix(".log")
    with log.open("wb") as sink:
        process = subprocess.Popen(
            [sys.executable, *start, str(blend), "--out", str(out), *words],
            cwd=REPOSITORY,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY), "TMPDIR": str(blend.parent)},
            stdout=sink,
            stderr=subprocess.STDOUT,
        )
    output, last = "", time.monotonic()
    try:
        while process.poll() is None and time.monotonic() - last < (
            LEAVES_WITHIN_S if "note:" in output else 300
        ):
            time.sleep(0.1)
            if (now := log.read_text()) != output and "note:" not in output:
                output, last = now, time.monotonic()
        seconds = time.monotonic() - last
    finally:
        process.kill()
        code = process.wait()
    return code, log.read_text(), seconds


@pytest.mark.parametrize("allowed", [False, True], ids=["as it is", "preferences allow scripts"])
@pytest.mark.parametrize("words", [(), ("--license", "CC0-1.0", "--check")], ids=["exported", "checked"])
def test_no_code_of_the_file_runs_and_the_exporter_exits(
    blend: Path, tmp_path: Path, words: tuple[str, ...], allowed: bool
) -> None:
    code, output, seconds = _export(blend, tmp_path / "out", *words, allowed=allowed)
    assert seconds < LEAVES_WITHIN_S, output
    assert code == 2 and "'Cube': drivers need Python, which is not run: location[0]" in output, output
    assert ("has no licence" in output) == (not words)
    assert sorted(path.name for path in blend.parent.iterdir()) == ["scripts.blend"], (
        "nothing ran, nothing left"
    )
