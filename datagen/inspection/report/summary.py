# SPDX-License-Identifier: MIT
"""Combines statistics of shards into the sections of the report, as plain data, and summarises plans."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.farm.folder import DatasetFolder, UnitManifest
from datagen.farm.status import runs
from datagen.formats.asset import MATERIAL_CLASSES, EnvironmentAsset, ObjectAsset
from datagen.formats.configuration import MIN_GLOSS_SHARE, MIN_METAL_SHARE, Configuration
from datagen.formats.shard import DatasetIndex
from datagen.foundation.errors import InputError
from datagen.inspection.findings import Report
from datagen.inspection.report.figures import NUM_COVERAGE_BINS, PIXEL_AXES, Axis, nice_axis
from datagen.library import Library, asset_classes

_COARSE = 8  # cells per side of the grid by which missing regions are listed
_MISSING_SHARE = 1e-3
"""Cells of the coarse grid (R, luminance of D) with a smaller share of the pixels count as missing."""
_UNKNOWN = "not in the library"
MAX_LISTED_FAULTS = 20


def histogram(axis: Axis, counts: Iterable[int], what: str) -> dict[str, Any]:
    """Plain data of a histogram for the page; ``what`` is the noun for the counted items."""
    return {
        "title": axis.title,
        "unit": axis.unit,
        "scale": axis.scale,
        "edges": [float(f"{edge:.6g}") for edge in axis.edges],
        "counts": [int(count) for count in counts],
        "what": what,
    }


def distributions(gathered: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Plain data of all histograms of the page, in order, from the results of :func:`gather_shard`."""
    figures = [
        histogram(axis, np.sum([shard["counts"][name] for shard in gathered], axis=0), "pixels")
        for name, axis in PIXEL_AXES.items()
    ]
    by_type: dict[tuple[str, str], list[float]] = {}
    for shard in gathered:
        for light in shard["lights"]:
            by_type.setdefault((light["type"], light["unit"]), []).append(light["value"])
    for (kind, unit), values in sorted(by_type.items()):
        axis = nice_axis(f"Intensity of {kind} lights", unit, values, 20, log=True)
        figures.append(histogram(axis, axis.count(values), "lights"))
    views = [view for shard in gathered for view in shard["views"]]
    for name, title, unit, log in (
        ("exposure", "Exposure", "factor on linear radiance", True),
        ("clipped_share", "Surface pixels clipped at a photographic exposure", "share", False),
        ("samples", "Light paths per pixel", "samples", False),
        ("rel_mse", "Estimated error (relMSE)", "1", True),
        ("height_m", "Camera height (z)", "m", False),
        ("pitch_deg", "Camera pitch (up is positive)", "degrees", False),
        ("heading_deg", "Camera heading (from +X towards +Y)", "degrees", False),
        ("fov_x_deg", "Horizontal field of view", "degrees", False),
    ):
        values = [view[name] for view in views if view[name] is not None]
        if values:
            axis = nice_axis(title, unit, values, 24, log)
            figures.append(histogram(axis, axis.count(values), "views"))
    return figures


def coverage(gathered: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Pixel counts over R and luminance of D, regions almost without pixels, shares of metal and gloss."""
    cells = np.sum([shard["coverage"] for shard in gathered], axis=0)
    total = max(int(cells.sum()), 1)
    training = [shard for shard in gathered if shard["split"] == "train"]
    metal_share, gloss_share = _metal_and_gloss(gathered)
    size = NUM_COVERAGE_BINS // _COARSE
    coarse = cells.reshape(_COARSE, size, _COARSE, size).sum(axis=(1, 3)) / total
    missing = []
    for r in range(_COARSE):
        empty = [c for c in range(_COARSE) if coarse[r, c] < _MISSING_SHARE]
        for first, last in runs(empty):
            rough = f"R {r / _COARSE:.3g} to {(r + 1) / _COARSE:.3g}"
            missing.append(f"{rough}, luminance of D {first / _COARSE:.3g} to {(last + 1) / _COARSE:.3g}")
    return {
        "cells": cells.tolist(),
        "filled_share": float((cells > 0).mean()),
        "metal_share": metal_share,
        "gloss_share": gloss_share,
        "lack_for_training": lack_for_training(*_metal_and_gloss(training)) if training else "",
        "coarse_filled": int((coarse >= _MISSING_SHARE).sum()),
        "coarse_total": _COARSE * _COARSE,
        "threshold": _MISSING_SHARE,
        "missing": missing,
    }


def _metal_and_gloss(gathered: Sequence[dict[str, Any]]) -> tuple[float, float]:
    """Shares of metal and of gloss among the surface pixels of all views."""
    views = [view for shard in gathered for view in shard["views"]]
    surface = max(sum(view["surface_pixels"] for view in views), 1)
    metal, gloss = (sum(view[name] for view in views) for name in ("metal_pixels", "gloss_pixels"))
    return metal / surface, gloss / surface


def assets(
    gathered: Sequence[dict[str, Any]], index: DatasetIndex, library: Library | None
) -> dict[str, Any]:
    """List all assets with class, use and licence, pixel shares by material and class, and unused assets."""
    placed: Counter[str] = Counter()
    used_in: Counter[str] = Counter()
    pixels: Counter[str] = Counter()
    for shard in gathered:
        here: set[str] = set()
        for thing in shard["placed"]:
            placed.update([thing["asset"], *thing["materials"]])
            here.update([thing["asset"], *thing["materials"]])
        used_in.update(here)
        pixels.update(shard["materials"])
    total = max(sum(pixels.values()), 1)
    of_asset: Counter[str] = Counter()
    by_class: Counter[str] = Counter()
    for name, count in pixels.items():
        of_asset[_without_variant(name).partition("/")[0]] += count
        by_class[_class_of(name, library)] += count
    rows = []
    for identity in sorted(placed.keys() | index.assets.keys()):
        record = index.assets.get(identity)
        rows.append(
            {
                "id": identity,
                "kind": record.kind if record else "?",
                "class": _detail(identity, library),
                "configurations": used_in[identity],
                "placed": placed[identity],
                "pixel_share": of_asset[identity] / total,
                "license": record.license if record else "",
                "author": record.author if record else "",
            }
        )
    never: dict[str, list[str]] = {"material classes": [], "assets of the library": []}
    if library is not None:
        never["material classes"] = [c for c in MATERIAL_CLASSES if c not in by_class and c != "other"]
        offered = {p.id for p in library if p.asset.provenance.usage != "evaluation_only"}
        never["assets of the library"] = sorted(offered - index.assets.keys())
    return {
        "rows": rows,
        "class_shares": [[name, count / total] for name, count in by_class.most_common()],
        "materials": [[name, count / total] for name, count in pixels.most_common(100)],
        "num_materials": len(pixels),
        "never_used": never,
    }


def _class_of(material: str, library: Library | None) -> str:
    """Main class of a material, from its name in the views' records."""
    if library is None:
        return _UNKNOWN
    identity, _, slot = _without_variant(material).partition("/")
    if identity not in library:
        return _UNKNOWN
    asset = library.package(identity).asset
    if isinstance(asset, ObjectAsset | EnvironmentAsset):
        found = asset.materials.get(slot)
        return found.classes[0] if found else "other"
    return asset_classes(asset)[0]


def _without_variant(material: str) -> str:
    """Remove the suffix of a variation (``#2``) from a material's name (``asset`` or ``asset/slot``)."""
    return re.sub(r"#\d+$", "", material)


def _detail(identity: str, library: Library | None) -> str:
    if library is None or identity not in library:
        return _UNKNOWN
    asset = library.package(identity).asset
    return asset.category if isinstance(asset, ObjectAsset) else ", ".join(asset_classes(asset))


def splits(index: DatasetIndex) -> dict[str, Any]:
    """Numbers of configurations, views and assets by split, and the assets that several splits use."""
    used: dict[str, set[str]] = {}
    views: Counter[str] = Counter()
    for shard in index.shards:
        used.setdefault(shard.split, set()).update(shard.assets)
        views[shard.split] += shard.num_views
    names = [split for split in ("train", "validation", "test") if split in used]
    shared = [
        {"asset": asset, "kind": index.assets[asset].kind if asset in index.assets else "?", "splits": homes}
        for asset in sorted(set().union(*used.values()) if used else ())
        if len(homes := [split for split in names if asset in used[split]]) > 1
    ]
    contents: dict[str, set[str]] = {}
    for asset, record in index.assets.items():
        contents.setdefault(record.sha256, set()).add(asset)
    for same in contents.values():
        homes = [split for split in names if used[split] & same]
        if len(same) > 1 and len(homes) > 1:
            shared.append({"asset": " = ".join(sorted(same)), "kind": "equal content", "splits": homes})
    return {
        "rows": [[name, index.splits.get(name, 0), views[name], len(used[name])] for name in names],
        "is_disjoint_asked": index.recipe.splits.disjoint,
        "shared": shared,
    }


def effort(folder: DatasetFolder, index: DatasetIndex, price_per_hour: float) -> dict[str, Any]:
    """Size, time, memory and cost from the units' manifests; ``why_not`` states why times are unknown."""
    size = {
        "num_bytes": index.num_bytes,
        "bytes_per_view": index.num_bytes / index.num_views if index.num_views else None,
    }
    manifests: list[UnitManifest] = []
    try:
        for unit in folder.read_plan().units:
            manifest = folder.read_manifest(unit)
            if manifest is not None:
                manifests.append(manifest)
    except InputError as error:
        return {**size, "why_not": f"no times: {error}", "stages": {}, "view_stages": {}}
    stages: Counter[str] = Counter()
    view_stages: dict[str, list[float]] = {}
    for manifest in manifests:
        stages.update(manifest.seconds)
        for timing in manifest.views:
            for stage, seconds in timing.seconds.items():
                view_stages.setdefault(stage, []).append(seconds)
    hours = sum(stages.values()) / 3600
    return {
        **size,
        "why_not": "" if manifests else "no times: no unit has a manifest",
        "stages": dict(stages),
        "view_stages": {name: float(np.median(values)) for name, values in view_stages.items()},
        "hours": hours,
        "views_per_hour": sum(m.num_views for m in manifests) / hours if hours else None,
        "hosts": sorted({m.host for m in manifests}),
        "peak_memory_mb": max((m.peak_memory_mb for m in manifests), default=None),
        "price_per_hour": price_per_hour or None,
        "cost": hours * price_per_hour if price_per_hour else None,
    }


def findings(
    report: Report | None, index: DatasetIndex, gathered: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Faults found by verification, by view, most errors first; and views with extreme values."""
    stand_out = _extreme_views(gathered)
    if report is None:
        return {"is_checked": False, "checks": [], "views": [], "notes": [], "stand_out": stand_out}
    files = {shard.file: shard.configuration for shard in index.shards}
    names = {shard["id"]: {view["name"] for view in shard["views"]} for shard in gathered}
    grouped: dict[tuple[str, str], list[Any]] = {}
    for fault in report.faults:
        grouped.setdefault(place_of(fault.where, files, names), []).append(fault)
    views = [
        {
            "configuration": configuration,
            "view": view,
            "errors": sum(f.severity == "error" for f in faults),
            "warnings": sum(f.severity == "warning" for f in faults),
            "faults": [[f.severity, f.check, f.where, f.got, f.expected] for f in faults[:MAX_LISTED_FAULTS]],
        }
        for (configuration, view), faults in grouped.items()
    ]
    views.sort(key=lambda v: (-v["errors"], -v["warnings"], v["configuration"], v["view"]))
    found = {"checks": report.counts(), "views": views, "notes": report.notes}
    return {"is_checked": True, **found, "stand_out": stand_out}


def place_of(where: str, files: dict[str, str], names: dict[str, set[str]]) -> tuple[str, str]:
    """Configuration and view that a fault's ``where`` names; the view is '' for a fault of a whole shard.

    ``files`` maps shards to configurations, ``names`` configurations to the names of their views. Both
    results are '' if ``where`` names no shard.
    """
    for file, configuration in files.items():
        at = where.find(file)
        if at >= 0:
            rest = re.sub(r"\.(exr|json)$", "", where[at + len(file) :].lstrip(":/"))
            view = rest.rpartition("/")[2]
            return configuration, view if view in names.get(configuration, set()) else ""
    return "", ""


def _extreme_views(gathered: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The six views with the most extreme values of each of several quantities."""
    views = [(shard["id"], view) for shard in gathered for view in shard["views"]]
    found = []
    for title, name, sign in (
        ("largest estimated error", "rel_mse", -1),
        ("most pixels clipped to the range of half floats", "clipped_pixels", -1),
        ("most surface clipped at a photographic exposure", "clipped_share", -1),
        ("fewest views in a surface pixel's statistics, on average", "mean_count", 1),
        ("least surface", "surface_share", 1),
    ):
        ranked = [(c, v) for c, v in views if v[name] is not None and (sign > 0 or v[name] > 0)]
        ranked.sort(key=lambda item: (sign * item[1][name], item[0], item[1]["name"]))
        if ranked:
            rows = [[c, v["name"], v[name]] for c, v in ranked[:6]]
            found.append({"title": title, "rows": rows})
    return found


def plan_summary(configurations: Iterable[Configuration]) -> str:
    """Summarise the surfaces visible in planned views; '' if no configuration records them.

    The last line warns if the views of the training split lack metal or gloss.
    """
    found = [
        (c.coverage, len(c.cameras), c.split == "train") for c in configurations if c.coverage is not None
    ]
    if not found:
        return ""
    views = np.array([count for _, count, _ in found], dtype=np.float64)
    training = views * [is_training for *_, is_training in found]

    def mean(field: str, weights: NDArray[np.float64] = views) -> float:
        return float(np.average([getattr(coverage, field) for coverage, *_ in found], weights=weights))

    medians = [coverage.median_observations for coverage, *_ in found]
    lines = [
        f"the median surface pixel is visible in {np.median(medians):g} views ({min(medians):g} to "
        f"{max(medians):g} by configuration), {mean('thin_share'):.0%} of the pixels by at most two",
        f"{mean('room_share'):.0%} of the views show two walls, or a wall and the ceiling",
        f"{mean('metal_share'):.1%} of the surface pixels have S > 0.3, {mean('gloss_share'):.1%} R < 0.3",
    ]
    if training.any():
        lack = lack_for_training(mean("metal_share", training), mean("gloss_share", training))
        lines += [f"note: {lack}"] if lack else []
    return "\n".join(lines)


def lack_for_training(metal_share: float, gloss_share: float) -> str:
    """Describe shares of metal and glossy pixels that are too small for training; '' if both suffice."""
    shares = (("S > 0.3", metal_share, MIN_METAL_SHARE), ("R < 0.3", gloss_share, MIN_GLOSS_SHARE))
    short = [
        f"{name} in {share:.1%} of them (at least {least:.0%})"
        for name, share, least in shares
        if share < least
    ]
    if not short:
        return ""
    remedy = "raise metal and glazed in materials.class_weights"
    return f"the training views have too few surface pixels of metal or gloss: {', '.join(short)}; {remedy}"
