# SPDX-License-Identifier: MIT
"""Verifies one shard: its members, each view, then the agreement of views."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import ModelT, sha256_file, sha256_hex
from datagen.formats.configuration import Configuration
from datagen.formats.shard import (
    CONFIGURATION_MEMBER,
    CONFIGURATION_MEMBERS,
    ShardReader,
    ShardRecord,
    parse_member,
)
from datagen.formats.view import ViewRecord
from datagen.foundation.buffers import STATISTICS_BUFFERS
from datagen.foundation.errors import InputError
from datagen.foundation.exr import decode_view
from datagen.inspection import checks
from datagen.inspection.findings import Fault, Report
from datagen.inspection.reprojection import Geometry, check_reprojection


@dataclass(frozen=True)
class ShardJob:
    """A shard to verify.

    ``file`` is its name in the report, ``record`` its entry in the index, ``buffers`` the names of the
    buffers that every view must have, ``textured`` the range of roughness by name of textured material (None:
    unknown).
    """

    path: Path
    file: str
    record: ShardRecord | None = None
    buffers: tuple[str, ...] = ()
    textured: dict[str, float] | None = None


def verify_shard(job: ShardJob) -> Report:
    """Run all checks of a shard; faults of its content are reported, never raised."""
    where = job.file
    report = Report(where, num_shards=1)
    if not job.path.is_file():
        report.applied["member"] += 1
        report.faults.append(Fault("member", where, "no such file", "a shard that the index lists"))
        return report
    if job.record is not None:
        report.applied["hash"] += 1
        digest, size = sha256_file(job.path), job.path.stat().st_size
        if digest != job.record.sha256:
            got = f"SHA-256 {digest[:16]}..., {size} bytes"
            expected = f"{job.record.sha256[:16]}..., {job.record.num_bytes} bytes, as in the index"
            report.faults.append(Fault("hash", where, got, expected))
    _ShardVerifier(job, where, report).run()
    return report


class _ShardVerifier:
    """Verifier of a shard; reads each member once, and keeps the data that checks across views need."""

    def __init__(self, job: ShardJob, where: str, report: Report):
        self.job, self.where, self.report = job, where, report
        self.configuration: Configuration | None = None
        self.images: dict[str, bytes] = {}
        self.records: dict[str, ViewRecord] = {}
        self.geometries: list[Geometry] = []
        self.beauties: dict[str, dict[str, NDArray]] = {}
        self.roughness: dict[int, list[tuple[int, float, float]]] = {}
        self.materials: dict[str, str] = {}

    def add(self, check: str, where: str, got: str, expected: str) -> None:
        self.report.faults.append(Fault(check, where, got, expected))

    def add_problems(self, error: InputError) -> None:
        for p in error.problems:
            self.add("member", str(p.where), ": ".join(filter(None, (p.field, p.got))), p.expected)

    def run(self) -> None:
        """Read every member, then run the checks that need all views."""
        self.report.applied["member"] += 1
        seen: set[str] = set()
        try:
            for name, data in ShardReader(self.job.path).members():
                if name in seen:
                    self.add("member", f"{self.where}:{name}", "the member occurs twice", "once")
                seen.add(name)
                self.read_member(name, data)
        except InputError as error:
            self.add_problems(error)
        for name in self.images:
            self.add("member", f"{self.where}:{name}", "an image without a record", "an image and a record")
        self.check_against_configuration()
        self.check_across_views()

    def parse(self, model: type[ModelT], data: bytes, where: str) -> ModelT | None:
        try:
            return parse_member(model, data, where)
        except InputError as error:
            self.add_problems(error)
            return None

    def read_member(self, name: str, data: bytes) -> None:
        where = f"{self.where}:{name}"
        stem, _, suffix = name.rpartition(".")
        if name in CONFIGURATION_MEMBERS:
            self.configuration = self.parse(Configuration, data, where)
        elif suffix == "exr":
            self.images[stem] = data
        elif suffix == "json":
            image = self.images.pop(stem, None)
            record = self.parse(ViewRecord, data, where)
            if record is None:
                return
            self.records[record.name] = record
            if image is None:
                self.add(
                    "member", where, "a record without an image before it", "each image before its record"
                )
            else:
                self.check_view(record, image, f"{self.where}:{stem}")
        else:
            self.add("member", where, "a member of unknown kind", "EXR or JSON")

    def check_view(self, record: ViewRecord, image: bytes, where: str) -> None:
        """Run all checks of a single view."""
        self.report.num_views += 1
        self.report.applied["hash"] += 1
        if sha256_hex(image) != record.exr_sha256:
            self.add("hash", where, f"image with SHA-256 {sha256_hex(image)[:16]}...", record.exr_sha256[:16])
        try:
            view = decode_view(image)
        except InputError as error:
            for p in error.problems:
                self.add("member", where, p.got or p.field, p.expected)
            return
        camera = record.camera.camera()
        expected = sorted({*self.job.buffers, *record.buffers})
        self.apply("buffer", checks.check_buffers(view, expected, camera, where))
        if any(array.shape[:2] != (camera.height_px, camera.width_px) for array in view.values()):
            return  # arrays that do not fit their camera cannot be compared
        self.apply("finite", checks.check_finite(view, where))
        self.apply("range", checks.check_range(view, where))
        if {"normal_world", "surface_mask"} <= view.keys():
            self.apply("normal", checks.check_normals(view, where))
        if "beauty" in view:
            self.apply("firefly", checks.check_fireflies(view, where))
            self.beauties[where] = {"beauty": view["beauty"]}
        if {*STATISTICS_BUFFERS, "beauty", "depth_z_m", "surface_mask"} <= view.keys():
            statistics = record.statistics
            most = min(statistics.best_views, statistics.num_views) if statistics else 2048
            has_own = statistics is None or statistics.include_self
            self.apply("statistics", checks.check_statistics(view, most, has_own, where))
        if {"depth_z_m", "normal_world", "surface_mask"} <= view.keys():
            self.geometries.append(Geometry.from_buffers(record.name, camera, view))
        if {"roughness", "material_id", "surface_mask"} <= view.keys():
            for material, found in checks.roughness_ranges(view).items():
                self.roughness.setdefault(material, []).append(found)
            self.materials.update(record.materials)

    def apply(self, check: str, faults: Iterable[Fault]) -> None:
        self.report.applied[check] += 1
        self.report.faults += faults

    def check_against_configuration(self) -> None:
        if self.job.record is not None and self.job.record.num_views != len(self.records):
            got, expected = f"{len(self.records)} views", f"{self.job.record.num_views}, as in the index"
            self.add("member", self.where, got, expected)
        if self.configuration is None:
            self.add("member", f"{self.where}:{CONFIGURATION_MEMBER}", "missing or unreadable", "this member")
            return
        cameras = {camera.name: camera for camera in self.configuration.cameras}
        for name in sorted(cameras.keys() - self.records.keys()):
            self.add("member", f"{self.where}:{name}", "no such view", "a view of every camera")
        for name, record in self.records.items():
            where = f"{self.where}:{name}"
            if name not in cameras:
                self.add("member", where, "a view without a camera", "a camera in the configuration")
            elif record.camera != cameras[name]:
                self.add("member", where, "a camera that differs from the configuration's", "the same camera")
            if record.configuration != self.configuration.id:
                self.add("member", where, f"a view of {record.configuration}", self.configuration.id)

    def check_across_views(self) -> None:
        exposures = [record.exposure for record in self.records.values() if record.exposure > 0]
        exposure = float(np.median(exposures)) if exposures else 1.0
        for where, view in self.beauties.items():
            self.apply("exposure", checks.check_exposure(view, exposure, where))
        if self.job.textured is not None:
            found = checks.check_roughness(self.roughness, self.materials, self.job.textured, self.where)
            self.apply("roughness", found)
        faults, compared = check_reprojection(self.geometries, self.where)
        self.report.faults += faults
        self.report.applied["reprojection"] += compared
        if compared < len(self.geometries):
            count = len(self.geometries) - compared
            self.report.notes.append(f"{self.where}: {count} views share too little with others to compare")
