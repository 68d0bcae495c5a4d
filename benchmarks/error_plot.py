# SPDX-License-Identifier: MIT
"""Frame of plots of an estimated error against the true one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def save_error_plot(figure: Any, axes: Any, ends: NDArray, xlabel: str, ylabel: str, path: Path) -> None:
    """Finish and write a plot with both axes logarithmic between ``ends`` (2,): the diagonal, and a band of a
    factor of 2 about it."""
    axes.plot(ends, ends, color="grey", lw=1)
    axes.fill_between(ends, np.asarray(ends) / 2, np.asarray(ends) * 2, color="grey", alpha=0.12, lw=0)
    axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends, xlabel=xlabel, ylabel=ylabel)
    axes.set_aspect("equal")
    axes.legend(fontsize=8, loc="upper left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
