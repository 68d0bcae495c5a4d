# SPDX-License-Identifier: GPL-3.0-or-later
"""A Blender that is too old is refused, with the version required, before anything is read or written."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.bpy


@pytest.mark.parametrize(("oldest", "is_refused"), [((99, 0), True), ((4, 5), False)])
def test_an_old_blender_is_refused(
    tmp_path: Path, run_module: Callable[..., Any], oldest: tuple[int, int], is_refused: bool
) -> None:
    outcome = run_module("tests.blender_addon.test_version", str(tmp_path), *map(str, oldest))
    assert [("expected 99.0 or later" in text) for text in outcome["messages"]] == [is_refused] * 3
    assert outcome["remedies"] == is_refused
    assert (tmp_path / "cube" / "asset.json").is_file() is not is_refused


def _say(folder: Path, oldest: tuple[int, int]) -> dict[str, Any]:
    import bpy

    from blender_addon import version
    from blender_addon.export import check, export
    from blender_addon.import_package import import_package
    from blender_addon.problems import ExportRefused
    from blender_addon.settings import ExportSettings

    version.OLDEST = oldest
    bpy.ops.wm.read_factory_settings(use_empty=False)
    cube = bpy.data.objects["Cube"]
    cube["sm_role"], cube["sm_category"], cube["sm_license"] = "object", "paperweight", "CC0-1.0"
    settings = ExportSettings(kind="object", max_texture_px=64)
    problems = [problem for problem in check(settings) if problem.severity == "error"]
    messages = [" ".join(map(str, problems)), "", ""]
    try:
        export(folder, settings)
    except ExportRefused as refused:
        messages[1] = str(refused)
    try:
        import_package(folder / "cube")
    except ValueError as error:
        messages[2] = str(error)
    return {"messages": messages, "remedies": bool(problems) and all(p.remedy for p in problems)}


if __name__ == "__main__":
    print(json.dumps(_say(Path(sys.argv[1]), (int(sys.argv[2]), int(sys.argv[3])))))
