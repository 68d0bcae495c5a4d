# SPDX-License-Identifier: MIT
"""Errors of checkpoints and of simple baselines on held-out views.

    python -m benchmarks.bench_learning DATASET ... --out DIR --compare CHECKPOINT ... [--judge DATASET]

Computes mean squared errors of every map over all uncropped validation views, or only over those of
``--judge``: for a constant (the training mean), for the exposed median image and the recorded reflectance as
diffuse albedo, and for each checkpoint with and without the bilateral solver. Writes ``table.md``,
``results.json`` and a picture CHECKPOINT.jpg of each checkpoint's best and worst view into DIR.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.timing import markdown, write_report
from datagen.formats.shard import ViewPlace
from datagen.foundation.buffers import MATERIAL_MAPS
from model.checkpoint import load_checkpoint
from model.networks import TrackName
from model.training.config import TrainingConfig, resolve_config
from model.training.dataset import buffer_names
from model.training.losses import METAL_ABOVE
from model.training.run_log import view_panel
from model.training.sources import TrainingData, open_data, spread
from model.training.validation import (
    Predictor,
    constant_predictor,
    evaluate,
    filtered_predictor,
    mean_maps,
    median_predictor,
    network_predictor,
    reflectance_predictor,
    score_of,
    whole_views,
)

TRACKS: tuple[TrackName, ...] = ("diffuse", "specular")

CONSTANT = "constant (training mean)"

Rows = dict[str, dict[str, float]]
"""Metrics (:func:`~model.training.validation.evaluate`) by method."""


def judged_views(data: TrainingData, judge: Path | None) -> list[ViewPlace]:
    """Validation views of ``data``, or of the dataset folder ``judge``; ``SystemExit`` if there are none."""
    root = judge.resolve() if judge else Path("/")
    places = [place for place in data.validation if place.shard.resolve().is_relative_to(root)]
    if not places:
        raise SystemExit(f"{judge or 'datasets'}: no validation views")
    return places


def compare(
    config: TrainingConfig,
    datasets: list[Path],
    checkpoints: dict[str, Path],
    judge: Path | None = None,
    pictures: Path | None = None,
) -> Rows:
    """Metrics of the baselines and ``checkpoints`` on the validation views of ``datasets`` or ``judge``;
    pictures of each checkpoint's best and worst view are written into the folder ``pictures``.
    """
    device = torch.device("cpu")
    data = open_data(datasets, config.network, config.data.crop_px)
    read = {path: load_checkpoint(path) for path in checkpoints.values()}
    names = tuple(dict.fromkeys(n for c in read.values() for n in buffer_names(c.card.network)))
    batches = list(whole_views(judged_views(data, judge), names, device))
    means = mean_maps(whole_views(spread(data.train, 80), names, device))
    rows = {
        CONSTANT: evaluate(constant_predictor(means), batches),
        "median image as diffuse albedo": evaluate(median_predictor, batches),
    }
    if "reflectance" in names:
        rows["recorded reflectance as diffuse albedo"] = evaluate(reflectance_predictor, batches)
    for label, path in checkpoints.items():
        checkpoint = read[path]
        predict = network_predictor(checkpoint.network, TRACKS)
        rows[label] = evaluate(predict, batches)
        if pictures is not None:
            draw_extremes(predict, batches, pictures / f"{label}.jpg")
        if checkpoint.confidence is not None:
            filtered = filtered_predictor(predict, checkpoint.confidence, checkpoint.card.solver)
            rows[f"{label}, filtered"] = evaluate(filtered, batches)
    return rows


def draw_extremes(predict: Predictor, batches: list[dict[str, Tensor]], target: Path) -> None:
    """Write a picture of the views with the least and the largest error of ``predict``."""
    from PIL import Image

    ordered = sorted(batches, key=lambda batch: score_of(evaluate(predict, [batch])))
    panels = [view_panel(batch, predict(batch)) for batch in (ordered[0], ordered[-1])]
    pixels = 255 * torch.cat(panels, dim=2).permute(1, 2, 0)
    Image.fromarray(pixels.round().byte().numpy()).save(target, quality=88)


def metal_errors(path: Path, datasets: list[Path], judge: Path | None) -> dict[str, float]:
    """Errors of a checkpoint's specular albedo on metal (any channel above 0.2) and on other surfaces.

    Over 30 evenly spaced validation views: the share of metal among surface pixels and in the sum
    of squared errors, and the mean squared error and mean prediction on metal and on other surfaces.
    """
    network, device = load_checkpoint(path).network, torch.device("cpu")
    data = open_data(datasets, network.config, 16)
    predict = network_predictor(network, ("specular",))
    views = spread(judged_views(data, judge), 30)
    pixels, squared, predicted = (dict.fromkeys(("metal", "elsewhere"), 0.0) for _ in range(3))
    for batch in whole_views(views, buffer_names(network.config), device):
        surface, truth = batch["mask"][:, :1] > 0.5, batch["specular_albedo"]
        specular = predict(batch)["specular_albedo"]
        error = ((specular - truth) ** 2).mean(dim=1, keepdim=True)
        metal = (truth.amax(dim=1, keepdim=True) > METAL_ABOVE) & surface
        for name, chosen in (("metal", metal), ("elsewhere", surface & ~metal)):
            pixels[name] += float(chosen.sum())
            squared[name] += float(error[chosen].sum())
            predicted[name] += float(specular.mean(dim=1, keepdim=True)[chosen].sum())
    found = {
        "share_of_pixels": pixels["metal"] / sum(pixels.values()),
        "share_of_error": squared["metal"] / sum(squared.values()),
    }
    for name, count in pixels.items():
        found[f"mse_{name}"] = squared[name] / max(count, 1.0)
        found[f"mean_prediction_{name}"] = predicted[name] / max(count, 1.0)
    return found


def as_table(rows: Rows) -> str:
    """Markdown table of mean squared errors."""
    cells = []
    for label, metrics in rows.items():
        values = [metrics.get(f"{name}_mse") for name in MATERIAL_MAPS]
        cells.append([label, *("" if v is None else f"{v:.5f}" for v in values)])
    return markdown(("method", *MATERIAL_MAPS), cells) + "\n"


def write_table(rows: Rows, run: dict[str, Any], out: Path) -> None:
    """Write ``table.md`` and ``results.json`` into ``out``, and print the table."""
    table = as_table(rows)
    print(table)
    (out / "table.md").write_text(table)
    write_report({**run, "results": rows}, out / "results.json", is_printed=False, indent=2)


def main() -> None:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("datasets", type=Path, nargs="+", metavar="DATASET")
    parser.add_argument(
        "--judge", type=Path, metavar="DATASET", help="dataset of the judged validation views"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", default="small")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--compare", type=Path, nargs="+", metavar="CHECKPOINT", required=True)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    network = load_checkpoint(args.compare[0]).card.network
    config = resolve_config(args.preset).model_copy(update={"network": network})
    checkpoints = {path.stem: path for path in args.compare}
    rows = compare(config, args.datasets, checkpoints, args.judge, args.out)
    metal = {path.stem: metal_errors(path, args.datasets, args.judge) for path in args.compare}
    print("specular albedo on metal and elsewhere:", json.dumps(metal, indent=2))
    write_table(rows, {"datasets": [str(dataset) for dataset in args.datasets], "metal": metal}, args.out)


if __name__ == "__main__":
    main()
