# SPDX-License-Identifier: MIT
""":func:`tests.hostile.attack` finds the fault of each reader in :mod:`tests.faulty_readers`."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from tests import hostile

EXPECTED = {
    "opens_outside": "may not: open",
    "follows_links": "may not: open",
    "unpickles": "pickle.find_class",
    "aborts": "crashed with -6",
    "waits": "for one input",
    "eats": "of memory|peak_mb",
    "raises": "KeyError",
}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_faulty_reader_fails_its_attack(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "eats" and psutil.virtual_memory().available < 2 << 30:
        pytest.skip("needs 2 GB of free memory")
    if name == "waits":
        monkeypatch.setattr(hostile, "MAX_SECONDS", 1.0)
    with pytest.raises((pytest.fail.Exception, AssertionError), match=EXPECTED[name]):
        hostile.attack("tests.faulty_readers", name, tmp_path / "case", examples=1, max_bytes=1 << 30)
