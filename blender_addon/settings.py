# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of an export, shared by the operator, the panel and the command line."""

from __future__ import annotations

from dataclasses import dataclass

KINDS = ("auto", "environment", "object", "material")


@dataclass(frozen=True)
class ExportSettings:
    """Scope and accuracy of an export. Values out of range raise ``ValueError``.

    ``kind``: ``auto`` follows the ``sm_role`` tags, and exports the scene as one environment if there are
    none; other values export that kind only. ``tolerance``: mean absolute change of a channel below which a
    texture is not enlarged. ``max_texture_px``: maximum side of a texture (a power of two). ``bake_normals``:
    bump and normal maps become a normal texture. ``texture_bits``: 8 or 16. ``only``: names of the objects,
    collections or materials to export (empty: everything tagged). ``license``, ``author``, ``source``:
    provenance of assets without these tags. ``report``: write the fidelity report. ``report_python``: Python
    executable, with this project installed, that renders the report.
    """

    kind: str = "auto"
    tolerance: float = 1 / 255
    max_texture_px: int = 2048
    bake_normals: bool = False
    texture_bits: int = 8
    only: tuple[str, ...] = ()
    license: str = ""
    author: str = ""
    source: str = ""
    report: bool = False
    report_python: str = ""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind = {self.kind!r}; expected one of {', '.join(KINDS)}")
        size = self.max_texture_px
        if size < 16 or size > 16384 or size & (size - 1):
            raise ValueError(f"max_texture_px = {size}; expected a power of two from 16 to 16384")
        if not 0 < self.tolerance < 1:
            raise ValueError(f"tolerance = {self.tolerance}; expected a value between 0 and 1")
        if self.texture_bits not in (8, 16):
            raise ValueError(f"texture_bits = {self.texture_bits}; expected 8 or 16")
