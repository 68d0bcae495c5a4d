# SPDX-License-Identifier: MIT
"""Format of ``<view>.json``, the metadata of a view's EXR file: camera, buffers, names by id, and rendering.

It contains nothing that depends on the machine's speed or the clock, so a view has the same bytes on every
machine; timings are in the unit's manifest.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema

from datagen.formats.base import NonNegative, Slug, StrictModel, Unit
from datagen.formats.configuration import Split, ViewCamera


def _names_from_file(value: Any) -> Any:
    """Convert a file's list of ids and names to a dictionary; dictionaries (version 1) stay unchanged."""
    if not isinstance(value, list | tuple):
        return value
    names: dict[str, str] = {}
    for entry in value:
        if not isinstance(entry, dict) or entry.keys() != {"id", "name"} or type(entry["id"]) is not int:
            raise ValueError('expected entries of the form {"id": 1, "name": "environment/wall"}')
        if str(entry["id"]) in names:
            raise ValueError(f"expected every id once, not {entry['id']} twice")
        names[str(entry["id"])] = entry["name"]
    return names


def _names_to_file(names: dict[str, str]) -> list[dict[str, Any]]:
    return [{"id": int(key), "name": names[key]} for key in sorted(names, key=int)]


_NAMED_ID = {
    "additionalProperties": False,
    "properties": {"id": {"minimum": 1, "type": "integer"}, "name": {"type": "string"}},
    "required": ["id", "name"],
    "type": "object",
}
NamesOfIds = Annotated[
    dict[Annotated[str, Field(pattern="^[1-9][0-9]*$")], str],
    BeforeValidator(_names_from_file),
    PlainSerializer(_names_to_file),
    WithJsonSchema({"items": _NAMED_ID, "type": "array"}),
]
"""Names by id; in files a list of ``{"id": 1, "name": "..."}``.

Columnar libraries (Arrow, in Hugging Face's `datasets`) would turn the keys of a dictionary into columns."""
_T = TypeVar("_T")
_IfAny = Annotated[_T | None, Field(exclude_if=lambda value: value is None)]
"""Optional value, not written if None, since columnar libraries cannot infer a type from leading nulls."""


class RenderRecord(StrictModel):
    """Record of a view's rendering. ``clipped_pixels``: number of pixels beyond the range of half floats.

    ``path_samples``: mean number of light paths per pixel. If a target error was given, ``most_path_samples``
    is the largest number for any pixel, ``estimated_rel_mse`` the relMSE of the beauty image, estimated from
    two independent halves of the samples, plus its standard error, and ``at_ceiling`` is true if the sample
    limit was reached before the target. ``firefly_clamp_radiance`` is the maximum radiance of a path of two
    or more bounces, ``clamped_energy`` the share of the luminance that this clamp removed; part of it is
    restored, spread over surrounding pixels (:mod:`datagen.rendering.clamped_light`). ``max_energy_left``
    bounds the share of the light on paths longer than ``max_depth``. ``irradiance_cell_m``: side of the
    irradiance cache's cells; None if it was not used.
    """

    variant: str
    seed: Annotated[int, Field(ge=0)]
    path_samples: NonNegative
    auxiliary_samples: int
    max_depth: int
    russian_roulette_depth: int
    denoiser: str
    clipped_pixels: int = 0
    most_path_samples: _IfAny[Annotated[int, Field(ge=1)]] = None
    estimated_rel_mse: _IfAny[NonNegative] = None
    at_ceiling: bool = False
    firefly_clamp_radiance: _IfAny[NonNegative] = None
    clamped_energy: Unit = 0.0
    max_energy_left: _IfAny[Unit] = None
    irradiance_cell_m: _IfAny[NonNegative] = None


class StatisticsRecord(StrictModel):
    """Number of candidate views, and options as in ``StatisticsRecipe``, of a view's statistics."""

    num_views: int
    best_views: int
    visibility: Literal["depth", "trace"]
    include_self: bool
    light: bool = Field(default=False, exclude_if=lambda value: not value)


class ViewRecord(StrictModel):
    """``<view>.json``: all metadata of a view.

    ``instances`` maps ``instance_id`` to names of placed objects or, for the room, ``name/part``;
    ``materials`` maps ``material_id`` to material packages or, for an asset's own materials, ``asset/slot``.
    ``exposure`` brings the 95th percentile of luminance to 0.9. ``exr_sha256`` is the hash of the view's EXR
    file; ``versions`` lists the versions of software that affects pixels. Version 1, in which ``instances``
    and ``materials`` were dictionaries, can be read too.
    """

    format: Literal["scene-materials/view"] = "scene-materials/view"
    version: Annotated[Literal[2], BeforeValidator(lambda value: 2 if value == 1 else value)] = 2
    configuration: Slug
    name: Slug
    index: Annotated[int, Field(ge=0)]
    split: Split
    camera: ViewCamera
    exposure: NonNegative
    buffers: tuple[str, ...]
    instances: NamesOfIds
    materials: NamesOfIds
    render: RenderRecord
    statistics: _IfAny[StatisticsRecord] = None
    versions: dict[str, str]
    exr_sha256: str
