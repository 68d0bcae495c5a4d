# SPDX-License-Identifier: MIT
"""Writes the results of a sweep as CSV, JSON, two figures and a self-contained HTML page."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from datagen.formats.base import canonical_json, write_bytes_atomically
from datagen.foundation.images import data_url
from datagen.tradeoff.selection import Point, as_row, comparable, front_of, points_of
from datagen.tradeoff.settings import SWEEPS, Setting
from datagen.tradeoff.trial import STAGES, Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURES = tuple(field.name for field in fields(Trial) if field.type in ("float", "int"))
"""Numbers of a trial, which are columns of the CSV file."""
RATIOS = {
    "rel_mse": "relMSE of beauty",
    "maps_error": "error of maps",
    "statistics_error": "error of statistics",
    "cpu_s": "processor time",
    "bytes_a_view": "bytes",
}
_COLORS = {"fast": "#e69f00", "balanced": "#56b4e9", "high": "#0072b2", "none": "#999999"}


@dataclass(frozen=True)
class Results:
    """Trials and conditions of a sweep; ``recommended`` is the cheapest point within the error ``limits``."""

    trials: Sequence[Trial]
    base: Setting
    unavailable: Sequence[Setting]
    description: dict[str, Any]
    recommended: Point | None = None
    limits: dict[str, float] | None = None


def csv_columns() -> list[str]:
    """Names of the columns of the CSV file, in order."""
    setting = [field.name if field.name != "path_samples" else "samples_asked" for field in fields(Setting)]
    return ["configuration", *setting, *MEASURES, *(f"{stage}_cpu_s" for stage in STAGES)]


def write_results(results: Results, out: Path) -> list[Path]:
    """Write ``tradeoff.csv``, ``.json``, ``.html`` and figures to the folder ``out``; return their paths."""
    out.mkdir(parents=True, exist_ok=True)
    points = points_of(results.trials)
    figures = {"front.png": _png(front_figure(points, results))}
    if (sweeps := sweeps_figure(points, results.base)) is not None:
        figures["sweeps.png"] = _png(sweeps)
    content = {
        "tradeoff.csv": _csv(results.trials).encode(),
        "tradeoff.json": canonical_json(_summary(results, points)),
        "tradeoff.html": _page(results, points, figures).encode(),
        **figures,
    }
    for name, data in content.items():
        write_bytes_atomically(out / name, data)
    return [out / name for name in content]


def _csv(trials: Sequence[Trial]) -> str:
    stream = io.StringIO()
    writer = csv.DictWriter(stream, csv_columns(), lineterminator="\n")
    writer.writeheader()
    for trial in trials:
        setting = dict(trial.setting)
        setting["samples_asked"] = setting.pop("path_samples")
        stages = {f"{stage}_cpu_s": trial.stages[stage]["cpu_s"] for stage in STAGES}
        measured = {name: getattr(trial, name) for name in MEASURES}
        writer.writerow({"configuration": trial.configuration, **setting, **measured, **stages})
    return stream.getvalue()


def _summary(results: Results, points: Sequence[Point]) -> dict[str, Any]:
    recommended = results.recommended
    return {
        "description": results.description,
        "base": asdict(results.base),
        "unavailable": [asdict(setting) for setting in results.unavailable],
        "points": [as_row(point) for point in points],
        "front": [as_row(point) for point in front_of(points, results.base)],
        "limits": results.limits,
        "recommended": as_row(recommended) if recommended is not None else None,
        "trials": [asdict(trial) for trial in results.trials],
    }


# ---- figures


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110, metadata={"Software": None})
    return stream.getvalue()


def front_figure(points: Sequence[Point], results: Results) -> Figure:
    """Plot relMSE against processor seconds of comparable settings; mark Pareto front and recommendation."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.4, 5.6), layout="constrained")
    axes = figure.subplots()
    for point in comparable(points, results.base):
        _draw_point(axes, point, results.base)
    front = front_of(points, results.base)
    axes.plot([p.cpu_s for p in front], [p.rel_mse for p in front], "-", color="#333333", lw=1, zorder=1)
    if (best := results.recommended) is not None:
        axes.plot(best.cpu_s, best.rel_mse, "o", ms=16, mfc="none", mec="#d55e00", mew=2)
    if results.limits and "rel_mse" in results.limits:
        axes.axhline(results.limits["rel_mse"], color="#d55e00", lw=1, ls="--")
    axes.set(
        xscale="log", yscale="log", xlabel="processor seconds per view", ylabel="relMSE of the beauty image"
    )
    axes.grid(which="both", alpha=0.25)
    axes.margins(x=0.1)  # space for the names of qualities
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:.3g}" if high < 50 * low else "")  # whole decades have enough labels
    axes.tick_params(which="minor", labelsize=7)
    _add_legend(axes)
    return figure


def _draw_point(axes: Axes, point: Point, base: Setting) -> None:
    setting, at = point.setting, (point.cpu_s, point.rel_mse)
    color = _COLORS.get(setting.denoiser, "#cc79a7")
    if setting.quality:
        axes.plot(*at, "*", ms=15, color="#009e73", mec="black", zorder=3)
        axes.annotate(setting.quality, at, (8, 4), textcoords="offset points", fontsize=9)
        return
    marker = {16: "s", 64: "o"}.get(setting.auxiliary_samples, "D")
    if {"max_depth", "russian_roulette_depth", "firefly_clamp"} & set(setting.differences(base)):
        axes.plot(*at, "x", ms=5, color="#777777")
        return
    edge = "black" if setting.irradiance_cache else color
    axes.plot(*at, marker, ms=6, color=color, mec=edge, mew=1.2, zorder=2)
    axes.annotate(str(setting.path_samples), at, (4, -9), textcoords="offset points", fontsize=7)


def _add_legend(axes: Axes) -> None:
    from matplotlib.lines import Line2D

    names = {"none": "no denoiser", "fast": "OIDN fast", "balanced": "OIDN balanced", "high": "OIDN high"}
    entries = [Line2D([], [], marker="o", ls="", color=_COLORS[k], label=text) for k, text in names.items()]
    entries += [
        Line2D([], [], marker="o", ls="", color="#cc79a7", label="other denoiser"),
        Line2D([], [], marker="s", ls="", color="#333333", label="16 auxiliary samples"),
        Line2D([], [], marker="o", ls="", color="#333333", label="64 auxiliary samples"),
        Line2D([], [], marker="D", ls="", color="#333333", label="other auxiliary samples"),
        Line2D([], [], marker="o", ls="", color="white", mec="black", mew=1.2, label="irradiance cache"),
        Line2D([], [], marker="x", ls="", color="#777777", label="other depth, roulette, clamp"),
        Line2D([], [], marker="*", ls="", ms=11, color="#009e73", mec="black", label="named quality"),
        Line2D([], [], ls="-", color="#333333", label="front; numbers are path samples"),
    ]
    axes.legend(handles=entries, fontsize=8, loc="best")


def sweeps_figure(points: Sequence[Point], base: Setting) -> Figure | None:
    """Plot errors, time and bytes relative to the base, with a panel per swept field; None without sweeps."""
    from matplotlib.figure import Figure

    base_point = next((p for p in points if p.setting == base), None)
    found = {name: _one_at_a_time(points, base, name) for name in SWEEPS if name != "quality"}
    found = {name: some for name, some in found.items() if len(some) > 1}
    if base_point is None or not found:
        return None
    columns = min(4, len(found))
    rows = -(-len(found) // columns)
    figure = Figure(figsize=(3.1 * columns, 2.7 * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (name, some) in zip(panels, found.items(), strict=False):
        values = [str(getattr(p.setting, name)) for p in some]
        for measure, label in RATIOS.items():
            ratios = [getattr(p, measure) / max(getattr(base_point, measure), 1e-12) for p in some]
            axes.plot(values, ratios, "o-", ms=4, lw=1.2, label=label)
        axes.set_yscale("log", base=2)
        axes.axhline(1.0, color="#333333", lw=0.7)
        low, high = axes.get_ylim()
        # a minimum range prevents small differences from looking large
        axes.set_ylim(min(low, 0.5), max(high, 2.0))
        axes.set_title(f"{name} (base {getattr(base, name)})", fontsize=9)
        axes.tick_params(axis="x", labelrotation=45 if max(map(len, values)) > 4 else 0, labelsize=8)
        axes.tick_params(axis="y", labelsize=8)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.grid(alpha=0.25)
    for axes in panels[len(found) :]:
        axes.set_visible(False)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=9)
    figure.supylabel("ratio to the base", fontsize=9)
    return figure


def _one_at_a_time(points: Sequence[Point], base: Setting, name: str) -> list[Point]:
    """Select the base and the points that differ from it only in field ``name``, sorted by its value.

    Strings are sorted as in :data:`SWEEPS`; those not in it, such as the denoiser of a GPU, are last.
    """
    some = [p for p in points if set(p.setting.differences(base)) <= {name}]
    order = {value: k for k, value in enumerate(SWEEPS[name]) if isinstance(value, str)}

    def place(point: Point) -> float:
        value = getattr(point.setting, name)
        return order.get(value, len(order)) if order else float(value)

    return sorted(some, key=place)


# ---- page

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem;
       color: #1b1b1b; background: #fff; }
img { max-width: 100%; } table { border-collapse: collapse; margin: 1rem 0; font-size: 13px; }
th, td { border: 1px solid #ccc; padding: .2rem .5rem; text-align: right; } th { background: #f2f2f2; }
td:first-child, th:first-child { text-align: left; } .wide { overflow-x: auto; }
"""
_COLUMNS = {
    "rel_mse": ("relMSE", "{:.5f}"),
    "worst_rel_mse": ("worst configuration", "{:.5f}"),
    "maps_error": ("maps", "{:.4f}"),
    "statistics_error": ("statistics", "{:.4f}"),
    "path_samples": ("samples", "{:.1f}"),
    "cpu_s": ("processor s", "{:.3f}"),
    "wall_s": ("wall s", "{:.3f}"),
    "bytes_a_view": ("bytes", "{:,.0f}"),
}


def _page(results: Results, points: Sequence[Point], figures: dict[str, bytes]) -> str:
    parts = ["<h1>Error against time</h1>", _description(results)]
    if results.recommended is not None and results.limits:
        limits = ", ".join(f"{name} at most {limit:g}" for name, limit in results.limits.items())
        text = f"For {limits}: {results.recommended.setting.text(results.base)}"
        table = _table([results.recommended], results.base)
        parts += [f"<h2>Recommended</h2><p>{html.escape(text)}</p>", table]
    for name, title in (("front.png", "Pareto front"), ("sweeps.png", "One field at a time")):
        if name in figures:
            parts.append(f'<h2>{title}</h2><img alt="{title}" src="{data_url(figures[name])}">')
    parts += ["<h2>Pareto-optimal settings</h2>", _table(front_of(points, results.base), results.base)]
    parts += ["<h2>All settings</h2>", _table(points, results.base)]
    body = "\n".join(parts)
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Error against time</title>'
        f"<style>{_STYLE}</style>\n{body}\n</html>\n"
    )


def _description(results: Results) -> str:
    values = dict(results.description)
    if missing := ", ".join(sorted({s.text(results.base) for s in results.unavailable})):
        values["not available here"] = missing
    cells = ((html.escape(k), html.escape(str(v))) for k, v in values.items())
    return f"<table>{''.join(f'<tr><td>{k}</td><td>{v}</td></tr>' for k, v in cells)}</table>"


def _table(points: Sequence[Point], base: Setting) -> str:
    head = "".join(f"<th>{title}</th>" for title, _ in _COLUMNS.values())
    rows = []
    for point in points:
        values = (form.format(getattr(point, name)) for name, (_, form) in _COLUMNS.items())
        cells = "".join(f"<td>{value}</td>" for value in values)
        rows.append(f"<tr><td>{html.escape(point.setting.text(base))}</td>{cells}</tr>")
    return f'<div class="wide"><table><tr><th>setting</th>{head}</tr>{"".join(rows)}</table></div>'
