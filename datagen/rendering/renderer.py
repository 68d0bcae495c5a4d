# SPDX-License-Identifier: MIT
"""Renders the views of a configuration: a beauty pass, a ground-truth pass, and the denoiser.

The scene is built once (:mod:`.prepared_scene`); all views (:mod:`.view_job`) share its kernels and differ
only in the camera. Both passes use a box filter on the same pixels. Path samples depend only on configuration
seed, view index and half, and are added in a fixed order.

A recipe sets either the number of paths or a target error. For a target error, passes are added to two
independent halves of the image until the error estimated from them (:mod:`datagen.rendering.sample_budget`)
is small enough.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from datagen.formats.configuration import Configuration
from datagen.formats.recipe import RenderRecipe
from datagen.rendering.denoiser import Denoiser, OidnDenoiser, make_denoiser
from datagen.rendering.prepared_scene import PreparedScene
from datagen.rendering.sample_budget import SampleBudget
from datagen.rendering.scene_builder import AssetCaches
from datagen.rendering.schedule import interleaved
from datagen.rendering.view_job import Finishing, IsEnough, RenderedView, ViewJob

if TYPE_CHECKING:
    from datagen.library import Library


class SceneRenderer(PreparedScene):
    """Renders the views of one configuration.

    Selects the recipe's Mitsuba variant. Default ``caches`` are those of the process. ``denoiser``, if given,
    is also used for error estimates (see :class:`Finishing`). ``is_enough`` may stop a view early. Raises the
    errors of :class:`PreparedScene`.
    """

    def __init__(
        self,
        configuration: Configuration,
        library: Library,
        recipe: RenderRecipe,
        caches: AssetCaches | None = None,
        denoiser: Denoiser | None = None,
        is_enough: IsEnough | None = None,
    ):
        start = time.perf_counter()
        super().__init__(configuration, library, recipe, caches)
        budget = None
        if recipe.max_rel_mse is not None and recipe.max_path_samples is not None:
            budget = SampleBudget(recipe.max_rel_mse, recipe.max_path_samples)
        quick_denoiser = None
        if denoiser is None and recipe.denoise:
            denoiser = make_denoiser(self.variant)
            if budget is not None and isinstance(denoiser, OidnDenoiser):
                quick_denoiser = OidnDenoiser("balanced")
        self._finishing = Finishing(denoiser, quick_denoiser, budget, is_enough)
        self.seconds_to_build = time.perf_counter() - start

    @property
    def denoiser(self) -> Denoiser | None:
        """Denoiser of views, except those finished by the quick denoiser; None if views are not denoised."""
        return self._finishing.denoiser

    def view_job(self, index: int) -> ViewJob:
        """Trace the ground truth of view ``index``, and return the job that renders the view in steps."""
        return ViewJob(self, self._finishing, index)

    def render_view(self, index: int) -> RenderedView:
        """Render all ``RENDERED_BUFFERS`` of view ``index``, and ``beauty_noisy`` if the recipe keeps it.

        Raises :class:`RenderError` if a pixel is NaN or Inf.
        """
        (view,) = self.render_views([index])
        return view

    def render_views(self, indices: Iterable[int]) -> Iterator[RenderedView]:
        """Render the views ``indices`` and yield them in that order; see :meth:`render_view`.

        Error estimates and the denoiser run in a separate thread while another view is traced and while the
        caller processes the previous one.
        """
        with ThreadPoolExecutor(1, thread_name_prefix="denoise") as pool:
            yield from interleaved(self.view_job(index).steps(pool) for index in indices)

    def close(self) -> None:
        """Release the scene and the denoisers, but not the shared caches."""
        finishing, self._finishing = self._finishing, Finishing(None, None, None, None)
        for denoiser in (finishing.denoiser, finishing.quick_denoiser):
            if isinstance(denoiser, OidnDenoiser):
                denoiser.close()
        super().close()
