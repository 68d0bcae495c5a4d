# SPDX-License-Identifier: MIT
"""Imported scenes with Mitsuba's own BSDFs, and with converted materials, compared with reference images.

    python -m benchmarks.studies.compare_references                     all scenes, JSON and a table
    python -m benchmarks.studies.compare_references --scenes staircase --width 160 --samples 64

Every scene is imported into a temporary library, rendered from its own camera at the reference's aspect with
the original BSDFs and with the project's, and compared with its author's ``reference.exr``. The third column
compares the two renderings. Figures: correlation and median ratio of blurred luminance
(``oracles.imported_renders.agreement``). Writes --out (JSON) and prints a Markdown table.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from benchmarks.timing import markdown, write_report
from datagen.foundation.color import exposure_for, srgb_from_linear
from datagen.foundation.images import read_image
from datagen.importers.common import ImportOptions
from datagen.importers.mitsuba_xml import import_mitsuba_scene
from datagen.library import Library
from mitsuba_plugins.variant import select_variant
from oracles.imported_renders import Agreement, agreement, render_converted, render_original

SCENES = ("staircase", "staircase2", "veach-ajar", "bathroom2", "dining-room", "bathroom")
UNIT_SCALES = {"bathroom2": 0.1}
REMARKS = {
    "dining-room": "substitute environment map without the sun",
    "bathroom": "the reference is framed and textured otherwise",
}
MAX_DEPTH = 65


def compare_scene(
    folder: Path, library_folder: Path, width_px: int, num_samples: int, pictures: Path | None = None
) -> dict:
    """Import a scene and compare its renderings and reference; returns a row of the report."""
    name = folder.name
    start = time.perf_counter()
    options = ImportOptions(dielectric="replace", unit_scale=UNIT_SCALES.get(name, 1.0), overwrite=True)
    record = import_mitsuba_scene(folder, library_folder, options)
    imported = time.perf_counter() - start
    reference = read_image(folder / "reference.exr")[..., :3]
    height_px = round(width_px * reference.shape[0] / reference.shape[1])
    images = {"original": render_original(folder, width_px, num_samples, MAX_DEPTH, height_px=height_px)}
    with Library([record.path]) as library:
        images["converted"] = render_converted(
            library, record.asset_id, width_px, num_samples, MAX_DEPTH, height_px=height_px
        )
    if pictures is not None:
        write_picture(pictures / f"{name}.png", reference, images)
    result: dict[str, Agreement] = {
        "original": agreement(images["original"], reference),
        "converted": agreement(images["converted"], reference),
        "conversion": agreement(images["converted"], images["original"]),
    }
    return {
        "scene": name,
        "width_px": width_px,
        "height_px": height_px,
        "samples": num_samples,
        "seconds_to_import": imported,
        "remark": REMARKS.get(name, ""),
        "approximations": list(record.approximations),
        **{key: asdict(value) for key, value in result.items()},
    }


def write_picture(path: Path, reference: np.ndarray, images: dict[str, np.ndarray]) -> None:
    """Write reference, original and converted image side by side, at one exposure."""
    height, width = images["original"].shape[:2]
    row = [cv2.resize(np.ascontiguousarray(reference), (width, height), interpolation=cv2.INTER_AREA)]
    row += [images["original"], images["converted"]]
    exposure = exposure_for(row[0])
    encoded = [np.round(255 * np.clip(srgb_from_linear(i * exposure), 0, 1)).astype(np.uint8) for i in row]
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.concatenate(encoded, axis=1)[..., ::-1])


def table(results: list[dict]) -> str:
    """Markdown table of the correlation and median ratio of each scene's pairs of images."""
    rows = []
    for result in results:
        cells = [
            f"{result[key]['correlation']:.4f} / {result[key]['median_ratio']:.3f}"
            for key in ("original", "converted", "conversion")
        ]
        rows.append([result["scene"], *cells, result["remark"]])
    pairs = ("original : reference", "converted : reference", "converted : original")
    return markdown(("scene", *pairs, "remark"), rows)


def main() -> None:
    default = Path(__file__).resolve().parents[3] / "shared" / "data" / "scenes"
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=default, help="folder that contains the scenes")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--out", type=Path, default=Path("references.json"))
    parser.add_argument("--pictures", type=Path, help="folder for pictures of reference, original, converted")
    arguments = parser.parse_args()
    select_variant()
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.scenes:
            scene = arguments.data / name
            if not (scene / "scene.xml").is_file():
                print(f"{scene}: missing, left out", file=sys.stderr)
                continue
            results.append(
                compare_scene(scene, Path(folder), arguments.width, arguments.samples, arguments.pictures)
            )
            print(table(results[-1:]).splitlines()[-1], file=sys.stderr)
    write_report(results, arguments.out, is_printed=False, indent=2)
    print(table(results))


if __name__ == "__main__":
    main()
