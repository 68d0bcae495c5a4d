# SPDX-License-Identifier: MIT
"""Sweeps of settings for error and time: Pareto front, recommendation, and a real sweep of three settings."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from datagen.foundation.errors import InputError
from datagen.rendering.textures import box_filtered
from datagen.tradeoff.command import tradeoff
from datagen.tradeoff.selection import (
    Point,
    comparable,
    excess_over_front,
    front_of,
    pareto_front,
    points_of,
    recommend,
)
from datagen.tradeoff.settings import FACTORIAL, SWEEPS, Setting, planned_settings
from datagen.tradeoff.sweep import Sweep, SweepOptions
from datagen.tradeoff.writing import Results, csv_columns, front_figure, sweeps_figure
from mitsuba_plugins.variant import has_cuda
from tests.datagen.small_plan import plan_small

BASE = Setting()
APP = typer.Typer()
APP.command()(tradeoff)
OPTIONS = SweepOptions(
    size=(24, 16),
    views=2,
    reference_samples=128,
    sweeps=("path_samples=1,32",),
    with_factorial=False,
    variant="llvm_ad_rgb",
)
FLAGS = ["--size", "24", "16", "--views", "2", "--reference-samples", "128", "--variant", "llvm_ad_rgb"]
FLAGS += ["--sweep", "path_samples=1,32", "--no-factorial"]


def point(cpu_s: float, rel_mse: float, **changes: object) -> Point:
    setting = replace(BASE, **changes)
    return Point(setting, rel_mse, rel_mse, 0.01, 0.02, 1000.0, 8.0, cpu_s, cpu_s)


# ---- choice

costs = st.integers(0, 8).map(float)


@settings(deadline=None)  # a busy machine must not fail the test
@given(st.lists(st.tuples(costs, costs), max_size=30))
def test_front_contains_the_undominated_points(pairs: list[tuple[float, float]]) -> None:
    front = pareto_front([c for c, _ in pairs], [e for _, e in pairs])

    def beats(a: tuple[float, float], b: tuple[float, float]) -> bool:
        return a[0] <= b[0] and a[1] <= b[1] and a != b

    unbeaten = {p for p in pairs if not any(beats(other, p) for other in pairs)}
    assert {pairs[k] for k in front} == unbeaten
    assert len(front) == len(unbeaten)  # equal pairs occur once
    assert [pairs[k] for k in front] == sorted(unbeaten)


@settings(deadline=None)  # a busy machine must not fail the test
@given(st.lists(st.tuples(st.floats(0.01, 10), st.floats(1e-4, 1)), min_size=1), st.floats(1e-4, 1))
def test_recommendation_meets_the_error_at_the_least_cost(
    pairs: list[tuple[float, float]], limit: float
) -> None:
    points = [point(c, e, path_samples=k + 1) for k, (c, e) in enumerate(pairs)]
    reachable = [c for c, e in pairs if e <= limit]
    if not reachable:
        with pytest.raises(InputError, match="at best"):
            recommend(points, BASE, {"rel_mse": limit})
        return
    chosen = recommend(points, BASE, {"rel_mse": limit})
    assert chosen.rel_mse <= limit
    assert chosen.cpu_s == min(reachable)


def test_only_rendering_settings_are_recommended() -> None:
    cheap = point(0.1, 0.001, best_views=4)  # defines other statistics rather than a cheaper rendering
    small = point(0.1, 0.001, image_scale=0.5)
    fair = point(1.0, 0.001, path_samples=16)
    assert comparable([cheap, small, fair], BASE) == [fair]
    assert recommend([cheap, small, fair], BASE, {"rel_mse": 0.01}) is fair
    assert front_of([cheap, small, fair], BASE) == [fair]
    with pytest.raises(InputError, match="maps_error"):
        recommend([fair], BASE, {"rel_mse": 0.01, "maps_error": 0.001})


def test_excess_over_the_front() -> None:
    front = [point(1.0, 0.1), point(4.0, 0.001, path_samples=64)]
    assert excess_over_front(point(2.0, 0.01), front) == pytest.approx(1.0)  # on the front, in log-log scale
    assert excess_over_front(point(3.0, 0.01), front) == pytest.approx(1.5)
    assert excess_over_front(point(9.0, 0.0005), front) == 0.0  # no other point reaches that error
    assert excess_over_front(point(2.0, 0.5), front) == pytest.approx(2.0)  # worse than the cheapest


def test_points_are_means_over_configurations() -> None:
    from datagen.tradeoff.trial import Trial

    def trial(configuration: str, rel_mse: float, **changes: object) -> Trial:
        setting = replace(BASE, **changes).__dict__
        return Trial(
            configuration, dict(setting), rel_mse, [], 0.1, {}, 0.2, 10, 8.0, 1.0, 2.0, {}, {}, 0.0, 1
        )

    found = points_of([trial("a", 0.1), trial("b", 0.3), trial("a", 0.5, path_samples=2)])
    assert [p.setting for p in found] == [BASE]  # the other setting lacks a trial of configuration b
    assert (found[0].rel_mse, found[0].worst_rel_mse) == (pytest.approx(0.2), 0.3)


# ---- planned trials


def test_every_setting_is_planned_once() -> None:
    planned = planned_settings(BASE, tuple(SWEEPS), True)
    assert len(set(planned)) == len(planned)
    assert planned[0] == BASE
    size = np.prod([len(values) for values in FACTORIAL.values()])
    assert sum(set(s.differences(BASE)) <= set(FACTORIAL) for s in planned) >= size
    for name, values in SWEEPS.items():
        expected = {getattr(BASE, name), *values}
        found = {getattr(s, name) for s in planned if set(s.differences(BASE)) <= {name, "denoiser"}}
        assert found == expected


def test_wrong_sweeps_are_refused_together() -> None:
    wrong = ("samples", "best_views=2", "path_samples=0", "denoiser=magic", "max_depth=many")
    with pytest.raises(InputError) as caught:
        planned_settings(BASE, wrong, False)
    assert len(caught.value.problems) == len(wrong)
    assert "one of quality" not in str(caught.value) and "path_samples" in str(caught.value)


def test_averaged_textures_keep_their_mean() -> None:
    values = np.random.default_rng(0).random((8, 12, 3), np.float32)
    small = box_filtered(values, 4)
    assert small.shape == (2, 3, 3)
    np.testing.assert_allclose(small[1, 2], values[4:8, 8:12].mean(axis=(0, 1)), rtol=1e-6)
    assert box_filtered(values[:3, :3, 0], 8).shape == (1, 1)
    np.testing.assert_allclose(box_filtered(values[:3, :3, 0], 8)[0, 0], values[:3, :3, 0].mean(), rtol=1e-6)


# ---- figures


def test_the_front_marks_settings_unlike_the_base() -> None:
    base = replace(BASE, max_depth=12, firefly_clamp=10.0)
    points = [replace(point(1.0, 0.1), setting=replace(base, **c)) for c in ({}, {"max_depth": 8})]
    (axes,) = front_figure(points, Results([], base, [], {})).axes
    assert [line.get_marker() for line in axes.lines[:2]] == ["o", "x"]


def test_values_of_a_sweep_are_in_order() -> None:
    points = [point(1.0, 0.1, path_samples=n) for n in (BASE.path_samples, 256, 128, 2)]
    points += [point(1.0, 0.1, denoiser=mode) for mode in ("unguided", "none")]
    figure = sweeps_figure(points, BASE)
    assert figure is not None
    shown = {axes.get_title().split()[0]: list(axes.lines[0].get_xdata()) for axes in figure.axes}
    assert shown == {
        "path_samples": ["2", "8", "128", "256"],
        "denoiser": ["none", "high", "unguided"],
    }


# ---- a sweep


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the folders of a plan and of its sweep, which was interrupted after one trial and resumed."""
    root = tmp_path_factory.mktemp("tradeoff")
    folder = plan_small(root / "plan", root / "library", num_units=1, num_views=3).root
    sweep = Sweep(folder, root / "out", OPTIONS)
    assert (len(sweep.pending()), sweep.missing_views()) == (3, 2)

    def interrupt(what: str, steps: int) -> None:
        if "reference" not in what:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep.run(interrupt)
    assert (len(sweep.pending()), sweep.missing_views()) == (2, 0)
    before = _times(root / "out")
    assert len(Sweep(folder, root / "out", OPTIONS).run()) == 3
    after = _times(root / "out")
    assert {path: after[path] for path in before} == before  # no trial was repeated
    return folder, root / "out"


def _times(out: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in out.rglob("*.*") if path.is_file()}


def test_more_samples_are_closer_to_the_reference(swept: tuple[Path, Path]) -> None:
    errors = {t.setting["path_samples"]: t.rel_mse for t in Sweep(*swept, OPTIONS).trials()}
    assert errors[32] < errors[8] < errors[1]


def test_results_and_recommendation_are_written(swept: tuple[Path, Path]) -> None:
    folder, out = swept
    kept = {path: t for path, t in _times(out).items() if path.suffix == ".npz" or "trials" in path.parts}
    trials = {t.setting["path_samples"]: t for t in Sweep(folder, out, OPTIONS).trials()}
    limit = 1.01 * trials[32].rel_mse
    arguments = [str(folder), "--out", str(out), *FLAGS, "--max-rel-mse", str(limit)]
    done = CliRunner().invoke(APP, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "recommended: path_samples 32:" in done.output
    assert {path: t for path, t in _times(out).items() if path in kept} == kept  # all from the cache

    with (out / "tradeoff.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == csv_columns()
    assert {int(row["samples_asked"]) for row in rows} == {1, 8, 32}
    for row in rows:
        trial = trials[int(row["samples_asked"])]
        assert float(row["rel_mse"]) == trial.rel_mse and int(row["bytes_a_view"]) == trial.bytes_a_view
        stages = sum(float(row[f"{name}_cpu_s"]) for name in ("learn", "render", "statistics", "compress"))
        assert float(row["cpu_s"]) == pytest.approx(stages) and float(row["cpu_s"]) > 0
    summary = json.loads((out / "tradeoff.json").read_text())
    assert summary["recommended"]["rel_mse"] <= limit
    assert {p["path_samples"] for p in summary["front"]} <= {1, 8, 32}
    page = (out / "tradeoff.html").read_text()
    assert page.count("data:image/png;base64,") == 2 and "http" not in page.replace("http-equiv", "")
    for name in ("front.png", "sweeps.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")


def test_an_unreachable_error_is_refused_with_the_best(swept: tuple[Path, Path]) -> None:
    folder, out = swept
    arguments = [str(folder), "--out", str(out), *FLAGS, "--max-rel-mse", "1e-9"]
    with pytest.raises(InputError, match=r"rel_mse = .* at best; expected at most 1e-09"):
        CliRunner().invoke(APP, arguments, catch_exceptions=False)
    assert (out / "tradeoff.csv").is_file()


def test_dry_run_writes_nothing(swept: tuple[Path, Path], tmp_path: Path) -> None:
    folder, _ = swept
    arguments = [str(folder), "--out", str(tmp_path / "new"), *FLAGS, "--dry-run"]
    done = CliRunner().invoke(APP, [*arguments, "--sweep", "variant"], catch_exceptions=False)
    assert "0 of" in done.output and "2 views of references" in done.output
    assert ("not available on this machine" in done.output) != has_cuda()
    assert not (tmp_path / "new").exists()


def test_references_with_more_samples_than_seeds_are_refused(
    swept: tuple[Path, Path], tmp_path: Path
) -> None:
    Sweep(swept[0], tmp_path / "new", replace(OPTIONS, reference_samples=65536))
    with pytest.raises(InputError, match=r"--reference-samples.*65537; expected at most 65536"):
        Sweep(swept[0], tmp_path / "new", replace(OPTIONS, reference_samples=65537))


def test_changed_options_invalidate_trials(swept: tuple[Path, Path]) -> None:
    folder, out = swept
    for change in ({"reference_samples": 256}, {"size": (32, 16)}, {"views": 3}):
        other = Sweep(folder, out, replace(OPTIONS, **change))
        assert other.missing_views() == other.options.views
        assert len(other.pending()) == 3
    with pytest.raises(InputError, match="configuration"):
        Sweep(folder, out, replace(OPTIONS, configurations=(7,)))


def test_a_sweep_describes_what_it_measures(swept: tuple[Path, Path], tmp_path: Path) -> None:
    sweep = Sweep(swept[0], tmp_path / "new", replace(OPTIONS, views=5, configurations=(0, 0)))
    assert len(sweep.subjects) == 1 and len(sweep.pending()) == 3
    assert sweep.description()["views"] == "3 of 24x16 per configuration"
