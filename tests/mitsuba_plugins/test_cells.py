# SPDX-License-Identifier: MIT
"""Every position, including infinities and NaN, is mapped to a cell within the table."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("mitsuba_variant")


def test_cells_lie_in_the_table_for_any_position() -> None:
    import mitsuba as mi

    from mitsuba_plugins.cells import cell_of

    positions = [-np.inf, -1e30, -0.5, 0.0, 0.99, 1.0, 6.5, 7.0, 7.99, 8.0, 1e30, np.inf]
    cells = np.array(cell_of(mi.Float(positions), 8))
    assert cells.tolist() == [0, 0, 0, 0, 0, 1, 6, 7, 7, 7, 7, 7]
    assert 0 <= int(np.array(cell_of(mi.Float(np.nan), 8))[0]) < 8
