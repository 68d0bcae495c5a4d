# SPDX-License-Identifier: MIT
"""Plausible ranges of object sizes by category, so wide that only wrong units violate them."""

from __future__ import annotations

from datagen.formats.asset import ObjectAsset

CATEGORY_SIZES_M: dict[str, tuple[float, float]] = {
    "book": (0.08, 0.9), "bottle": (0.04, 0.7), "box": (0.04, 1.5), "candle": (0.02, 0.9),
    "clock": (0.03, 2.4),
    "crockery": (0.02, 0.7), "cushion": (0.15, 1.2), "electronics": (0.02, 1.6), "frame": (0.04, 2.0),
    "fruit": (0.01, 0.6), "kitchenware": (0.02, 1.0), "lamp": (0.05, 2.3), "plant": (0.03, 3.0),
    "shoe": (0.08, 0.5), "statuette": (0.02, 2.2), "tool": (0.03, 1.8), "toy": (0.01, 1.5),
    "vase": (0.03, 1.5),
    "cup": (0.03, 0.3), "mug": (0.03, 0.3), "plate": (0.05, 0.6), "seat": (0.25, 3.5), "chair": (0.25, 1.6),
    "sofa": (0.6, 4.0), "table": (0.2, 4.0), "bed": (0.5, 2.6),
}  # fmt: skip
"""Plausible minimum and maximum, in metres, of an object's longest side by category."""


def size_fault(asset: ObjectAsset) -> str:
    """Return a description of an object's implausible size; "" if plausible or of unknown category."""
    limits = CATEGORY_SIZES_M.get(asset.category)
    if limits is None:
        return ""
    longest = max(high - low for low, high in zip(asset.minimum_m, asset.maximum_m, strict=True))
    least, most = longest * asset.scale_range[0], longest * asset.scale_range[1]
    if most >= limits[0] and least <= limits[1]:
        return ""
    return (
        f"is {longest:.3g} m long; category {asset.category} allows {limits[0]:g} to {limits[1]:g} m; "
        "correct its unit or its category"
    )
