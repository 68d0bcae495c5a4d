# SPDX-License-Identifier: MIT
"""Small files that expand enormously are refused within 10 s and 1 GB; messages name the limit to raise."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen.foundation.budget import LIMITS_VARIABLE, Budget, Limits
from datagen.foundation.errors import InputError
from tests.oversized import FILES, MAX_BYTES, MAX_SECONDS, gltf, run

EXPECTED = {
    "mitsuba_diamond": "nodes",
    "mitsuba_doubling": "bytes",
    "mitsuba_includes": "references",
    "mitsuba_instances": "nodes",
    "mitsuba_references": "depth",
    "mitsuba_nested": "depth",
    "gltf_nodes": "instances",
    "gltf_primitives": "instances",
    "gltf_chain": "depth",
    "gltf_matrix": "nodes[0].matrix = 3 entries; expected 16 numbers",
    "gltf_sparse": "accessors[0].sparse = -9; expected indices from 0 to 5",
    "sweet_home": "bytes",
    "transforms_frames": "values",
    "transforms_empty_frames": "frames",
}
"""Limit named by the refusal of each file, or the fault of a file that is invalid at any size."""


@pytest.mark.parametrize("name", FILES)
def test_reading_ends_soon_and_names_the_limit_to_raise(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    folder.mkdir()
    reading = run(name, folder)
    assert reading.code == 2, reading.text[-3000:]
    assert reading.seconds < MAX_SECONDS, reading
    assert reading.peak_bytes < MAX_BYTES, reading
    expected = EXPECTED[name]
    if expected in Limits.__dataclass_fields__:
        [line] = reading.text.strip().splitlines()
        assert f"{expected} = " in line and f"{LIMITS_VARIABLE}={expected}=" in line
    else:
        assert expected in reading.text
    assert not (tmp_path / "case-out").exists()


def test_a_limit_is_raised_by_the_environment(tmp_path: Path) -> None:
    """The same file is read if the limit is raised as the message advises."""

    def write(folder: Path) -> Path:
        chain = [{"children": [k + 1]} for k in range(150)]
        return gltf(folder, {"nodes": [*chain, {"mesh": 0}]})

    FILES["short_chain"] = (write, FILES["gltf_chain"][1])
    try:
        refused = run("short_chain", tmp_path)
        advice = refused.text.rpartition(" ")[2].strip()
        assert refused.code == 2 and advice.startswith(f"{LIMITS_VARIABLE}=depth=")
        name, _, value = advice.partition("=")
        passed = run("short_chain", tmp_path, {name: value})
    finally:
        del FILES["short_chain"]
    assert passed.code == 0, passed.text


def test_the_environment_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMITS_VARIABLE, " frames=7, nodes=9 ")
    assert (Limits.from_environment().frames, Limits.from_environment().nodes) == (7, 9)
    assert Limits.from_environment().depth == Limits().depth
    for text in ("frame=7", "frames", "frames=-1", "frames=0", "frames=1e3", "depth=5000", "frames=²"):
        monkeypatch.setenv(LIMITS_VARIABLE, text)
        with pytest.raises(InputError, match=LIMITS_VARIABLE):
            Limits.from_environment()


def test_the_size_of_a_file_raises_its_limits(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(800))
    budget = Budget(path, Limits(triangles=10, instances=10))
    for _ in range(2):
        budget.hold_file(path)  # a file counts only once
    budget.spend("triangles", 110)
    with pytest.raises(InputError, match=r"triangles = 111 or more; expected at most 110 .*\(10 plus an"):
        budget.spend("triangles")
    with pytest.raises(InputError, match=r"instances = 11 or more; expected at most 10 meshes placed;"):
        budget.spend("instances", 11)


def test_deep_nesting_is_read_where_the_limit_is_raised(tmp_path: Path) -> None:
    """Readers are recursive, so raising the limit also raises the interpreter's recursion limit."""
    from datagen.importers.common import ImportOptions
    from datagen.importers.mitsuba_xml import import_mitsuba_scene

    bsdfs = ['<bsdf type="diffuse" id="b0"/>']
    bsdfs += [f'<bsdf type="twosided" id="b{k}"><ref id="b{k - 1}"/></bsdf>' for k in range(1, 1500)]
    shape = '<shape type="rectangle"><ref id="b1499"/></shape>'
    path = tmp_path / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{"".join(bsdfs)}{shape}</scene>')
    options = ImportOptions(license="CC0-1.0", limits=Limits(depth=1600))
    assert import_mitsuba_scene(path, tmp_path / "library", options).kind == "environment"
    nested = '<bsdf type="twosided">' * 1500 + '<bsdf type="diffuse"/>' + "</bsdf>" * 1500
    path.write_text(f'<scene version="3.0.0"><shape type="rectangle">{nested}</shape></scene>')
    options = ImportOptions(license="CC0-1.0", asset_id="other", limits=Limits(depth=1600))
    assert import_mitsuba_scene(path, tmp_path / "library", options).kind == "environment"
