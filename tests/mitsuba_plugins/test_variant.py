# SPDX-License-Identifier: MIT
"""The choice of Mitsuba's variant, once a process."""

from __future__ import annotations

import pytest

from mitsuba_plugins.variant import CUDA_VARIANT, select_variant


@pytest.mark.parametrize("name", [None, "auto", "llvm_ad_rgb"])
def test_the_active_variant_is_kept(mitsuba_variant: str, name: str | None) -> None:
    assert select_variant(name) == mitsuba_variant


def test_another_variant_is_refused(mitsuba_variant: str) -> None:
    with pytest.raises(RuntimeError, match="one variant a process"):
        select_variant(CUDA_VARIANT)
