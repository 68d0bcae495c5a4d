# SPDX-License-Identifier: MIT
"""Time of our renderer and of Blender's Cycles at equal error, for a configuration of the bundled library.

    python -m benchmarks.bench_cycles                      40 views of 640x384 at `standard`; takes hours
    python -m benchmarks.bench_cycles --size 160 96 --cycles-views 4 --error-views 4              half an hour
    python -m benchmarks.bench_cycles --seed 2022 2023     two rooms
    python -m benchmarks.bench_cycles --cycles-views 40    Cycles renders every view instead of a sample
    python -m benchmarks.bench_cycles --views 4 --size 96 64 --quality draft --out /tmp/cycles   a quick look

Our time is that of ``datagen run --unit`` on a planned folder, from the start of the process to the finished
shard: loading, compilation, paths, buffers, denoiser, statistics of all views, compression. It is measured
with an empty and with a filled kernel cache.

The baseline is bpy as used by BlenderProc (cycles_baseline.py): one process, persistent data, path tracing
with the same number of segments, OIDN with prefiltered albedo and normal, one EXR per view with depth,
normal, diffuse and glossy colour, object and material index. Its scene is a .blend file of the same
configuration, whose creation is not timed. Roughness, multi-view statistics and error control are missing.

The error is the exposed relMSE (``datagen.rendering.error``) of denoised images of ``--error-views`` views,
against two independent converged images by the same renderer, because the renderers' materials differ by more
than the target error (their agreement is reported; if it is poor, the exit code is 1). The references have
neither a clamp nor Blender's *filter glossy*, so the energy that these remove counts as an error. Cycles'
sample count is doubled until the error is at most ours and then interpolated logarithmically, for three
settings: Blender's defaults with a uniform sample count, Cycles' adaptive sampling, and neither clamp nor
filter. The baseline is the fastest of the three or, if none reaches the error, the one of smallest error.

Results of steps are stored in --out and reused, so the same command resumes. ``--cycles-views N`` renders N
views with Cycles; the time of 40 views is then the fixed part + 40 x the median of a view. The images an hour
of each named quality and each sample count of Cycles are extrapolated likewise from the error views; the
figure ``bench_cycles.png`` shows the error against them.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import OpenEXR
from numpy.typing import NDArray

from benchmarks.timing import RESULTS, launch, machine, markdown, write_report
from datagen.farm.folder import DatasetFolder
from datagen.formats.base import canonical_json, sha256_hex, write_bytes_atomically
from datagen.formats.recipe import QUALITIES, ObjectRecipe, Recipe, RenderRecipe
from datagen.formats.shard import ShardReader
from datagen.foundation.color import luminance
from datagen.foundation.exr import decode_view
from datagen.foundation.versions import pixel_versions
from datagen.rendering.error import relative_mse

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIRST_SAMPLES = 4
UNBIASED = ("--clamp", "0", "--filter-glossy", "0")
"""Options that disable clamping and the roughening of surfaces after diffuse bounces, for references."""
KINDS: dict[str, tuple[str, ...]] = {"fixed": (), "adaptive": ("--adaptive",), "unbiased": UNBIASED}
"""Options of each compared setting of Cycles, by name."""
MIN_TIMED = 3  # views: the first includes the fixed part, the others determine the median


def recipe_of(arguments: argparse.Namespace, seed: int) -> Recipe:
    """Recipe of the configuration that is rendered."""
    return Recipe(
        name="cycles",
        seed=seed,
        configurations=1,
        views=arguments.views,
        resolution=tuple(arguments.size),
        objects=ObjectRecipe(count=(10, 24)),
        render=RenderRecipe.model_validate({"quality": arguments.quality}),
    )


def step(path: Path, make: Callable[[], Any]) -> Any:
    """Read the JSON file ``path``; if it is missing, first write the result of ``make`` to it."""
    if not path.is_file():
        write_bytes_atomically(path, (json.dumps(make(), indent=1) + "\n").encode())
    return json.loads(path.read_text(encoding="utf-8"))


def timed(*command: str, log: Path, environment: dict[str, str] | None = None) -> dict[str, float]:
    """Run a Python module in a separate process; returns the start (epoch), wall and processor seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began, start = time.time(), time.perf_counter()
    launch(*command, log=log, environment=environment)
    wall = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"began": began, "wall_s": round(wall, 3), "cpu_s": round(cpu, 3)}


def read_cycles(path: Path) -> NDArray[np.float32]:
    """The beauty image (H, W, 3) of an EXR rendered by Cycles."""
    with OpenEXR.File(str(path)) as file:
        (combined,) = [c for name, c in file.channels().items() if name.endswith("Combined")]
        return np.asarray(combined.pixels[..., :3], np.float32)


class Comparison:
    """The steps of the comparison with Cycles, in order; each stores its result in ``folder``."""

    def __init__(self, arguments: argparse.Namespace, seed: int):
        self.arguments = arguments
        self.recipe = recipe_of(arguments, seed)
        key = {"recipe": self.recipe.model_dump(mode="json"), "versions": pixel_versions()}
        self.folder: Path = arguments.out / sha256_hex(canonical_json(key))[:12]
        self.folder.mkdir(parents=True, exist_ok=True)
        count = min(arguments.error_views, arguments.views)
        self.error_views = [round((k + 0.5) * arguments.views / count - 0.5) for k in range(count)]
        self.depth = str(self.recipe.render.max_depth)

    # ---------------------------------------------------------------- the same room for both

    def prepare(self) -> None:
        """Plan the room, export it, and convert the export to a .blend."""
        plan = self.folder / "plan"
        if not (plan / "plan.json").is_file():
            path = self.folder / "recipe.yaml"
            path.write_bytes(canonical_json(self.recipe))  # JSON is YAML
            timed("datagen", "plan", str(path), "--out", str(plan), log=self.folder / "plan.log")
        blend, export = self.folder / "room.blend", self.folder / "export"
        if not blend.is_file():
            shutil.rmtree(export, ignore_errors=True)
            log = self.folder / "export.log"
            timed("benchmarks.studies.cycles_scene", "export", str(plan), str(export), log=log)
            timed("benchmarks.studies.cycles_baseline", "build", str(export), str(blend), log=log)

    def rendered(self, name: str, module: str, *command: str) -> dict[str, Any]:
        """Run ``command`` of a module that renders views and writes ``times.json`` into ``folder/name``.

        Returns seconds: of the process, until the scene is loaded, and of each view.
        """
        out = self.folder / name

        def make() -> dict[str, Any]:
            run = timed(module, *command, log=self.folder / f"{name}.log")
            times = json.loads((out / "times.json").read_text(encoding="utf-8"))
            loaded = times.pop("loaded")
            seconds = np.diff([loaded, *times.pop("finished")]).round(4).tolist()
            return {**run, "start_s": round(loaded - run["began"], 3), "views_s": seconds, **times}

        return step(self.folder / f"{name}.json", make)

    def cycles(self, name: str, views: list[int], samples: int, *options: str) -> dict[str, Any]:
        """Render ``views`` with Cycles into ``folder/name``; returns the result of :meth:`rendered`."""
        command = ["render", str(self.folder / "room.blend"), str(self.folder / name), *map(str, views)]
        command += ["--samples", str(samples), "--max-depth", self.depth, *options]
        return self.rendered(name, "benchmarks.studies.cycles_baseline", *command)

    def quality(self, quality: str, pairs: dict[int, Any]) -> dict[str, float]:
        """Images an hour and error of a named ``quality``, from the error views."""
        name = f"quality_{quality}_{len(self.error_views)}"
        command = ["quality", str(self.folder / "plan"), str(self.folder / name)]
        command += [*map(str, self.error_views), "--quality", quality]
        run = self.rendered(name, "benchmarks.studies.cycles_scene", *command)
        errors = []
        for view in self.error_views:
            image = decode_view((self.folder / name / f"view_{view:03}.exr").read_bytes(), ["beauty"])
            errors.append(relative_mse(image["beauty"].astype(np.float32), *pairs[view], exposed=True))
        # the mean, not the median as for Cycles: two views are in progress at a time and may finish together
        total_s = run["start_s"] + self.arguments.views * statistics.fmean(run["views_s"])
        return {"rel_mse": float(np.mean(errors)), "images_an_hour": 3600 * self.arguments.views / total_s}

    # ---------------------------------------------------------------- errors

    def references(self) -> dict[str, Any]:
        """Render two converged images (H, W, 3) of each error view, by renderer and view."""
        samples = str(self.arguments.reference_samples)
        out = self.folder / f"our_references_{samples}"
        views = [str(v) for v in self.error_views]
        if not all((out / f"view_{int(v):03}.npz").is_file() for v in views):
            plan = str(self.folder / "plan")
            command = ("reference", plan, str(out), *views, "--samples", samples)
            timed("benchmarks.studies.cycles_scene", *command, log=self.folder / "references.log")
        pairs: dict[str, Any] = {"ours": {}, "cycles": {}}
        for view in self.error_views:
            with np.load(out / f"view_{view:03}.npz") as data:
                pairs["ours"][view] = (data["first"], data["second"])
            halves = []
            for half in (0, 1):
                name = f"cycles_unbiased_reference_{samples}_{view}_{half}"
                self.cycles(name, [view], int(samples), "--noisy", "--seed", str(100 + half), *UNBIASED)
                halves.append(read_cycles(self.folder / name / f"view_{view:03}.exr"))
            pairs["cycles"][view] = tuple(halves)
        return pairs

    @staticmethod
    def agreement(pairs: dict[str, Any]) -> dict[str, Any]:
        """Ratio of means (Cycles : ours) and correlation of the renderers' blurred references, by view."""
        ratios, correlations = [], []
        for view, (a, b) in pairs["ours"].items():
            ours, cycles = luminance(0.5 * (a + b)), luminance(0.5 * sum(pairs["cycles"][view]))
            ratios.append(float(cycles.mean() / ours.mean()))
            blurred = [
                cv2.GaussianBlur(np.minimum(i, 4 * np.percentile(i, 95)).astype(np.float32), (0, 0), 2)
                for i in (ours, cycles)
            ]
            correlations.append(float(np.corrcoef(blurred[0].ravel(), blurred[1].ravel())[0, 1]))
        return {
            "ratio_of_means": [round(r, 4) for r in ratios],
            "correlation": [round(c, 4) for c in correlations],
        }

    def cycles_error(self, name: str, pairs: dict[int, Any]) -> float:
        """Mean error of Cycles' images in ``folder/name`` over the error views among them."""
        found = {v: self.folder / name / f"view_{v:03}.exr" for v in self.error_views}
        errors = [
            relative_mse(read_cycles(p), *pairs[v], exposed=True) for v, p in found.items() if p.is_file()
        ]
        return float(np.mean(errors))

    def cycles_at(self, target: float, pairs: dict[int, Any], kind: str) -> dict[str, Any]:
        """Time and error of Cycles at the sample count for error ``target``; ``kind`` is one of ``KINDS``."""
        arguments, options = self.arguments, KINDS[kind]
        samples, curve, speeds = self.cycles_samples(target, pairs, kind, options)
        count = max(MIN_TIMED, min(arguments.cycles_views, arguments.views))
        rest = [v for v in range(arguments.views) if v not in self.error_views]
        chosen = rest[:: max(1, len(rest) // max(1, count - len(self.error_views)))]
        views = sorted([*self.error_views, *chosen[: max(0, count - len(self.error_views))]])
        used = samples or max(curve)
        name = f"cycles_{kind}_timed_{used}_{len(views)}_{len(self.error_views)}"
        cycles = self.cycles(name, views, used, *options)
        return {
            **cycles,
            "samples": used,
            "sampling": kind,
            "reached": samples is not None,
            "rel_mse": self.cycles_error(name, pairs),
            "curve": {str(k): v for k, v in curve.items()},
            "images_an_hour": {str(k): v for k, v in speeds.items()},
            **extrapolated(cycles, arguments.views),
        }

    def cycles_samples(
        self, target: float, pairs: dict[int, Any], kind: str, options: tuple[str, ...]
    ) -> tuple[int | None, dict[int, float], dict[int, float]]:
        """Sample count of error ``target`` (None if not reached); errors and images an hour by count."""
        curve: dict[int, float] = {}
        speeds: dict[int, float] = {}
        samples = FIRST_SAMPLES
        while samples <= self.arguments.max_cycles_samples:
            name = f"cycles_{kind}_{samples}_{len(self.error_views)}"
            run = self.cycles(name, self.error_views, samples, *options)
            total_s = extrapolated(run, self.arguments.views)["total_wall_s"]
            curve[samples] = self.cycles_error(name, pairs)
            speeds[samples] = 3600 * self.arguments.views / total_s
            print(f"cycles, {kind}, {samples} samples: relMSE {curve[samples]:.5f}", file=sys.stderr)
            if curve[samples] <= target:
                return interpolated(curve, target), curve, speeds
            samples *= 2
        return None, curve, speeds

    # ---------------------------------------------------------------- time

    def ours(self, name: str, *, is_cold: bool) -> dict[str, Any]:
        """Time ``datagen run --unit`` on a copy of the plan, with an empty kernel cache if ``is_cold``."""
        root = self.folder / name

        def make() -> dict[str, Any]:
            shutil.rmtree(root, ignore_errors=True)
            shutil.copytree(self.folder / "plan", root)
            with tempfile.TemporaryDirectory() as home:
                environment = {"HOME": home} if is_cold else {}  # Dr.Jit keeps kernels in ~/.drjit
                command = ("datagen", "run", str(root), "--unit", "0", "--attempts", "0")
                return timed(*command, log=self.folder / f"{name}.log", environment=environment)

        return step(self.folder / f"{name}.json", make)

    def our_views(self, name: str) -> tuple[dict[int, NDArray], list[dict[str, Any]], int]:
        """Beauty of the error views, render records of all views, and the shard's size in bytes."""
        folder = DatasetFolder(self.folder / name)
        (unit,) = folder.read_plan().units
        manifest = folder.read_manifest(unit)
        assert manifest is not None
        images, records = {}, []
        for index, view in enumerate(ShardReader(folder.root / manifest.shard, ("beauty",))):
            records.append(view.record.render.model_dump(mode="json"))
            if index in self.error_views:
                images[index] = view.buffers["beauty"].astype(np.float32)
        return images, records, manifest.num_bytes

    def run(self) -> dict[str, Any]:
        """Run all steps; returns the content of ``bench_cycles.json``."""
        arguments = self.arguments
        self.prepare()
        pairs = self.references()
        cold = self.ours("ours_cold", is_cold=True)
        warm = [self.ours(f"ours_warm_{k}", is_cold=False) for k in range(arguments.repeats)]
        images, records, num_bytes = self.our_views("ours_cold")
        our_errors = {v: relative_mse(i, *pairs["ours"][v], exposed=True) for v, i in images.items()}
        target = float(np.mean(list(our_errors.values())))
        print(f"ours: relMSE {target:.5f}", file=sys.stderr)
        runs = [self.cycles_at(target, pairs["cycles"], kind) for kind in KINDS]
        runs.sort(key=rank)
        warm_wall = statistics.median(run["wall_s"] for run in warm) if warm else None
        result: dict[str, Any] = {
            "machine": machine(),
            "versions": pixel_versions(),
            "recipe": self.recipe.model_dump(mode="json"),
            "views": arguments.views,
            "error_views": self.error_views,
            "agreement": self.agreement(pairs),
            "ours": {
                "cold": cold,
                "warm": warm,
                "warm_wall_s": warm_wall,
                "rel_mse": target,
                "rel_mse_by_view": {str(k): v for k, v in our_errors.items()},
                "path_samples": [r["path_samples"] for r in records],
                "at_ceiling": sum(r["at_ceiling"] for r in records),
                "clamped_energy": statistics.median(r["clamped_energy"] for r in records),
                "megabytes": num_bytes / 1e6,
            },
            "qualities": {name: self.quality(name, pairs["ours"]) for name in arguments.qualities},
            "cycles": runs[0],
            "slower_cycles": runs[1:],
        }
        total = result["cycles"]["total_wall_s"]
        result["speedup_cold"] = total / cold["wall_s"]
        result["speedup_warm"] = total / warm_wall if warm_wall else None
        result["speedup_cpu"] = result["cycles"]["total_cpu_s"] / cold["cpu_s"]
        return result


def rank(cycles: dict[str, Any]) -> tuple[float, ...]:
    """Sort key of Cycles' settings: those that reach the error, by time, then the others, by error."""
    return (0.0, cycles["total_cpu_s"]) if cycles["reached"] else (1.0, round(math.log(cycles["rel_mse"]), 2))


def agrees(agreement: dict[str, Any]) -> bool:
    """True if converged images of both renderers agree in brightness and structure."""
    ratios, correlations = agreement["ratio_of_means"], agreement["correlation"]
    return all(0.8 < ratio < 1.25 for ratio in ratios) and min(correlations) > 0.85


def interpolated(curve: dict[int, float], target: float) -> int:
    """Sample count at which ``curve`` (error by count) reaches ``target``, between its last two points."""
    *before, high = sorted(curve)
    if not before:
        return high
    low = before[-1]
    fall = math.log(curve[low] / curve[high])
    share = math.log(curve[low] / target) / fall if fall > 0 else 1.0
    return math.ceil(math.exp(math.log(low) + min(1.0, share) * math.log(high / low)))


def extrapolated(run: dict[str, Any], views: int) -> dict[str, float]:
    """Seconds of the fixed part (with the excess of the first view), of one view and of ``views`` views.

    ``run`` is a result of ``Comparison.cycles``. Processor seconds are scaled like wall seconds.
    """
    a_view = statistics.median(run["views_s"][1:] or run["views_s"])
    leaving = run["wall_s"] - run["start_s"] - sum(run["views_s"])
    fixed = run["start_s"] + max(0.0, run["views_s"][0] - a_view) + leaving
    is_complete = len(run["views_s"]) == views
    total = run["wall_s"] if is_complete else fixed + views * a_view
    return {
        "fixed_wall_s": round(fixed, 3),
        "a_view_wall_s": round(a_view, 3),
        "total_wall_s": round(total, 2),
        "total_cpu_s": round(run["cpu_s"] * total / run["wall_s"], 2),
        "is_extrapolated": not is_complete,
    }


def table(result: dict[str, Any]) -> str:
    """Markdown table of the result."""
    ours, cycles, views = result["ours"], result["cycles"], result["views"]
    width, height = result["recipe"]["resolution"]
    machine_text = f"{result['machine']['cores']} cores of {result['machine']['processor']}"
    rows = [("ours, empty kernel cache", ours["cold"]["wall_s"], ours["cold"]["cpu_s"], ours["rel_mse"])]
    if ours["warm_wall_s"]:
        cpu = statistics.median(run["cpu_s"] for run in ours["warm"])
        rows.append(("ours, kernels cached", ours["warm_wall_s"], cpu, ours["rel_mse"]))
    label = f"Cycles {cycles['blender']}, {cycles['samples']} samples, {cycles['sampling']}" + (
        "" if cycles["reached"] else " (error not reached)"
    )
    rows.append((label, cycles["total_wall_s"], cycles["total_cpu_s"], cycles["rel_mse"]))
    head = ("renderer", "wall s", "processor s", "images an hour", "relMSE", "times as fast as Cycles")
    cells = [
        (name, f"{wall:.1f}", f"{cpu:.1f}", f"{3600 * views / wall:,.0f}", f"{error:.4f}",
         f"{cycles['total_wall_s'] / wall:.1f}")
        for name, wall, cpu, error in rows
    ]  # fmt: skip
    seed = result["recipe"]["seed"]
    lines = [f"Seed {seed}, {views} views of {width}x{height}, {machine_text}:", "", markdown(head, cells)]
    if cycles["is_extrapolated"]:
        lines += [
            "",
            f"Cycles' figures: {cycles['fixed_wall_s']:.1f} s + {views} x {cycles['a_view_wall_s']:.2f} s, "
            f"from {len(cycles['views_s'])} views.",
        ]
    agreement = result["agreement"]
    lines += [
        "",
        f"Converged images, cycles : ours: means {min(agreement['ratio_of_means']):.3f} to "
        f"{max(agreement['ratio_of_means']):.3f}, correlation from {min(agreement['correlation']):.3f}.",
    ]
    return "\n".join(lines)


def figure_of(results: list[dict[str, Any]]) -> Figure:
    """Error against images an hour of each named quality and of Cycles, with a panel per room."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * len(results), 4.2), layout="constrained")
    panels = figure.subplots(1, len(results), squeeze=False, sharex=True, sharey=True)[0]
    for axes, result in zip(panels, results, strict=True):
        ours, cycles = result["qualities"], result["cycles"]
        qualities = {name: (found["images_an_hour"], found["rel_mse"]) for name, found in ours.items()}
        counts = {
            samples: (speed, cycles["curve"][samples]) for samples, speed in cycles["images_an_hour"].items()
        }
        for points, style, label in (
            (qualities, {"marker": "*", "ls": "", "ms": 12, "color": "#009e73"}, "named qualities"),
            (counts, {"marker": "o", "ms": 4, "color": "#0072b2"}, f"Cycles {cycles['blender']}, samples"),
        ):
            axes.plot(*zip(*points.values(), strict=True), label=label, **style)
            for name, at in points.items():
                axes.annotate(name, at, (6, 4), textcoords="offset points", fontsize=8)
        axes.set(xscale="log", yscale="log", xlabel="images an hour")
        axes.set_title(f"seed {result['recipe']['seed']}")
        axes.margins(x=0.15)  # space for the names of qualities
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("" if axis is axes.xaxis else "{x:g}")
        axes.tick_params(which="minor", labelsize=7)
        axes.grid(which="both", alpha=0.25)
    panels[0].set_ylabel("relMSE")
    panels[0].legend(fontsize=8)
    return figure


def main() -> None:
    """Run the command, which writes ``bench_cycles.json``, ``.md`` and ``.png``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quality", choices=tuple(QUALITIES), default="standard")
    parser.add_argument("--seed", type=int, nargs="+", default=[2022], help="seeds: one room each")
    parser.add_argument("--qualities", nargs="+", choices=tuple(QUALITIES), default=list(QUALITIES))
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 384))
    parser.add_argument("--cycles-views", type=int, default=8, help="views rendered by Cycles for timing")
    parser.add_argument("--error-views", type=int, default=3)
    parser.add_argument(
        "--reference-samples", type=int, default=1024, help="paths per pixel in each of two references"
    )
    parser.add_argument("--max-cycles-samples", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=1, help="runs of our renderer with cached kernels")
    parser.add_argument("--out", type=Path, default=RESULTS / "cycles")
    arguments = parser.parse_args()
    results = [Comparison(arguments, seed).run() for seed in arguments.seed]
    write_report(results, arguments.out / "bench_cycles.json", is_printed=False)
    text = "\n\n".join(map(table, results))
    (arguments.out / "bench_cycles.md").write_text(text + "\n", encoding="utf-8")
    figure_of(results).savefig(arguments.out / "bench_cycles.png", dpi=110, metadata={"Software": None})
    print(text)
    if not all(agrees(result["agreement"]) for result in results):
        print("the converged images differ too much: the times are not comparable", file=sys.stderr)
        raise SystemExit(1)


if __name__ == "__main__":
    main()
