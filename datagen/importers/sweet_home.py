# SPDX-License-Identifier: MIT
"""Import of Sweet Home 3D furniture libraries (.sh3f) as object packages.

A model is rotated and scaled to the catalogue's width, depth and height, converted from Y up to Z up (its
front +Z becomes -Y) and placed on z = 0. Invalid pieces are skipped and listed in one error at the end.
Existing packages are kept, so an interrupted import can be resumed.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import ObjectAsset, Provenance, SupportKind
from datagen.formats.base import quantized, vector3
from datagen.formats.package import open_package
from datagen.foundation.axes import Z_UP_FROM_Y_UP, affine
from datagen.foundation.budget import Budget
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from datagen.foundation.images import IMAGE_SUFFIXES
from datagen.foundation.meshes.mesh import Mesh, bounds, with_sound_normals, without_degenerate
from datagen.foundation.naming import slug, unique
from datagen.importers.annotate import Annotations, read_annotations
from datagen.importers.classes import guess_category, guess_supports
from datagen.importers.common import RESTORE_IT, ImportedAsset, ImportJob, ImportOptions, note_mended
from datagen.importers.mitsuba_xml import is_pane
from datagen.importers.obj_model import ObjModel, PhongMaterial, read_mtl, read_obj_model
from datagen.importers.packaging import finish
from datagen.importers.sweet_home_catalogue import Catalogue, Piece, open_catalogue
from datagen.importers.sweet_home_materials import ConvertedMaterial, PhongConverter

_IMAGE_SUFFIXES = (*IMAGE_SUFFIXES, ".bmp", ".tga", ".tif", ".tiff")
_OUTER = 0.02  # share of the model's extent by which a pane must protrude to be kept
_STRETCH = 1.05  # ratio of largest to smallest axis scale that is reported as stretched
_FLAT = 1e-9  # relative extent below which a model is flat along an axis, which cannot be scaled
_Surface = tuple[str, ConvertedMaterial, Mesh]  # part name, material, mesh in the asset's frame
_CREDIT = re.compile(r'"[^"\n]+" by (?P<author>[^\n]+)|Created by (?P<maker>[^\n]+)')
_PAGE = re.compile(r"https?://(?:www\.)?blendswap\.com/blends?/(?:view/)?\d+")
_CATEGORIES = {"vehicles": "vehicle", "lights": "lamp", "doors and windows": "door", "staircases": "stairs"}
"""Object category by catalogue category; other catalogue categories name rooms (kitchen, office)."""


@dataclass(frozen=True)
class Step:
    """Result of importing a catalogue's piece: ``imported``, ``kept`` from an earlier run, or ``refused``."""

    name: str
    outcome: Literal["imported", "kept", "refused"]
    record: ImportedAsset | None = None
    category: str = ""
    problems: tuple[Problem, ...] = ()


StepObserver = Callable[[Step, int], None]
"""Callback that receives each step and the number of pieces in the catalogue."""


def import_sweet_home(
    path: Path, out_library: Path, options: ImportOptions | None = None, on_step: StepObserver | None = None
) -> list[ImportedAsset]:
    """Import the pieces of a .sh3f file, and return the records of all new and existing packages.

    Raises :class:`InputError` if the file is not a catalogue and, at the end, for all refused pieces.
    """
    options = options or ImportOptions()
    _check_options(path, options)
    with open_catalogue(path, Budget(path, options.limits)) as catalogue:
        records: list[ImportedAsset] = []
        problems: list[Problem] = []
        total = len(catalogue.pieces) + len(catalogue.problems)
        for step in _steps(catalogue, Path(out_library) / "objects", options):
            if step.record is not None:
                records.append(step.record)
            problems.extend(step.problems)
            if on_step is not None:
                on_step(step, total)
    raise_problems(problems)
    return records


def _check_options(path: Path, options: ImportOptions) -> None:
    """Refuse options that apply only to a single asset or contradict the catalogue."""
    problems = []
    if options.kind not in ("auto", "object"):
        expected = "object, the kind of furniture"
        problems.append(Problem(path, "kind", options.kind, expected, "leave --kind out"))
    for option, value, default in (
        ("id", options.asset_id, ""),
        ("title", options.title, ""),
        ("up", options.up, "auto"),
        ("unit-scale", options.unit_scale, None),
    ):
        if value != default:
            expected = "the catalogue's value for each piece"
            problems.append(Problem(path, option, str(value), expected, f"leave --{option} out"))
    raise_problems(problems)


def _steps(catalogue: Catalogue, folder: Path, options: ImportOptions) -> Iterator[Step]:
    """Import the pieces of a catalogue in order, and yield a :class:`Step` for each."""
    known = read_annotations(options.annotations)
    for name, error in catalogue.problems.items():
        yield Step(name, "refused", problems=error.problems)
    taken: set[str] = set()
    for piece in catalogue.pieces:
        asset_id = unique(slug(piece.id), taken)
        taken.add(asset_id)
        category = options.category or guess_piece_category(piece)
        try:
            path = folder / (f"{asset_id}.zip" if options.as_zip else asset_id)
            if path.exists() and not options.overwrite:
                kept = _kept(path, _source(catalogue, piece), options)
                yield Step(piece.id, "kept", kept, category)
                continue
            record = _PieceImport(catalogue, piece, options).run(folder, asset_id, category, known)
        except InputError as error:
            yield Step(piece.id, "refused", category=category, problems=error.problems)
            continue
        yield Step(piece.id, "imported", record, category)


def _kept(path: Path, origin: str, options: ImportOptions) -> ImportedAsset:
    """Return the record of a piece's existing package. Raises :class:`InputError` for another ``origin``."""
    with open_package(path) as package:
        source = package.asset.provenance
        if not (options.source or source.source).startswith(origin):
            expected = "a new path, since the package there has another source"
            raise input_error(path, got="exists already", expected=expected, remedy="remove it")
        return ImportedAsset(package.id, package.asset.kind, path, package.sha256, source.license)


class _PieceImport(ImportJob):
    """Import of one piece, with its own budget, since its data are released before the next piece."""

    def __init__(self, catalogue: Catalogue, piece: Piece, options: ImportOptions):
        super().__init__(f"{catalogue.path}: {piece.id}", options)
        self.catalogue, self.piece = catalogue, piece

    def run(self, folder: Path, asset_id: str, category: str, known: Annotations) -> ImportedAsset:
        piece, source = self.piece, self._provenance()
        self.budget.hold(self.catalogue.size_in_archive(piece.model))
        data = self.catalogue.read(piece.model)
        model = read_obj_model(data, f"{self.catalogue.path}/{piece.model}", self.budget)
        self.budget.spend("instances", len(model.surfaces), piece.model)
        num_materials = len({surface.material for surface in model.surfaces})
        hints = (piece.name, *piece.tags) if num_materials <= 2 else ()  # for guessing material classes
        with tempfile.TemporaryDirectory(prefix="sh3f-") as scratch:
            phongs = self._phong_materials(model)
            converter = PhongConverter(self, partial(self._image, Path(scratch)), hints, known)
            pieces = self._surfaces(model, phongs, converter)
            low, high = bounds([mesh for _, _, mesh in pieces])
            parts, materials, files = self.contents(
                [(name, converted.slot, converted.material, mesh) for name, converted, mesh in pieces]
            )
            asset = ObjectAsset(
                id=asset_id,
                title=piece.name,
                provenance=source,
                category=category,
                materials=materials,
                parts=parts,
                minimum_m=(quantized(float(low[0]), 7), quantized(float(low[1]), 7), 0.0),
                maximum_m=vector3(high),
                supports=self._supports(category),
            )
            return finish(asset, files, folder, self.options, self.findings)

    def _provenance(self) -> Provenance:
        """Return the licence, author and source. Raises :class:`InputError` without a licence."""
        piece, origin = self.piece, self.catalogue.origin
        license_id = self.options.license or piece.license or origin.license
        if not license_id:
            got, expected = "no known licence", "a licence in the catalogue or its LICENSE.TXT"
            remedy = "give it with --license; only the rights holder can state it"
            raise input_error(self.where, "license", got, expected, remedy)
        texts = [
            self.catalogue.read(member).decode("utf-8", "replace")
            for name, member in sorted(self.catalogue.beside(piece.model).items())
            if "license" in name or name.endswith(".mtl")
        ]
        credit = next((m for text in texts if (m := _CREDIT.search(text))), None)
        page = next((m[0] for text in texts if (m := _PAGE.search(text))), "")
        author = piece.creator
        if credit is not None and author in ("", "Blend Swap"):
            author = (credit["author"] or credit["maker"]).strip()
        if origin.holder and origin.holder not in author:
            author = f"{author} ({origin.holder})" if author else origin.holder
        source = _source(self.catalogue, piece) + (f", {page}" if page else "")
        return Provenance(
            license=license_id,
            author=self.options.author or author,
            source=self.options.source or source,
            usage="evaluation_only" if self.options.evaluation_only else "any",
        )

    def _phong_materials(self, model: ObjModel) -> dict[str, PhongMaterial]:
        """Return the materials, by name, of the MTL files that the model references."""
        beside = self.catalogue.beside(self.piece.model)
        found: dict[str, PhongMaterial] = {}
        absent = []
        for library in model.libraries:
            name = PurePosixPath(library.replace("\\", "/")).name.lower()
            if name in beside:
                member = beside[name]
                found.update(read_mtl(self.catalogue.read(member), f"{self.catalogue.path}/{member}"))
            else:
                absent.append(f"{library} (no such file)")
        absent += sorted({f"material {s.material!r}" for s in model.surfaces if s.material not in found})
        if absent and self.options.missing == "refuse":
            got = f"missing {', '.join(absent)}"
            raise input_error(self.where, "materials", got, "all in MTL files", RESTORE_IT)
        for name in absent:
            self.findings.approximate(f"{name}: missing, replaced by grey")
        return found

    def _image(self, scratch: Path, name: str) -> Path | None:
        """Unpack an image of the model, given by its lower-case name, and return its path, or None."""
        member = self.catalogue.beside(self.piece.model).get(name)
        if member is None or not name.endswith(_IMAGE_SUFFIXES):
            return None
        path = scratch / PurePosixPath(member).name
        if not path.exists():
            path.write_bytes(self.catalogue.read(member))
        return path

    def _surfaces(
        self, model: ObjModel, phongs: dict[str, PhongMaterial], converter: PhongConverter
    ) -> list[_Surface]:
        """Return name, material and mesh of each part, with the object centred in x and y and on z = 0."""
        matrix = self._asset_from_model(model)
        pieces: list[_Surface] = []
        panes: list[_Surface] = []
        num_mended: list[int] = []
        slots: set[str] = set()
        for surface in model.surfaces:
            slot = unique(surface.material or "default", slots)
            slots.add(slot)
            has_uv = surface.mesh.uv is not None
            phong = phongs.get(surface.material, PhongMaterial())
            material = converter.convert(slot, phong, is_mirror=surface.is_mirror, has_uv=has_uv)
            mesh = surface.mesh.transformed(matrix)
            if np.linalg.det(matrix[:3, :3]) < 0:
                mesh = replace(mesh, faces=mesh.faces[:, ::-1].copy())
            mesh = without_degenerate(mesh)
            if not len(mesh.faces) or material.treatment == "remove":
                continue
            mesh, mended = with_sound_normals(mesh)
            num_mended.append(mended)
            entry = (unique(slug(slot), {name for name, _, _ in pieces + panes}), material, mesh)
            is_flat = material.treatment == "pane" and is_pane(mesh)
            (panes if is_flat else pieces).append(entry)
        raise_problems(self.problems)
        note_mended(self.findings, num_mended)
        pieces, panes = _with_outer_panes(pieces, panes)
        if panes:
            names = ", ".join(material.slot for _, material, _ in panes)
            self.findings.approximate(f"{names}: flat transparent panes left out")
        if not pieces:
            raise input_error(self.where, got="no visible surface", expected="at least one")
        low, high = bounds([mesh for _, _, mesh in pieces])
        shift = affine(np.eye(3), (-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]))
        return [(name, material, mesh.transformed(shift)) for name, material, mesh in pieces]

    def _asset_from_model(self, model: ObjModel) -> NDArray[np.float64]:
        """Return the (4, 4) transform to the catalogue's rotation and size, from Y up to Z up."""
        piece = self.piece
        rotation = np.eye(3) if piece.rotation is None else piece.rotation
        points = np.concatenate([s.mesh.positions for s in model.surfaces]).astype(np.float64) @ rotation.T
        extent = points.max(axis=0) - points.min(axis=0)
        width, depth, height = piece.size_m
        size = np.array([width, height, depth])
        has_extent = extent > _FLAT * max(extent.max(), 1e-30)
        if not has_extent.any():
            raise input_error(self.where, got="a model of a single point", expected="a surface")
        scale = np.where(has_extent, size / np.maximum(extent, 1e-30), 1.0)
        scale[~has_extent] = np.median(scale[has_extent])
        ratio = float(scale[has_extent].max() / scale[has_extent].min())
        if ratio > _STRETCH:
            self.findings.note(f"{piece.name}: stretched unevenly to the catalogue's size ({ratio:.2f} : 1)")
        return Z_UP_FROM_Y_UP @ affine(np.diag(scale) @ rotation)

    def _supports(self, category: str) -> tuple[SupportKind, ...]:
        """Return the kinds of surface on which the piece may stand; none if it hangs or is built in."""
        piece = self.piece
        width, depth, height = piece.size_m
        if piece.is_light:
            self.findings.approximate(f"{piece.name}: light of the catalogue left out of the object")
        if piece.is_door_or_window or piece.elevation_m > 0 or category in ("door", "stairs"):
            self.findings.note(
                f"{piece.name}: hangs or is built in, at {piece.elevation_m:g} m; it is never placed"
            )
            return ()
        return guess_supports(category, height, max(width, depth))


def _source(catalogue: Catalogue, piece: Piece) -> str:
    return ", ".join(filter(None, (catalogue.origin.provider, catalogue.origin.id, piece.id)))


def guess_piece_category(piece: Piece) -> str:
    """Return the object category of a piece, from its catalogue category, else its name, else its tags."""
    tags = {t.lower() for t in piece.tags}
    if piece.is_door_or_window or piece.is_stairs:
        return "stairs" if piece.is_stairs else "door"
    if piece.category.lower() == "characters":
        return "animal" if "animal" in tags else "person"
    stated = _CATEGORIES.get(piece.category.lower())
    if stated:
        return stated
    names = (piece.name, *piece.tags, piece.id.rpartition("#")[2])
    fallback = "outdoor" if piece.category.lower() == "exterior" else "other"
    return next((c for name in names if (c := guess_category(name))), fallback)


def _with_outer_panes(pieces: list[_Surface], panes: list[_Surface]) -> tuple[list[_Surface], list[_Surface]]:
    """Return the surfaces to keep and the panes to remove.

    A pane that extends beyond all other surfaces, such as a table top, is kept as opal glass.
    """
    if not pieces or not panes:
        return panes + pieces, []
    low, high = bounds([mesh for _, _, mesh in pieces])
    all_low, all_high = bounds([mesh for _, _, mesh in pieces + panes])
    slack = _OUTER * (all_high - all_low)
    kept, removed = list(pieces), list[_Surface]()
    for pane in panes:
        points = pane[2].positions
        is_outer = ((points.min(axis=0) < low - slack) | (points.max(axis=0) > high + slack)).any()
        (kept if is_outer else removed).append(pane)
    return kept, removed
