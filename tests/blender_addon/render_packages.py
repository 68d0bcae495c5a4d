# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders the first camera of several packages with Mitsuba: ``python -m ... FOLDER OUT SAMPLES NAME...``."""

from __future__ import annotations

import sys
from pathlib import Path


def main(folder: Path, out: Path, samples: int, names: list[str]) -> None:
    import numpy as np

    from datagen.foundation.images import read_image
    from datagen.inspection.render_package import render_package

    for name in names:
        (path, *_) = render_package(folder / name, out / name, samples=samples, max_depth=2)
        np.save(out / f"{name}.npy", read_image(path)[..., :3])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
