# SPDX-License-Identifier: MIT
"""The last step of every import: the package is written, checked as a whole, and recorded.

``import.json`` beside ``asset.json`` keeps what the importer approximated and noticed; it is no part of the
asset's hash.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from datagen.asset_check import check_package
from datagen.formats.base import canonical_json
from datagen.formats.package import AnyAsset, FileSource, Package, write_package
from datagen.foundation.findings import Findings
from datagen.importers.common import ImportedAsset, ImportOptions

RECORD_FILE = "import.json"


def finish(
    asset: AnyAsset,
    files: Mapping[str, FileSource],
    folder: Path,
    options: ImportOptions,
    findings: Findings,
) -> ImportedAsset:
    """Write ``folder/<id>`` (or ``.zip``). Faults of the package are refused, warnings become notes."""
    record: dict[str, Any] = {
        "approximations": list(findings.approximations),
        "notes": list(findings.notes),
        "license": asset.provenance.license,
    }
    warnings: list[str] = []

    def validate(package: Package) -> None:
        report = check_package(package)
        report.raise_errors()
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
        )
