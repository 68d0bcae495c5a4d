# SPDX-License-Identifier: MIT
"""Options and report of ``materials infer``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import typer

from datagen.foundation.errors import input_error
from datagen.foundation.peak_memory import peak_mb
from datagen.foundation.progress import Progress
from model.reconstruction.merge.weights import Weights

__all__ = ["AssetOptions", "InferOptions", "InferReport", "Materials", "Progress"]
Materials = Literal["network", "light", "both"]


def _atlas_side(text: str) -> int | Literal["auto"]:
    if text == "auto":
        return "auto"
    if not text.isdigit():
        raise typer.BadParameter(f"{text!r}; expected auto or a number of texels")
    return int(text)


@dataclass(frozen=True)
class AssetOptions:
    """Options of the asset.

    ``atlas``: texels per side; "auto" gives texels about as fine on the surface as the views' pixels.
    ``is_checked``: whether the mesh is compared with the photographs first. ``has_usd``: whether a USDZ is
    also written.
    """

    atlas: Annotated[
        int | Literal["auto"],
        typer.Option(parser=_atlas_side, metavar="SIDE", help="Side of the atlas in texels, or auto."),
    ] = "auto"
    device: Annotated[str, typer.Option(help="Device of the networks: cpu or cuda.")] = "cpu"
    is_checked: Annotated[
        bool, typer.Option("--check/--no-check", help="Compare the mesh with the photographs first.")
    ] = True
    has_usd: Annotated[bool, typer.Option("--usd", help="Also write NAME.usdz (needs the extra `usd`).")] = (
        False
    )

    def __post_init__(self) -> None:
        if self.atlas != "auto" and not 16 <= self.atlas <= 16384:
            raise input_error("infer", "atlas", self.atlas, "auto, or a side in [16, 16384]", "correct it")


@dataclass(frozen=True)
class InferOptions(AssetOptions):
    """Options of ``materials infer``.

    ``weights``: weights of the views in the merge (see :class:`MergeOptions`). ``materials``: whether
    materials are inferred from the network alone, from the recorded light alone, or from both, with the
    network as the prior (``light``). ``batch``: number of views predicted at a time. ``is_leveled``: whether
    the albedo scale of predictions is corrected by interreflection (``albedo_level``). ``has_punctual``:
    whether the GLB also contains small lamps and the sun as punctual lights. ``is_evened``: whether
    exposures, vignetting and response are estimated from overlapping photographs (``radiometry``).
    ``mends_poses``: whether small errors of the cameras' poses are corrected. ``mends_mesh``: whether noise
    and holes of a reconstructed mesh are removed (``mesh``). ``keeps_uvs``: whether valid UVs of the mesh are
    kept at their scales (``unwrap.repacked``).
    """

    visibility: Annotated[
        Literal["depth", "trace"],
        typer.Option(help="Visibility test of views: depth buffers or shadow rays."),
    ] = "depth"
    weights: Annotated[Weights, typer.Option(help="Weights of the views in the merge.")] = "resolution"
    materials: Annotated[
        Materials,
        typer.Option(help="Source of materials: the networks, the light in the photographs, or both."),
    ] = "both"
    precision: Annotated[
        Literal["auto", "float32", "bfloat16"], typer.Option(help="Precision of the networks.")
    ] = "auto"
    batch: int = 4
    is_filtered: Annotated[
        bool, typer.Option("--filter/--no-filter", help="Run the bilateral solver over predicted maps.")
    ] = True
    has_exr: bool = True
    is_leveled: Annotated[
        bool,
        typer.Option(
            "--level/--no-level", help="Correct the albedo scale of predictions by interreflection."
        ),
    ] = True
    has_punctual: Annotated[
        bool,
        typer.Option("--punctual", help="Also write small lamps and the sun to the GLB as punctual lights."),
    ] = False
    is_evened: bool = True
    mends_poses: Annotated[
        bool,
        typer.Option("--mend-poses", help="Correct pose errors of a few millimetres, and report them."),
    ] = False
    mends_mesh: Annotated[
        bool, typer.Option("--mend-mesh/--no-mend-mesh", help="Smooth a noisy mesh, and fill its holes.")
    ] = True
    keeps_uvs: Annotated[bool, typer.Option("--keep-uvs", help="Keep valid UVs of the mesh unscaled.")] = (
        False
    )


@dataclass
class InferReport:
    """Report of a run.

    ``atlas_size`` is in texels per side; ``seen_share`` and ``seen_of_visible``: observed share of the texels
    on the surface, and of those on visible triangles; ``exposure``: factor applied to the networks' input;
    ``gltf_error``: error of the GLB's textures; ``seconds``: time by stage; ``memory_mb``: peak resident
    memory up to the end of each stage. Empty if their stage did not run: ``mesh``, its noise and holes;
    ``radiometry``, the findings of :mod:`~model.reconstruction.radiometry`; ``poses``, the corrections of
    poses; ``albedo_level``, a :class:`~model.reconstruction.albedo_level.LevelReport`, and ``light``, a
    :class:`~model.reconstruction.light.options.LightReport` with the recovered lights, as dictionaries.
    """

    name: str = ""
    num_views: int = 0
    num_triangles: int = 0
    atlas_size: int = 0
    seen_share: float = 0.0
    seen_of_visible: float = 0.0
    exposure: float = 0.0
    unwrap: dict[str, Any] = field(default_factory=dict)
    precision: str = ""
    is_filtered: bool = False
    mesh: dict[str, Any] = field(default_factory=dict)
    radiometry: dict[str, Any] = field(default_factory=dict)
    poses: dict[str, Any] = field(default_factory=dict)
    albedo_level: dict[str, Any] = field(default_factory=dict)
    light: dict[str, Any] = field(default_factory=dict)
    gltf_error: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    memory_mb: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Context manager that adds its duration to ``seconds[name]`` and records ``memory_mb[name]``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            self.memory_mb[name] = round(peak_mb(), 1)

    def table(self) -> str:
        """Format the stages' costs (:meth:`costs`) and the recovered lights as a text table."""
        from model.reconstruction.found_lights import lights_text

        lines = []
        for name, seconds, share, memory in self.costs():
            lines.append(f"{name:<14}{seconds:>8.1f} s{share:>8.0%}{memory:>10.0f} MB")
        if "lights" in self.light:
            lines += ["", lights_text(self.light["lights"])]
        return "\n".join(lines)

    def costs(self) -> list[tuple[str, float, float, float]]:
        """Rows (name, seconds, share of the total, peak memory so far in MB): stages, indented steps of the
        light stage, and the total.
        """
        total = sum(self.seconds.values())
        memory = max(self.memory_mb.values(), default=0.0)
        rows = []
        for name, seconds in [*self.seconds.items(), ("total", total)]:
            rows.append((name, seconds, seconds / max(total, 1e-9), self.memory_mb.get(name, memory)))
            if name == "light":
                steps, of_step = self.light.get("seconds", {}), self.light.get("memory_mb", {})
                rows += [(f"  {k}", v, v / max(total, 1e-9), of_step[k]) for k, v in steps.items()]
        return rows
