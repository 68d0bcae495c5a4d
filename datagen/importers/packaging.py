# SPDX-License-Identifier: MIT
"""Last step of every import, which writes, checks and records the package.

``import.json`` in the package lists approximations and notes; the package's hash excludes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from datagen.asset_check import check_package
from datagen.formats.asset import MaterialAsset, ObjectAsset, PanoramaAsset
from datagen.formats.base import canonical_json
from datagen.formats.package import AnyAsset, FileSource, Package, write_package
from datagen.foundation.errors import raise_problems
from datagen.foundation.findings import Findings
from datagen.importers.common import ImportedAsset, ImportOptions

RECORD_FILE = "import.json"


def finish(
    asset: AnyAsset, files: Mapping[str, FileSource], folder: Path, options: ImportOptions, findings: Findings
) -> ImportedAsset:
    """Write, check and record the package ``folder/<id>`` (or ``.zip``).

    Warnings of the check become notes of the returned record, but not of ``import.json``. Raises
    :class:`InputError` if the package is invalid, or if it exists and ``options.overwrite`` is off.
    """
    record: dict[str, Any] = {
        "approximations": list(findings.approximations),
        "notes": list(findings.notes),
        "license": asset.provenance.license,
    }
    warnings: list[str] = []

    def validate(package: Package) -> None:
        report = check_package(package)
        raise_problems(report.errors)
        warnings.extend(f"{problem.field}: {problem.got}" for problem in report.warnings)

    path = folder / (f"{asset.id}.zip" if options.as_zip else asset.id)
    content = {**files, RECORD_FILE: canonical_json(record)}
    with write_package(path, asset, content, overwrite=options.overwrite, validate=validate) as package:
        for sentence in warnings:
            findings.note(sentence)
        return ImportedAsset(
            asset_id=asset.id,
            kind=asset.kind,
            path=path,
            sha256=package.sha256,
            license=asset.provenance.license,
            approximations=findings.approximations,
            notes=findings.notes,
            contents=_contents(asset),
        )


def _contents(asset: AnyAsset) -> str:
    """Describe an object or room by size and contents, a material by classes, a panorama by time of day."""
    if isinstance(asset, PanoramaAsset):
        return asset.daytime
    if isinstance(asset, MaterialAsset):
        size = f", {asset.material.tile_size_m:g} m per tile" if asset.material.tile_size_m else ""
        return ", ".join(asset.material.classes) + size
    text = f"{_counted(len(asset.parts), 'part')}, {_counted(len(asset.materials), 'material')}"
    if isinstance(asset, ObjectAsset):
        sides = [high - low for low, high in zip(asset.minimum_m, asset.maximum_m, strict=True)]
        text = " × ".join(f"{side:.2f}" if side >= 0.1 else f"{side:.2g}" for side in sides) + f" m, {text}"
    return text


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
