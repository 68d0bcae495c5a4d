# SPDX-License-Identifier: MIT
"""The JSON that goes with each view's EXR: camera, buffers, ids, and how it was made.

It holds nothing that depends on the machine's speed or the clock, so that the same view has the same bytes
wherever it is made; timings are in the unit's manifest.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from datagen.formats.base import NonNegative, Slug, StrictModel, Unit
from datagen.formats.configuration import Split, ViewCamera


class RenderRecord(StrictModel):
    """How a view was rendered. ``clipped_pixels`` exceeded the range of half floats.

    ``path_samples`` light paths a pixel were traced, as a mean over the image. Where they followed from a
    target, ``most_path_samples`` is the largest number of a pixel, ``estimated_rel_mse`` the error that was
    estimated from independent halves (exposed relMSE of the beauty image), and ``at_ceiling`` says that the
    samples ran out before the target was met. ``firefly_clamp_radiance`` is the
    most that a path could bring by two or more reflections, ``clamped_energy`` the share of the luminance
    that this took away. ``max_energy_left`` bounds the share of the light that paths longer than
    ``max_depth`` would have brought. ``irradiance_cell_m``: side of the cells whose cached irradiance ended
    paths; none where all light was traced.
    """

    variant: str
    seed: Annotated[int, Field(ge=0)]
    path_samples: NonNegative
    auxiliary_samples: int
    max_depth: int
    russian_roulette_depth: int
    denoiser: str
    clipped_pixels: int = 0
    most_path_samples: Annotated[int, Field(ge=1)] | None = None
    estimated_rel_mse: NonNegative | None = None
    at_ceiling: bool = False
    firefly_clamp_radiance: NonNegative | None = None
    clamped_energy: Unit = 0.0
    max_energy_left: Unit | None = None
    irradiance_cell_m: NonNegative | None = None


class StatisticsRecord(StrictModel):
    """How the statistics of a view were gathered."""

    num_views: int
    best_views: int
    visibility: Literal["depth", "trace"]
    include_self: bool


class ViewRecord(StrictModel):
    """``<view>.json``: everything about a view but its pixels.

    ``instances`` and ``materials`` map the ids of the id buffers to names (``object/part``, ``slot`` or
    material id). ``exposure`` brings the 95th percentile of luminance to 0.9. ``exr_sha256`` is the hash of
    the view's EXR file; ``versions`` those of the software that decides pixels.
    """

    format: Literal["scene-materials/view"] = "scene-materials/view"
    version: Literal[1] = 1
    configuration: Slug
    name: Slug
    index: Annotated[int, Field(ge=0)]
    split: Split
    camera: ViewCamera
    exposure: NonNegative
    buffers: tuple[str, ...]
    instances: dict[str, str]
    materials: dict[str, str]
    render: RenderRecord
    statistics: StatisticsRecord | None = None
    versions: dict[str, str]
    exr_sha256: str
