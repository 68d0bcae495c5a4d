# SPDX-License-Identifier: MIT
"""Training check: trains a preset and its single-view version (*No RP*) and compares them with simple
predictions.

    python -m benchmarks.bench_learning DATASET ... --out DIR [--preset small] [--set KEY=VALUE ...]
    python -m benchmarks.bench_learning DATASET ... --out DIR --compare CHECKPOINT ...    trains nothing

On the whole views of the validation splits, or of ``--judge DATASET`` alone: mean squared errors of every map
for a constant (the training mean), the exposed median image as diffuse albedo, the single-view network, the
network, and the network with the bilateral solver. Writes ``table.md``, ``results.json`` and ``curves.png``
into DIR; interrupted runs continue.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

from datagen.formats.view_places import ViewPlace
from datagen.foundation.buffers import MATERIAL_MAPS
from model.checkpoint import load_checkpoint
from model.networks import TrackName
from model.training.config import TrainingConfig, parse_overrides, resolve_config
from model.training.dataset import buffer_names
from model.training.run_log import read_log
from model.training.sources import TrainingData, open_data, spread
from model.training.train import Trainer
from model.training.validation import (
    constant_predictor,
    evaluate,
    filtered_predictor,
    mean_maps,
    median_predictor,
    network_predictor,
    whole_views,
)

TRACKS: tuple[TrackName, ...] = ("diffuse", "specular")

CONSTANT = "constant (training mean)"
METAL_ABOVE = 0.2  # specular albedo of any channel

Rows = dict[str, dict[str, float]]
"""Metrics by method."""


def judged_views(data: TrainingData, judge: Path | None) -> list[ViewPlace]:
    """The validation views, or those of one dataset folder; ``SystemExit`` where there are none."""
    root = judge.resolve() if judge else Path("/")
    places = [place for place in data.validation if place.shard.resolve().is_relative_to(root)]
    if not places:
        raise SystemExit(f"{judge or 'datasets'}: no validation views")
    return places


def compare(
    config: TrainingConfig, datasets: list[Path], checkpoints: dict[str, Path], judge: Path | None = None
) -> Rows:
    """Metrics by method on the validation views; the training mean is that of all ``datasets``."""
    device = torch.device("cpu")
    data = open_data(datasets, config.network, config.data.crop_px)
    names = buffer_names(config.network)
    batches = list(whole_views(judged_views(data, judge), names, device))
    means = mean_maps(whole_views(spread(data.train, 80), names, device))
    rows = {
        CONSTANT: evaluate(constant_predictor(means), batches),
        "median image as diffuse albedo": evaluate(median_predictor, batches),
    }
    for label, path in checkpoints.items():
        checkpoint = load_checkpoint(path)
        predict = network_predictor(checkpoint.network, TRACKS)
        rows[label] = evaluate(predict, batches)
        if checkpoint.confidence is not None:
            filtered = filtered_predictor(predict, checkpoint.confidence, checkpoint.card.solver)
            rows[f"{label}, filtered"] = evaluate(filtered, batches)
    return rows


def metal_errors(
    path: Path, datasets: list[Path], judge: Path | None = None, num_views: int = 30
) -> dict[str, float]:
    """Errors of a checkpoint's specular albedo on metal (any channel above 0.2) and elsewhere.

    Over ``num_views`` validation views, evenly spread: the share of metal among pixels with a surface and in
    the sum of squared errors, mean squared error and mean prediction on metal and elsewhere.
    """
    network, device = load_checkpoint(path).network, torch.device("cpu")
    data = open_data(datasets, network.config, 16)
    predict = network_predictor(network, ("specular",))
    views = spread(judged_views(data, judge), num_views)
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
    lines = ["| method | " + " | ".join(MATERIAL_MAPS) + " |", "|---" * (len(MATERIAL_MAPS) + 1) + "|"]
    for label, metrics in rows.items():
        values = [metrics.get(f"{name}_mse") for name in MATERIAL_MAPS]
        lines.append(f"| {label} | " + " | ".join("" if v is None else f"{v:.5f}" for v in values) + " |")
    return "\n".join(lines) + "\n"


def write_table(rows: Rows, run: dict[str, Any], out: Path) -> None:
    """``table.md`` and ``results.json``."""
    table = as_table(rows)
    print(table)
    (out / "table.md").write_text(table)
    (out / "results.json").write_text(json.dumps({**run, "results": rows}, indent=2) + "\n")


def plot_curves(folders: dict[str, Path], path: Path) -> None:
    """Training loss and validation score over steps."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4))
    for label, folder in folders.items():
        for axis, kind, name in ((axes[0], "train", "total"), (axes[1], "validation", "score")):
            rows = read_log(folder, kind, name)
            axis.plot(
                [s for s, _ in rows],
                [v for _, v in rows],
                label=label,
                linewidth=1,
                marker="." if axis is axes[1] else "",
            )
            axis.set(xlabel="step", ylabel=f"{kind} {name}", yscale="log")
    axes[0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("datasets", type=Path, nargs="+", metavar="DATASET")
    parser.add_argument("--judge", type=Path, metavar="DATASET", help="the one whose validation views count")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", default="small")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--compare", type=Path, nargs="+", metavar="CHECKPOINT", default=[])
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    config = resolve_config(args.preset, None, parse_overrides(args.set))
    args.out.mkdir(parents=True, exist_ok=True)
    names = [str(dataset) for dataset in args.datasets]
    if args.compare:
        config = config.model_copy(update={"network": load_checkpoint(args.compare[0]).card.network})
        rows = compare(config, args.datasets, {path.stem: path for path in args.compare}, args.judge)
        metal = {path.stem: metal_errors(path, args.datasets, args.judge) for path in args.compare}
        print("specular albedo on metal and elsewhere:", json.dumps(metal, indent=2))
        write_table(rows, {"datasets": names, "metal": metal}, args.out)
        return
    single = config.model_copy(
        update={"network": config.network.model_copy(update={"uses_statistics": False})}
    )
    folders, seconds = {}, {}
    for label, chosen in (("ours", config), ("No RP", single)):
        folder = args.out / label.lower().replace(" ", "_")
        start = time.perf_counter()
        Trainer(chosen, args.datasets, folder, device=torch.device("cpu"), show_progress=True).run()
        folders[label], seconds[label] = folder, time.perf_counter() - start
    trained = {label: folder / "final.safetensors" for label, folder in folders.items()}
    rows = compare(config, args.datasets, trained, args.judge)
    run = {"datasets": names, "preset": args.preset, "training_s": seconds}
    write_table(rows, run, args.out)
    plot_curves(folders, args.out / "curves.png")


if __name__ == "__main__":
    main()
