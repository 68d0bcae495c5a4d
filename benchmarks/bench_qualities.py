# SPDX-License-Identifier: MIT
"""Checks that the named qualities are on the Pareto front of error and time (docs/decisions/0071).

    python -m benchmarks.bench_qualities                      3 rooms, 4 views of 320x192
    python -m benchmarks.bench_qualities --size 96 64 --out /tmp/qualities         a quick look

Plans configurations of the bundled library and compares ``draft`` and ``standard`` (with ``--reference`` also
``reference``, which is slow) with fixed sample counts, without and with the irradiance cache and clamp of
``draft`` and ``standard``. A quality's excess is its cost in processor seconds or light paths, divided by the
cost of the same error on the front of fixed counts. Qualities adapt the count to each view's error, which
reduces the excess below 1, but they run the denoiser one or two more times per pass. The excess may reach
--slack in light paths (independent of the machine) and --time-slack in processor seconds. Trials are stored
in --out and not repeated.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from benchmarks.timing import RESULTS, markdown, planned_folder, write_report
from datagen.formats.recipe import ObjectRecipe, Recipe
from datagen.tradeoff.selection import Point, as_row, excess_over_front, points_of
from datagen.tradeoff.sweep import Sweep, SweepOptions

FIXED = "path_samples=2,4,8,16,32,64,128,256"
CLAMP = 30.0  # firefly clamp of draft and standard
SLACK, TIME_SLACK = 1.25, 1.5


def planned_rooms(out: Path, configurations: int) -> Path:
    """Plan a number of ``configurations`` of bundled rooms unless done; returns their folder in ``out``."""
    count = ObjectRecipe(count=(10, 24))
    recipe = Recipe(name="qualities", seed=71, configurations=configurations, views=12, objects=count)
    return planned_folder(out / f"plan-{configurations}", recipe, out / "recipe.yaml")


def excesses(points: list[Point]) -> dict[str, dict[str, float]]:
    """Cost of each quality relative to the front of fixed counts, in light paths and in processor time."""
    fixed = [p for p in points if not p.setting.quality]
    return {
        p.setting.quality: {
            "path_samples": excess_over_front(p, fixed, "path_samples"),
            "cpu_s": excess_over_front(p, fixed, "cpu_s"),
        }
        for p in points
        if p.setting.quality
    }


def main() -> None:
    """Run the command; the exit code is 1 if the excess of a quality is above the slack."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--configurations", type=int, default=3)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 192))
    parser.add_argument("--reference-samples", type=int, default=512)
    parser.add_argument("--reference", action="store_true", help="also the quality `reference`")
    parser.add_argument("--slack", type=float, default=SLACK, help="allowed excess of light paths")
    parser.add_argument(
        "--time-slack", type=float, default=TIME_SLACK, help="allowed excess of processor time"
    )
    parser.add_argument("--out", type=Path, default=RESULTS / "qualities")
    arguments = parser.parse_args()
    qualities = "quality=draft,standard" + (",reference" if arguments.reference else "")
    options = SweepOptions(
        configurations=tuple(range(arguments.configurations)),
        size=tuple(arguments.size),
        views=arguments.views,
        reference_samples=arguments.reference_samples,
        sweeps=(FIXED, qualities),
        with_factorial=False,
    )
    folder = planned_rooms(arguments.out, arguments.configurations)
    sweep = Sweep(folder, arguments.out / "sweep", options)
    fixed = [setting for setting in sweep.settings if not setting.quality]
    sweep.settings += [replace(setting, irradiance_cache=1, firefly_clamp=CLAMP) for setting in fixed]
    points = points_of(sweep.run(lambda what, _: print(what, file=sys.stderr)))
    found = excesses(points)
    head = ("setting", "relMSE", "worst room", "light paths", "processor s", "excess: paths", "excess: time")
    rows = []
    for p in sorted(points, key=lambda p: p.rel_mse, reverse=True):
        name = p.setting.quality or f"{p.setting.path_samples} paths"
        name += ", cached" if p.setting.irradiance_cache else ""
        excess = found.get(p.setting.quality)
        cells = [f"{value:.2f}" for value in excess.values()] if excess else ["", ""]
        errors = (f"{p.rel_mse:.5f}", f"{p.worst_rel_mse:.5f}")
        rows.append([name, *errors, f"{p.path_samples:.1f}", f"{p.cpu_s:.2f}", *cells])
    print(markdown(head, rows))
    result = {"points": [as_row(p) for p in points], "excess": found, **sweep.description()}
    write_report(result, arguments.out / "bench_qualities.json", is_printed=False)
    limits = {"path_samples": arguments.slack, "cpu_s": arguments.time_slack}
    beaten = [f"{q}: {kind} {e[kind]:.2f}" for q, e in found.items() for kind in e if e[kind] > limits[kind]]
    if beaten:
        print(f"no longer on the front: {'; '.join(beaten)}", file=sys.stderr)
        raise SystemExit(1)


if __name__ == "__main__":
    main()
