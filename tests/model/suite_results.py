# SPDX-License-Identifier: MIT
"""Results of suites with one scene and one method."""

from __future__ import annotations

from model.evaluation.results import MethodResult, SceneResult, SuiteResult


def suite_of(method: MethodResult, judged_views: tuple[str, ...] = ()) -> SuiteResult:
    """Result of a suite that contains only ``method`` in its scene."""
    scene = SceneResult(
        name=method.scene,
        num_views=4,
        num_novel=0,
        resolution=(6, 4),
        judged_views=judged_views,
        novel_views=(),
        exposures={},
        figure_views={},
        path_samples=1,
        renders={},
        methods=(method,),
    )
    return SuiteResult(suite="s", may_be_known=True, lpips_absence="", scenes=(scene,))
