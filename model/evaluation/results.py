# SPDX-License-Identifier: MIT
"""Results of methods, scenes and suites as stored in JSON files."""

from __future__ import annotations

from pathlib import Path

from datagen.formats.base import NonNegative, Slug, StrictModel, read_json
from datagen.foundation.errors import InputError

ViewSet = str
"""Set of views compared with the truth: photographs that methods use (``input``) or others (``novel``)."""
Stage = str
"""Stage of maps: predicted in each view (``per_view``), or the atlas rendered in the views (``merged``)."""
Figures = dict[str, float | None]


class MethodResult(StrictModel):
    """Results of a method on a scene.

    ``skipped``: reason for missing figures, else ''. ``geometry``: errors of the mesh in words, "true" for
    none; ``camera``: name of the camera faults, '' for none; ``checkpoint``: its name and the start of its
    hash. ``maps_per_view`` and ``maps_merged``: mean squared errors of the predicted maps and of the atlas as
    seen in the views; ``map_figures``, ``by_kind`` and ``calibration`` are as in ``map_measures``;
    ``map_views``: the errors per view. ``images``: figures of re-renderings (``metrics.image_figures``) by
    light (own, modified, recovered) and views (input, novel); ``image_views``: the same per view.
    ``seed_spread``: standard deviation, by light, of a view's figures between two seeds of the renderer.
    ``seen_share``: share of the atlas visible in at least one view; ``covered_share``: share of the true
    surface's pixels where the method has a surface. ``atlas_size``: side in texels; ``seconds``: wall time by
    stage; ``processor_s``: time of all cores, without cached results. ``folder``: folder of maps and asset;
    ``renders``: folders of rendered views, by light (also ``inserted``).
    """

    scene: Slug
    method: Slug
    kind: str
    geometry: str = "true"
    camera: str = ""
    checkpoint: str = ""
    skipped: str = ""
    maps_per_view: dict[str, float] = {}
    maps_merged: dict[str, float] = {}
    map_figures: dict[Stage, dict[str, float]] = {}
    map_views: dict[Stage, dict[str, dict[str, float]]] = {}
    by_kind: dict[Stage, dict[str, dict[str, float]]] = {}
    calibration: dict[str, list[float]] = {}
    images: dict[str, dict[ViewSet, Figures]] = {}
    image_views: dict[str, dict[ViewSet, dict[str, Figures]]] = {}
    seed_spread: dict[str, dict[str, float]] = {}
    seen_share: NonNegative | None = None
    covered_share: NonNegative | None = None
    atlas_size: int = 0
    seconds: dict[str, float] = {}
    peak_memory_mb: NonNegative = 0.0
    processor_s: NonNegative = 0.0
    notes: tuple[str, ...] = ()
    folder: str = ""
    renders: dict[str, str] = {}

    @property
    def label(self) -> str:
        """Name for tables and pictures, with faults of the camera and errors of the mesh in parentheses."""
        faults = [self.camera] if self.camera else []
        faults += [self.geometry] if self.geometry != "true" else []
        return f"{self.method} ({', '.join(faults)})" if faults else self.method

    def figures(self, light: str, views: ViewSet) -> Figures:
        """Means over views of the figures of re-renderings; empty if there are none."""
        return self.images.get(light, {}).get(views, {})


class SceneResult(StrictModel):
    """Results of all methods on a scene.

    ``exposures``: exposure factor of all images under a light, by light; ``figure_views``: name of the view
    in pictures, by set of views; ``renders``: folders of true views, by light, if these are not in the
    capture; ``path_samples``: mean number of light paths per pixel of the photographs.
    """

    name: Slug
    num_views: int
    num_novel: int
    resolution: tuple[int, int]
    judged_views: tuple[str, ...]
    novel_views: tuple[str, ...]
    exposures: dict[str, float]
    figure_views: dict[ViewSet, str]
    path_samples: float
    renders: dict[str, str]
    methods: tuple[MethodResult, ...]

    def by_camera(self) -> list[tuple[str, SceneResult]]:
        """Results by camera faults, as pairs (their name or '', results on photographs with them)."""
        cameras = dict.fromkeys(method.camera for method in self.methods)
        chosen = ((c, tuple(m for m in self.methods if m.camera == c)) for c in cameras)
        return [(camera, self.model_copy(update={"methods": methods})) for camera, methods in chosen]


class SuiteResult(StrictModel):
    """Contents of ``evaluation.json``. ``lpips_absence``: reason for missing LPIPS, else ''; ``failures``:
    reasons for missing figures, by scene."""

    suite: Slug
    may_be_known: bool
    lpips_absence: str
    scenes: tuple[SceneResult, ...]
    failures: dict[str, str] = {}


def read_result(path: Path) -> MethodResult | None:
    """Read a stored result; None if it is missing or unreadable."""
    if not path.is_file():
        return None
    try:
        return read_json(MethodResult, path)
    except InputError:
        return None  # written by another version
