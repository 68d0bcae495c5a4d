# SPDX-License-Identifier: MIT
"""The choice of Mitsuba's variant, once per process."""

from __future__ import annotations

from pathlib import Path

import pytest

from mitsuba_plugins import variant
from mitsuba_plugins.variant import VARIANTS, find_llvm_libraries, select_variant


def test_the_active_variant_is_kept(mitsuba_variant: str) -> None:
    assert [select_variant(name) for name in (None, "auto", mitsuba_variant)] == 3 * [mitsuba_variant]


def test_another_variant_is_refused(mitsuba_variant: str) -> None:
    (other,) = set(VARIANTS) - {mitsuba_variant}
    with pytest.raises(RuntimeError, match="one variant per process"):
        select_variant(other)


def test_a_library_without_a_version_in_its_name_is_queried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LLVM's file names on macOS and Windows lack a version; a library that fails to load is ignored."""
    for name in ("libLLVM.dylib", "LLVM-C.dll", "libLLVM.so.19.1"):
        (tmp_path / name).touch()
    monkeypatch.setattr(variant, "SEARCH_FOLDERS", (str(tmp_path),))
    answers = {"libLLVM.dylib": 21, "LLVM-C.dll": None}
    monkeypatch.setattr(variant, "llvm_major", lambda path: answers[path.name])
    found = [(lib.path.name, lib.major) for lib in find_llvm_libraries() if lib.path.parent == tmp_path]
    assert found == [("libLLVM.dylib", 21), ("libLLVM.so.19.1", 19)]
