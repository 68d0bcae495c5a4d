# SPDX-License-Identifier: MIT
"""Selection of the views for a point's statistics: the k views of least cost in which it is visible.

cost_i = -n . omega_i + d_ip / max_j d_jp, with j over all cameras and the symbols of ``visibility``. Among
views of equal cost, the lower index comes first, so the result does not depend on the kernel's scheduling.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from datagen.multiview.visibility import PackedViews, VisibilityOptions, max_distance, observe

if TYPE_CHECKING:
    import drjit as dr
    import mitsuba as mi


class Selection(NamedTuple):
    """The chosen views of each point, at most k = ``num_best`` (*traced*)."""

    num_chosen: mi.UInt32
    """Number of chosen views, at most k."""
    views: dr.Local
    """(k,) indices of the chosen views by increasing cost."""


def select_views(
    views: PackedViews,
    points: mi.Point3f,
    normals: mi.Vector3f,
    num_best: int,
    options: VisibilityOptions,
    scene: mi.Scene | None,
    own: mi.UInt32,
    include_own: bool,
    active: mi.Bool,
) -> Selection:
    """Select the ``num_best`` views of least cost among those in which each point is visible (*traced*).

    ``own``: index of the view whose pixels define the points; it is always a candidate if ``include_own``,
    else never. No view is chosen for points that are not ``active``.
    """
    import drjit as dr
    import mitsuba as mi

    num_points = dr.width(points)
    num_views = dr.opaque(mi.UInt32, views.num_views)
    inverse_farthest = dr.rcp(max_distance(views, points))
    infinity = mi.Float(np.inf)

    def insert(
        costs: dr.Local, chosen: dr.Local, cost: mi.Float, view: mi.UInt32
    ) -> tuple[dr.Local, dr.Local]:
        """Insert one candidate into the sorted lists; entries beyond the end are dropped."""

        def body(j: Any, cost: Any, view: Any, costs: Any, chosen: Any) -> tuple[Any, ...]:
            other_cost, other_view = costs[j], chosen[j]
            is_better = cost < other_cost
            costs[j] = dr.select(is_better, cost, other_cost)
            chosen[j] = dr.select(is_better, view, other_view)
            cost, view = dr.select(is_better, other_cost, cost), dr.select(is_better, other_view, view)
            return j + 1, cost, view, costs, chosen

        state = (mi.UInt32(0), cost, mi.UInt32(view), costs, chosen)
        *_, costs, chosen = dr.while_loop(
            state, lambda j, cost, *_: (j < num_best) & (cost < infinity), body, label="insert"
        )
        return costs, chosen

    def visit(view: Any, num_visible: Any, costs: Any, chosen: Any) -> tuple[Any, ...]:
        observed = observe(views, view, points, normals, options, scene)
        is_candidate = observed.is_visible & active
        is_own = view == own
        is_candidate = is_candidate | (is_own & active) if include_own else is_candidate & ~is_own
        cost = dr.select(is_candidate, observed.distance_m * inverse_farthest - observed.cosine, infinity)
        num_visible = num_visible + dr.select(is_candidate, mi.UInt32(1), mi.UInt32(0))
        costs, chosen = insert(costs, chosen, cost, view)
        return view + 1, num_visible, costs, chosen

    start = (
        mi.UInt32(0),
        dr.zeros(mi.UInt32, num_points),
        dr.alloc_local(mi.Float, num_best, infinity),
        dr.alloc_local(mi.UInt32, num_best, mi.UInt32(0)),
    )
    _, num_visible, _, chosen = dr.while_loop(
        start, lambda view, *_: view < num_views, visit, label="select_views"
    )
    return Selection(dr.minimum(num_visible, num_best), chosen)
