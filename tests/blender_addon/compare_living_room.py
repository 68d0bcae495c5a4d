# SPDX-License-Identifier: GPL-3.0-or-later
"""Compares the Poly Haven living room in Cycles (original graphs) and in Mitsuba (exported package).

``python -m tests.blender_addon.compare_living_room ASSETS OUT [--width W] [--samples N]`` prints the
agreement of the two pictures and writes ``OUT/comparison.jpg``: Cycles, Mitsuba, and their difference,
denoised.

Both renderers make two independent images, x1 and x2 (Mitsuba), r1 and r2 (Cycles), with half the samples
each. The mean of ``(x1-r1)(x2-r2)`` is an unbiased estimate of the converged images' squared difference.
The figures ``psnr_srgb_...`` compare values clipped to [0, 1] and sRGB-encoded, with a peak of 1.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from datagen.foundation.color import srgb_from_linear
from datagen.rendering.error import EPSILON
from tests.conftest import REPOSITORY

_BLOCK = 8
_DIFFERENCE_GAIN = 4


def _run(*arguments: object) -> str:
    command = [sys.executable, "-m", *map(str, arguments)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(done.stdout[-1000:] + done.stderr[-3000:])
    return done.stdout


def render(assets: Path, out: Path, width: int, samples: int) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return two linear images (2, H, W, 3) by Cycles, two by Mitsuba, and the export's remarks."""
    text = _run("tests.blender_addon.living_room", assets, out, "--width", width, "--samples", samples // 2)
    _run("tests.blender_addon.render_twice", out / "packages" / "living_room", out, samples // 2)
    return np.load(out / "cycles.npy"), np.load(out / "mitsuba.npy"), json.loads(text.splitlines()[-1])


def encoded(linear: np.ndarray) -> np.ndarray:
    """Clip values to [0, 1] and encode them as sRGB."""
    return srgb_from_linear(np.clip(linear, 0, 1))


def _psnr(first: np.ndarray, second: np.ndarray) -> float:
    """PSNR (dB) between two pairs of images (2, H, W, 3), from the product of independent differences."""
    squared = (first[0] - second[0]) * (first[1] - second[1])
    return float(-10 * np.log10(max(squared.mean(), 1e-12)))


def _blocks(images: np.ndarray) -> np.ndarray:
    count, height, width, _ = images.shape
    height, width = height // _BLOCK * _BLOCK, width // _BLOCK * _BLOCK
    shape = (count, height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK, 3)
    return images[:, :height, :width].reshape(shape).mean(axis=(2, 4))


def figures(cycles: np.ndarray, mitsuba: np.ndarray) -> dict[str, float]:
    """Return measures of agreement between two pairs of linear images (2, H, W, 3), by name."""
    theirs, ours = cycles.astype(np.float64), mitsuba.astype(np.float64)
    reference = theirs.mean(axis=0)
    squared = (ours[0] - theirs[0]) * (ours[1] - theirs[1])
    return {
        "psnr_srgb_db": _psnr(encoded(theirs), encoded(ours)),
        "psnr_srgb_of_blocks_db": _psnr(encoded(_blocks(theirs)), encoded(_blocks(ours))),
        "rel_mse_linear": float((squared / (reference**2 + EPSILON)).mean()),
        "mean_ratio": float(ours.mean() / theirs.mean()),
    }


def picture(cycles: np.ndarray, mitsuba: np.ndarray) -> Image.Image:
    """Return the denoised images of Cycles and Mitsuba and their difference (grey: equal), side by side."""
    import pyoidn

    clean = [
        pyoidn.denoise(np.ascontiguousarray(pair.mean(axis=0), np.float32), hdr=True)
        for pair in (cycles, mitsuba)
    ]
    first, second = (encoded(image) for image in clean)
    difference = np.clip(0.5 + _DIFFERENCE_GAIN / 2 * (second - first), 0, 1)
    gap = np.ones((len(first), 4, 3))
    row = np.concatenate([first, gap, second, gap, difference], axis=1)
    return Image.fromarray(np.round(row * 255).astype(np.uint8))


def main() -> None:
    """Render both pictures, print their agreement and write the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("assets", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--samples", type=int, default=128)
    arguments = parser.parse_args()
    cycles, mitsuba, text = render(
        arguments.assets.resolve(), arguments.out.resolve(), arguments.width, arguments.samples
    )
    print("\n".join(text))
    print(json.dumps(figures(cycles, mitsuba), indent=2))
    picture(cycles, mitsuba).save(arguments.out / "comparison.jpg", quality=88)


if __name__ == "__main__":
    main()
