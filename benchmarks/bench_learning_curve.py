# SPDX-License-Identifier: MIT
"""Learning curve: validation error over the number of training configurations.

    python -m benchmarks.bench_learning_curve DATASET [OTHER ...] --out DIR [--counts 5 10 20 40]
        [--steps 400] [--preset small] [--set KEY=VALUE ...] [--threads 2] [--judge DATASET]

For each count, trains the preset on that many evenly spaced training configurations of a dataset, with the
same number of optimiser steps per track; a point is the mean squared error of each map over all views of the
validation split of ``--judge`` (default: the first DATASET). Every OTHER dataset, for example of the same
recipe with fewer samples, adds a curve, evaluated on the same views. Short runs rank the curves; they
do not predict the error of a long run.

Writes ``table.md``, ``results.json`` and ``curve.png`` into DIR. Existing points are not trained again;
interrupted points resume. A point takes about ``2 * steps`` times the seconds of a step printed by
``benchmarks.bench_network``: 400 steps of ``small`` take about 7 minutes of one core.
"""

from __future__ import annotations

import argparse
import os
import shutil
import time
from collections import Counter
from pathlib import Path

import matplotlib
import torch
from matplotlib import pyplot

from benchmarks.bench_learning import CONSTANT, TRACKS, Rows
from benchmarks.timing import markdown, write_report
from datagen.formats.base import canonical_json, write_bytes_atomically
from datagen.formats.shard import INDEX_FILE, Dataset, DatasetIndex, ShardRecord
from datagen.foundation.buffers import MATERIAL_MAPS
from model.checkpoint import load_checkpoint
from model.training.config import PhaseConfig, TrainingConfig, parse_overrides, resolve_config
from model.training.dataset import buffer_names
from model.training.sources import open_data, spread
from model.training.train import Trainer
from model.training.validation import constant_predictor, evaluate, mean_maps, network_predictor, whole_views


def part_of(dataset: Path, count: int, judge: Path, out: Path) -> Path:
    """Create a dataset folder with ``count`` training configurations of ``dataset`` and the validation
    configurations of ``judge``; raises ``SystemExit`` if there are too few.
    """
    source, judged = Dataset(dataset), Dataset(judge)
    training = [shard for shard in source.index.shards if shard.split == "train"]
    if count > len(training):
        raise SystemExit(f"{dataset}: {len(training)} training configurations; expected at least {count}")
    chosen = [(source, training[k * len(training) // count]) for k in range(count)]
    chosen += [(judged, shard) for shard in judged.index.shards if shard.split == "validation"]
    (out / "shards").mkdir(parents=True, exist_ok=True)
    kept = []
    for folder, shard in chosen:
        target = out / "shards" / f"{shard.sha256[:16]}.tar"
        if not target.exists():
            _link(folder.folder / shard.file, target)
        kept.append(shard.model_copy(update={"file": f"shards/{target.name}"}))
    index = _index_of(source.index, kept, {**judged.index.assets, **source.index.assets})
    write_bytes_atomically(out / INDEX_FILE, canonical_json(index))
    return out


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # another file system
        shutil.copyfile(source, target)


def _index_of(index: DatasetIndex, shards: list[ShardRecord], assets: dict) -> DatasetIndex:
    used = {name for shard in shards for name in shard.assets}
    return index.model_copy(
        update={
            "shards": tuple(shards),
            "num_configurations": len(shards),
            "num_views": sum(shard.num_views for shard in shards),
            "num_bytes": sum(shard.num_bytes for shard in shards),
            "splits": dict(Counter(shard.split for shard in shards)),
            "assets": {name: assets[name] for name in sorted(used)},
        }
    )


def short_run(config: TrainingConfig, steps: int) -> TrainingConfig:
    """Return ``config`` with ``steps`` steps for each track, no later phases and no validation."""
    phases = tuple(PhaseConfig(name=track, steps=steps) for track in TRACKS)
    validation = config.validation.model_copy(update={"num_views": 0})
    return config.model_copy(update={"phases": phases, "validation": validation})


def measure(config: TrainingConfig, dataset: Path, out: Path) -> dict[str, float]:
    """Train on ``dataset`` into ``out`` unless done; returns the metrics over its validation views."""
    Trainer(config, [dataset], out, device=torch.device("cpu"), show_progress=True).run()
    data = open_data([dataset], config.network, config.data.crop_px)
    batches = whole_views(data.validation, buffer_names(config.network), torch.device("cpu"))
    network = load_checkpoint(out / "final.safetensors").network
    return evaluate(network_predictor(network, TRACKS), batches)


def constant(config: TrainingConfig, dataset: Path) -> dict[str, float]:
    """Metrics over the validation views of a constant prediction, the mean of the training maps."""
    data = open_data([dataset], config.network, config.data.crop_px)
    names, device = buffer_names(config.network), torch.device("cpu")
    means = mean_maps(whole_views(spread(data.train, 80), names, device))
    return evaluate(constant_predictor(means), whole_views(data.validation, names, device))


def as_table(curves: dict[str, dict[int, dict[str, float]]], baseline: dict[str, float]) -> str:
    """Markdown table of mean squared errors."""
    rows: list[tuple[str, object, dict[str, float]]] = [(CONSTANT, "", baseline)]
    rows += [(label, n, metrics) for label, points in curves.items() for n, metrics in points.items()]
    cells = [(label, n, *(f"{found[f'{m}_mse']:.5f}" for m in MATERIAL_MAPS)) for label, n, found in rows]
    return markdown(("data", "configurations", *MATERIAL_MAPS), cells) + "\n"


def plot(curves: dict[str, dict[int, dict[str, float]]], baseline: dict[str, float], path: Path) -> None:
    """Plot a panel per map, with a line per dataset and a dashed line for the constant prediction."""
    matplotlib.use("Agg")
    figure, axes = pyplot.subplots(1, len(MATERIAL_MAPS), figsize=(4 * len(MATERIAL_MAPS), 3.4))
    for axis, name in zip(axes, MATERIAL_MAPS, strict=True):
        for label, points in curves.items():
            axis.plot(list(points), [m[f"{name}_mse"] for m in points.values()], marker="o", label=label)
        axis.axhline(baseline[f"{name}_mse"], color="grey", linestyle="--", linewidth=1, label=CONSTANT)
        axis.set(title=name, xlabel="training configurations", xscale="log")
        axis.set_xticks(sorted({n for points in curves.values() for n in points}))
        axis.get_xaxis().set_major_formatter(matplotlib.ticker.ScalarFormatter())
        axis.minorticks_off()
    axes[0].set_ylabel("mean squared error, held out")
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("datasets", type=Path, nargs="+", metavar="DATASET")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--counts", type=int, nargs="+", default=[5, 10, 20, 40])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--preset", default="small")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--judge", type=Path, metavar="DATASET", help="dataset of the judged validation views"
    )
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    config = short_run(resolve_config(args.preset, None, parse_overrides(args.set)), args.steps)
    judge, start = args.judge or args.datasets[0], time.process_time()
    if len({dataset.name for dataset in args.datasets}) < len(args.datasets):
        parser.error("datasets of the same name would share results; rename a folder")
    curves: dict[str, dict[int, dict[str, float]]] = {}
    parts: list[Path] = []
    for dataset in args.datasets:
        for count in sorted(args.counts):
            place = args.out / f"{dataset.name}-{count}"
            parts.append(part_of(dataset, count, judge, place / "data"))
            curves.setdefault(dataset.name, {})[count] = measure(config, parts[-1], place / "run")
    # the constant is the training mean of the largest part of the first dataset
    baseline = constant(config, parts[len(args.counts) - 1])
    table = as_table(curves, baseline)
    print(table)
    (args.out / "table.md").write_text(table)
    rows: Rows = {f"{label} {n}": m for label, points in curves.items() for n, m in points.items()}
    report = {
        "preset": args.preset,
        "steps_a_track": args.steps,
        "process_s": round(time.process_time() - start, 1),
        "results": {CONSTANT: baseline, **rows},
    }
    write_report(report, args.out / "results.json", is_printed=False, indent=2)
    plot(curves, baseline, args.out / "curve.png")


if __name__ == "__main__":
    main()
