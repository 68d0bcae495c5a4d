# SPDX-License-Identifier: MIT
"""Common parts of the importers: options, records of imported assets, and provenance."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from datagen.formats.asset import MaterialClass, Part, Provenance, SlotMaterial
from datagen.formats.base import IDENTITY4, Matrix4, Positive, Slug, quantized
from datagen.formats.package import FileSource
from datagen.foundation.budget import Budget, Limits
from datagen.foundation.errors import Problems, input_error
from datagen.foundation.findings import Findings
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import encode_ply
from datagen.foundation.paths import inside
from datagen.importers.channels import ImageCache, TextureFiles

EVALUATION_SCENES = {"veach-ajar": "Veach, Ajar", "dining-room": "The Breakfast Room"}
"""Titles, by folder name, of two scenes that are always imported as ``evaluation_only``."""

RESTORE_IT = "restore it, or import with --missing replace"
OPAL_ALBEDO = 0.7
"""D of the opal glass that replaces clear glass, about as bright as a room seen through the glass."""
_LICENSE_FILES = ("LICENSE.txt", "LICENSE", "LICENSE.md", "license.txt", "README.txt", "README.md")
_MAX_LICENSE_CHARACTERS = 1 << 20
_LICENSE_PATTERNS = (
    (re.compile(r"creativecommons\.org/publicdomain/zero/1\.0|\bCC0\b", re.I), "CC0-1.0"),
    (re.compile(r"creativecommons\.org/licenses/by/3\.0", re.I), "CC-BY-3.0"),
    (re.compile(r"creativecommons\.org/licenses/by/4\.0", re.I), "CC-BY-4.0"),
    (re.compile(r"creativecommons\.org/licenses/by-sa/3\.0", re.I), "CC-BY-SA-3.0"),
    (re.compile(r"creativecommons\.org/licenses/by-sa/4\.0", re.I), "CC-BY-SA-4.0"),
    (re.compile(r"creativecommons\.org/licenses/by-nc/4\.0", re.I), "CC-BY-NC-4.0"),
)
_PUBLISHERS = {"ambientcg": ("CC0-1.0", "ambientCG", "https://ambientcg.com")}
"""Licence, author and address of publishers with a single licence, by ``creator`` in ``info.json``."""
_TITLE = re.compile(r"version of '(?P<title>[^']+)' by (?P<author>[^,\n]+), downloaded", re.I)
_SOURCE = re.compile(r"original file may be obtained here:\s*(?P<source>\S+)", re.I)


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import. Empty strings stand for values that are detected or derived.

    ``dielectric``: ``refuse`` transparent materials, or ``replace`` them: flat panes and thin dielectrics are
    removed, solid bodies become opal glass; ``dielectric_as`` overrides this by name. ``missing``:
    ``refuse`` missing files, or ``replace`` them with grey or omit them. ``unit_scale``: metres per unit of
    the file; None: 1, or a plausible value for formats without a unit. ``defines``: values of a Mitsuba
    scene's variables. ``allowed``: folders, in addition to the source's, from which files may be read.
    ``limits`` apply to each source; None: :meth:`Limits.from_environment`.
    """

    kind: Literal["auto", "environment", "object", "material"] = "auto"
    asset_id: str = ""
    title: str = ""
    license: str = ""
    author: str = ""
    source: str = ""
    evaluation_only: bool = False
    category: Literal[""] | Slug = ""
    classes: tuple[MaterialClass, ...] = ()
    up: Literal["auto", "y", "z"] = "auto"
    unit_scale: Positive | None = None
    tile_size_m: Positive | None = None
    dielectric: Literal["refuse", "replace"] = "refuse"
    dielectric_as: dict[str, Literal["opaque", "remove"]] = field(default_factory=dict)
    missing: Literal["refuse", "replace"] = "refuse"
    annotations: Path | None = None
    defines: dict[str, str] = field(default_factory=dict)
    allowed: tuple[Path, ...] = ()
    limits: Limits | None = None
    as_zip: bool = False
    overwrite: bool = False

    @property
    def unit_m(self) -> float:
        """Metres per unit of the file: ``unit_scale`` or, by default, 1."""
        return 1.0 if self.unit_scale is None else self.unit_scale


class ImportJob:
    """State of the import of the source ``where``: options, budget, findings, problems and textures.

    ``findings`` collect approximations and notes. An enclosing import may pass its findings and budget.
    """

    def __init__(
        self,
        where: str | Path,
        options: ImportOptions,
        findings: Findings | None = None,
        budget: Budget | None = None,
    ):
        self.where, self.options, self.findings = where, options, findings or Findings()
        self.budget = budget or Budget(where, options.limits)
        self.problems = Problems(where)
        self.cache = ImageCache(self.budget)
        self.textures = TextureFiles(self.cache)

    def contents(
        self, pieces: Sequence[tuple[str, str, SlotMaterial, Mesh]]
    ) -> tuple[tuple[Part, ...], dict[str, SlotMaterial], dict[str, FileSource]]:
        """Return the parts, the materials by slot, and the files of an asset.

        ``pieces`` are its parts as (name, slot, material, mesh in the asset's frame).
        """
        parts = tuple(part_of(name, slot, mesh) for name, slot, _, mesh in pieces)
        materials = {slot: material for _, slot, material, _ in pieces}
        used = {texture.texture for material in materials.values() for texture in material.textures()}
        files = {name: self.textures.files[name] for name in sorted(used)}
        files |= {part.mesh: encode_ply(mesh) for part, (*_, mesh) in zip(parts, pieces, strict=True)}
        return parts, materials, files


@dataclass(frozen=True)
class ImportedAsset:
    """The record of one imported asset.

    ``approximations`` list approximated or omitted content, ``notes`` the importer's decisions and other
    remarks; both are sentences that begin with the name of their subject. ``contents``: the asset's size and
    numbers of parts and materials, as text.
    """

    asset_id: str
    kind: str
    path: Path
    sha256: str
    license: str
    approximations: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    contents: str = ""


@dataclass(frozen=True)
class Origin:
    """SPDX licence, title, author and source as stated by files in a source's folder; '' if missing."""

    license: str = ""
    title: str = ""
    author: str = ""
    source: str = ""


def detect_origin(folder: Path) -> Origin:
    """Read licence and authorship from ``info.json`` or a licence file in a source's folder."""
    info = folder / "info.json"
    if info.is_file():
        inside(folder, info)
        try:
            with info.open(encoding="utf-8") as file:
                data = json.loads(file.read(_MAX_LICENSE_CHARACTERS))
        except (ValueError, OSError, RecursionError):
            data = {}
        if isinstance(data, dict) and str(data.get("creator", "")).lower() in _PUBLISHERS:
            license_id, author, source = _PUBLISHERS[str(data["creator"]).lower()]
            return Origin(license_id, str(data.get("name", "")), author, source)
    for name in _LICENSE_FILES:
        path = folder / name
        if not path.is_file():
            continue
        with inside(folder, path).open(encoding="utf-8", errors="replace") as file:
            text = file.read(_MAX_LICENSE_CHARACTERS)
        found = {spdx for pattern, spdx in _LICENSE_PATTERNS if pattern.search(text)}
        if len(found) == 1:
            title, link = _TITLE.search(text), _SOURCE.search(text)
            return Origin(
                found.pop(),
                title["title"] if title else "",
                title["author"].strip() if title else "",
                link["source"] if link else "",
            )
    return Origin()


def provenance(
    source: Path, folder: Path, options: ImportOptions, findings: Findings
) -> tuple[Provenance, str]:
    """Return the provenance of an imported asset and its title ('' if unknown).

    Raises :class:`InputError` if the licence is neither given nor stated in ``folder``; it is never guessed.
    """
    origin = detect_origin(folder)
    license_id = options.license or origin.license
    if not license_id:
        expected = "an SPDX identifier such as CC0-1.0 or CC-BY-4.0"
        remedy = "give it with --license; only the rights holder can state it"
        raise input_error(source, "license", "nothing", expected, remedy)
    names = {folder.name, source.stem}
    is_known = bool(names & set(EVALUATION_SCENES)) or origin.title in EVALUATION_SCENES.values()
    if is_known and not options.evaluation_only:
        findings.note(f"{folder.name}: a test scene of the method's paper, marked evaluation_only")
    return Provenance(
        license=license_id,
        author=options.author or origin.author,
        source=options.source or origin.source,
        usage="evaluation_only" if options.evaluation_only or is_known else "any",
    ), origin.title


def part_of(name: str, slot: str, mesh: Mesh, file: str = "", asset_from_part: Matrix4 = IDENTITY4) -> Part:
    """Return a part with ``mesh``, given in the asset's frame; ``file`` defaults to ``meshes/<name>.ply``."""
    density = mesh.uv_per_m()
    return Part(
        name=name,
        mesh=file or f"meshes/{name}.ply",
        material=slot,
        asset_from_part=asset_from_part,
        uv_per_m=None if density is None else quantized(density, 6),
    )


def note_mended(findings: Findings, num_mended: Sequence[int]) -> None:
    """Add a note on replaced normals; ``num_mended``: number of unusable normals in each mesh."""
    count, num = sum(num_mended), sum(n > 0 for n in num_mended)
    if count:
        findings.note(f"{count} normals of {num} meshes replaced (missing or tangent to the surface)")
