# SPDX-License-Identifier: MIT
"""Selects settings from trials: means over configurations, Pareto front and recommendation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from datagen.foundation.errors import InputError, Problem
from datagen.tradeoff.settings import Setting
from datagen.tradeoff.trial import Trial

RENDER_FIELDS = (
    "quality",
    "path_samples",
    "auxiliary_samples",
    "denoiser",
    "max_depth",
    "russian_roulette_depth",
    "firefly_clamp",
    "irradiance_cache",
)
"""Fields in which a recommendation may differ from the base; the others change the content of a view."""


@dataclass(frozen=True)
class Point:
    """Means of a setting's trials over all configurations; ``worst_rel_mse`` is the maximum over them."""

    setting: Setting
    rel_mse: float
    worst_rel_mse: float
    maps_error: float
    statistics_error: float
    bytes_a_view: float
    path_samples: float
    cpu_s: float
    wall_s: float


def points_of(trials: Iterable[Trial]) -> list[Point]:
    """Average the trials of each setting that was measured on every configuration of ``trials``."""
    by_setting: dict[Setting, dict[str, Trial]] = {}
    for trial in trials:
        by_setting.setdefault(Setting(**trial.setting), {})[trial.configuration] = trial
    configurations = {name for found in by_setting.values() for name in found}

    def mean(found: dict[str, Trial], name: str) -> float:
        return float(np.mean([getattr(trial, name) for trial in found.values()]))

    return [
        Point(
            setting=setting,
            rel_mse=mean(found, "rel_mse"),
            worst_rel_mse=max(trial.rel_mse for trial in found.values()),
            **{field.name: mean(found, field.name) for field in fields(Point)[3:]},
        )
        for setting, found in by_setting.items()
        if set(found) == configurations
    ]


def pareto_front(costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Indices of the pairs (cost, error) that no other dominates, cheapest first.

    A pair dominates another if neither its cost nor its error is larger and one of them is smaller. The first
    of equal pairs is kept.
    """
    order = sorted(range(len(costs)), key=lambda k: (costs[k], errors[k], k))
    front: list[int] = []
    for k in order:
        if not front or errors[k] < errors[front[-1]]:
            front.append(k)
    return front


def comparable(points: Iterable[Point], base: Setting) -> list[Point]:
    """Points whose settings differ from the base only in :data:`RENDER_FIELDS`."""
    return [p for p in points if set(p.setting.differences(base)) <= set(RENDER_FIELDS)]


def front_of(points: Iterable[Point], base: Setting) -> list[Point]:
    """Pareto front of processor seconds and relMSE among the :func:`comparable` points, cheapest first."""
    found = comparable(points, base)
    return [found[k] for k in pareto_front([p.cpu_s for p in found], [p.rel_mse for p in found])]


def recommend(points: Iterable[Point], base: Setting, limits: dict[str, float]) -> Point:
    """Return the cheapest comparable point within ``limits``: maximum errors by field of :class:`Point`.

    If there is none, raises :class:`InputError` with the smallest errors measured.
    """
    found = comparable(points, base)
    meets = [p for p in found if all(getattr(p, name) <= limit for name, limit in limits.items())]
    if meets:
        return min(meets, key=lambda p: (p.cpu_s, p.rel_mse))
    problems = []
    for name, limit in limits.items():
        best = min((getattr(p, name) for p in found), default=float("nan"))
        remedy = "allow a larger error, or sweep costlier settings (--sweep path_samples=128,256)"
        got, expected = f"{best:.3g} at best", f"at most {limit:g}"
        problems.append(Problem("tradeoff", name, got, expected, remedy))
    raise InputError(*problems)


def excess_over_front(point: Point, others: Sequence[Point], cost: str = "cpu_s") -> float:
    """Cost of ``point`` divided by the cost at which the Pareto front of ``others`` reaches its error.

    ``cost`` is a field of :class:`Point`. The front is interpolated in logarithms between its points. The
    result is below 1 for a point that extends the front, and 0 for an error below the whole front. For an
    error above the whole front, the cost of the front's cheapest point is used.
    """
    costs = [getattr(p, cost) for p in others]
    front = [others[k] for k in pareto_front(costs, [p.rel_mse for p in others])]
    if not front or point.rel_mse < front[-1].rel_mse:
        return 0.0
    errors = np.log([p.rel_mse for p in reversed(front)])  # increasing
    needed = np.log([getattr(p, cost) for p in reversed(front)])
    expected = float(np.exp(np.interp(np.log(point.rel_mse), errors, needed)))
    return float(getattr(point, cost)) / expected


def as_row(point: Point) -> dict[str, Any]:
    """Combine the fields of a point's setting and the point's means in one dictionary."""
    values = asdict(point)
    return {**values.pop("setting"), **values}
