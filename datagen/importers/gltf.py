# SPDX-License-Identifier: MIT
"""Import of glTF 2.0 files as object or environment packages in metres, Z up, with D, S and R.

glTF's +Y (up) becomes +Z, and its +Z (front) becomes -Y. An object is centred in x and y and placed on the
plane z = 0. Texture coordinates are flipped so that v points up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from datagen.formats.asset import AssetCamera, EnvironmentAsset, ObjectAsset
from datagen.formats.base import matrix4, quantized, vector3
from datagen.formats.category_sizes import size_fault
from datagen.formats.lights import DirectionalLight, Light, PointLight, SpotLight
from datagen.foundation.axes import affine, asset_from_source
from datagen.foundation.budget import Budget
from datagen.foundation.errors import InputError, input_error, raise_problems
from datagen.foundation.findings import Findings
from datagen.foundation.meshes.gltf import TRIANGLE_MODES, GltfFile, PlacedNode, triangles_of
from datagen.foundation.meshes.mesh import (
    SINGULAR,
    Mesh,
    bounds,
    flat_shaded,
    inspect_mesh,
    with_sound_normals,
    without_degenerate,
)
from datagen.foundation.naming import slug, unique
from datagen.importers import annotate
from datagen.importers.classes import guess_category, guess_supports
from datagen.importers.common import ImportedAsset, ImportJob, ImportOptions, note_mended, provenance
from datagen.importers.gltf_materials import GltfMaterial, GltfMaterialConverter
from datagen.importers.mitsuba_shapes import transformed_uv
from datagen.importers.packaging import finish

LUMENS_PER_WATT = 683.0
"""Luminous efficacy by which exporters such as Blender's convert radiometric to photometric units."""
_ROOM_SIDE_M, _ROOM_HEIGHT_M = 2.5, 2.0
_TOUCH_M = 0.005
DRACO_REMEDY = "export it without, or install Blender's module, which decodes it (extra `blender`)"
_OPENING_AREA_M2 = 0.3


@dataclass
class _Piece:
    """A primitive of a glTF node. ``root``: index of the node's root node; ``mesh``: in the asset's frame."""

    name: str
    root: int
    mesh: Mesh
    material: GltfMaterial


def import_gltf(
    path: Path,
    out_library: Path,
    options: ImportOptions,
    *,
    split: bool = False,
    origin: Path | None = None,
    findings: Findings | None = None,
) -> list[ImportedAsset]:
    """Convert a .gltf or .glb file to a package below ``out_library`` or, if ``split``, to one package for
    each group of touching root nodes.

    If ``path`` was converted from another format, ``origin`` is the original file, whose licence is used and
    which errors name, and ``findings`` are those of the conversion. Raises :class:`InputError` for unknown
    extensions, missing files, refused transparent materials or an unknown licence.
    """
    budget = Budget(origin or path, options.limits)
    try:
        with GltfFile(path, budget, options.allowed) as file:
            importer = _GltfImporter(file, options, origin or path, findings)
            groups = importer.groups() if split else [importer.pieces]
            return [importer.write(group, out_library, is_alone=len(groups) == 1) for group in groups]
    except InputError as error:
        if origin is None:
            raise
        moved = (replace(p, where=origin) if p.where == path else p for p in error.problems)
        raise InputError(*moved) from None


class _GltfImporter(ImportJob):
    def __init__(self, file: GltfFile, options: ImportOptions, origin: Path, findings: Findings | None):
        super().__init__(file.path, options, findings, file.budget)
        self.file, self.materials = file, GltfMaterialConverter(file, self)
        up: Literal["y", "z"] = "z" if options.up == "z" else "y"
        self.asset_from_source = asset_from_source(up, options.unit_m)
        self.annotations = annotate.read_annotations(options.annotations)
        self.source, self.title = provenance(origin, origin.parent, options, self.findings)
        self.nodes = list(file.placed_nodes())
        self.names = {placed.index: placed.name for placed in self.nodes}
        file.placed_primitives(self.nodes)
        self.num_mended: list[int] = []  # number of replaced normals per primitive
        self.pieces = self._collect()
        note_mended(self.findings, self.num_mended)
        raise_problems(self.problems)
        if not self.pieces:
            raise file.error("meshes", "no triangles in the scene", "at least one mesh", "check the export")

    # geometry

    def _collect(self) -> list[_Piece]:
        pieces: list[_Piece] = []
        taken: set[str] = set()
        for key in ("animations", "skins"):
            if self.file.items(key):
                self.findings.approximate(f"{self.file.path.name}: {key} left out, the rest pose is used")
        for placed in self.nodes:
            if "mesh" not in placed.node:
                continue
            entry = self.file.item("meshes", placed.node["mesh"], f"node {placed.name!r}")
            primitives = entry.get("primitives", [])
            for k, primitive in enumerate(primitives):
                label = placed.name if len(primitives) == 1 else f"{placed.name}_{k}"
                piece = self._piece(placed, primitive, label, str(entry.get("name", "")))
                if piece is not None:
                    piece.name = unique(slug(label), taken)
                    taken.add(piece.name)
                    pieces.append(piece)
        return pieces

    def _piece(
        self, placed: PlacedNode, primitive: dict[str, Any], label: str, mesh_name: str
    ) -> _Piece | None:
        extensions = primitive.get("extensions", {})
        if "KHR_draco_mesh_compression" in extensions:
            raise self.file.error(f"node {label!r}", "Draco compression", "uncompressed meshes", DRACO_REMEDY)
        if primitive.get("mode", 4) not in TRIANGLE_MODES:
            self.findings.approximate(f"{label}: points or lines left out")
            return None
        if primitive.get("targets"):
            self.findings.approximate(f"{label}: morph targets left out")
        if "COLOR_0" in primitive.get("attributes", {}):
            self.findings.approximate(f"{label}: vertex colours left out")
        material = self.materials.convert(
            primitive.get("material"), placed.name, mesh_name, self.file.path.stem
        )
        mesh = self._mesh(primitive, material, label)
        matrix = self.asset_from_source @ placed.scene_from_node
        if abs(np.linalg.det(matrix[:3, :3])) < SINGULAR:
            self.findings.approximate(f"{label}: scaled to zero, left out")
            return None
        if np.linalg.det(matrix[:3, :3]) < 0:  # a mirroring node reverses the winding
            mesh = replace(mesh, faces=mesh.faces[:, ::-1].copy())
        mesh = mesh.transformed(matrix)
        faults = inspect_mesh(mesh)
        if faults.bad_indices or faults.non_finite:
            raise self.file.error(f"node {label!r}", "NaN, infinite or missing vertices", "an intact mesh")
        if faults.is_unusable:
            self.findings.approximate(f"{label}: mesh without a surface left out")
            return None
        return _Piece(label, placed.root, without_degenerate(mesh), material)

    def _mesh(self, primitive: dict[str, Any], material: GltfMaterial, label: str) -> Mesh:
        attributes = primitive.get("attributes", {})
        if "POSITION" not in attributes:
            raise self.file.error(f"node {label!r}", "no POSITION", "vertex positions")
        positions = self.file.accessor(attributes["POSITION"], label).astype(np.float32)
        if "indices" in primitive:
            indices = self.file.accessor(primitive["indices"], label)[:, 0].astype(np.int64)
        else:
            indices = np.arange(len(positions))
        faces = triangles_of(indices, int(primitive.get("mode", 4)))
        uv = None
        uv_name = f"TEXCOORD_{material.uv_set}"
        if uv_name in attributes:
            uv = self.file.accessor(attributes[uv_name], label).astype(np.float32)
            uv = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)
            if material.uv_matrix is not None:
                uv = transformed_uv(uv, material.uv_matrix)
        if len(faces) and (faces.max() >= len(positions) or faces.min() < 0):
            raise self.file.error(f"node {label!r}", "indices beyond the vertices", "an intact mesh")
        if "NORMAL" in attributes:
            normals = self.file.accessor(attributes["NORMAL"], label).astype(np.float32)
            mesh, num_mended = with_sound_normals(Mesh(positions, faces, normals, uv))
            self.num_mended.append(num_mended)
            return mesh
        return flat_shaded(Mesh(positions, faces, None, uv))  # as glTF requires for files without normals

    def groups(self) -> list[list[_Piece]]:
        """Group pieces by root node, and merge groups with touching bounding boxes (a pot and its lid)."""
        by_root: dict[int, list[_Piece]] = {}
        for piece in self.pieces:
            by_root.setdefault(piece.root, []).append(piece)
        roots = list(by_root)
        boxes = [bounds([piece.mesh for piece in by_root[r]]) for r in roots]
        low, high = (np.stack(side) for side in zip(*boxes, strict=True))
        leader = {r: r for r in roots}

        def find(root: int) -> int:
            while leader[root] != root:
                root = leader[root]
            return root

        for k, a in enumerate(roots):
            above, below = np.maximum(low[k], low[k + 1 :]), np.minimum(high[k], high[k + 1 :])
            for other in np.flatnonzero((above <= below + _TOUCH_M).all(axis=1)):
                leader[find(roots[k + 1 + other])] = find(a)
        found: dict[int, list[_Piece]] = {}
        for piece in self.pieces:
            found.setdefault(find(piece.root), []).append(piece)
        return list(found.values())

    # packages

    def write(self, pieces: list[_Piece], out_library: Path, *, is_alone: bool) -> ImportedAsset:
        stem = self.file.path.stem
        first = self.names[pieces[0].root]
        name = (self.options.asset_id if is_alone else "") or slug(stem if is_alone else first)
        words = name.replace("_", " ").replace("-", " ")
        title = (self.options.title if is_alone else "") or words.capitalize()
        low, high = bounds([piece.mesh for piece in pieces])
        size = high - low
        kind = self.options.kind
        if kind == "auto":
            is_room = min(size[0], size[1]) > _ROOM_SIDE_M and size[2] > _ROOM_HEIGHT_M
            kind = "environment" if is_room else "object"
        if kind == "material":
            raise input_error(self.file.path, "kind", kind, "object or environment")
        is_object = kind == "object"
        shift = [-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]] if is_object else [0.0, 0.0, 0.0]
        meshes = [piece.mesh.transformed(affine(np.eye(3), shift)) for piece in pieces]
        parts, slots, files = self.contents(
            [
                (p.name, slot := p.material.slot, self.annotations.corrected(slot, p.material.material), mesh)
                for p, mesh in zip(pieces, meshes, strict=True)
            ]
        )
        fields = {"id": name, "title": title, "provenance": self.source, "materials": slots, "parts": parts}
        asset = self._object(fields, meshes) if is_object else self._environment(fields, meshes)
        return finish(asset, files, out_library / f"{kind}s", self.options, self.findings)

    def _object(self, fields: dict[str, Any], meshes: list[Mesh]) -> ObjectAsset:
        name = fields["id"]
        low = np.min([m.positions.min(axis=0) for m in meshes], axis=0)
        high = np.max([m.positions.max(axis=0) for m in meshes], axis=0)
        category = self.options.category or guess_category(name, *(part.name for part in fields["parts"]))
        if not category:
            category = "other"
            self.findings.note(f"{name}: category unknown; give it with --category")
        size = high - low
        if size.max() > 10 or size.max() < 0.01:
            self.findings.note(f"{name}: {size.max():.3g} m large; is the unit a metre? see --unit-scale")
        if any(light.get("extensions", {}).get("KHR_lights_punctual") for light in self.file.items("nodes")):
            self.findings.approximate(f"{name}: lights of the file left out of the object")
        asset = ObjectAsset(
            **fields,
            category=category,
            minimum_m=(quantized(float(low[0]), 7), quantized(float(low[1]), 7), 0.0),
            maximum_m=vector3(high.astype(np.float64)),
            supports=guess_supports(category, float(size[2]), float(max(size[0], size[1]))),
        )
        fault = size_fault(asset)
        if fault:
            self.findings.note(f"{name}: {fault}")
        return asset

    def _environment(self, fields: dict[str, Any], meshes: list[Mesh]) -> EnvironmentAsset:
        parts, slots, cameras = fields["parts"], fields["materials"], self._cameras()
        places = annotate.places_of_parts(meshes, parts, slots, cameras, self.findings)
        if places.camera_regions:
            region = places.camera_regions[0]
            inside = (np.asarray(region.minimum_m) + np.asarray(region.maximum_m)) / 2
        else:
            inside = np.mean([m.positions.mean(axis=0, dtype=np.float64) for m in meshes], axis=0)
        emitters = [
            (part.name, mesh)
            for part, mesh in zip(parts, meshes, strict=True)
            if slots[part.material].emission is not None
        ]
        openings = (annotate.opening_of(mesh, label, inside) for label, mesh in emitters)
        windows = tuple(o for o in openings if annotate.is_window_sized(o, _OPENING_AREA_M2))
        return EnvironmentAsset(
            **fields,
            lights=tuple(self._lights()),
            cameras=cameras,
            **self.annotations.over(places, windows),
        )

    def _cameras(self) -> tuple[AssetCamera, ...]:
        """Convert perspective cameras; images are 720 pixels high, since glTF states no resolution."""
        found = []
        for placed in self.nodes:
            if "camera" not in placed.node:
                continue
            entry = self.file.item("cameras", placed.node["camera"], placed.name)
            if entry.get("type") != "perspective":
                self.findings.approximate(f"{placed.name}: orthographic camera left out")
                continue
            perspective = entry["perspective"]
            height = 720
            width = round(height * float(perspective.get("aspectRatio", 16 / 9)))
            focal = 0.5 * height / math.tan(0.5 * float(perspective["yfov"]))
            matrix = self.asset_from_source @ placed.scene_from_node @ np.diag([1.0, -1.0, -1.0, 1.0])
            matrix[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)
            found.append(
                AssetCamera(
                    name=placed.name,
                    width_px=width,
                    height_px=height,
                    fx_px=quantized(focal),
                    fy_px=quantized(focal),
                    cx_px=width / 2,
                    cy_px=height / 2,
                    asset_from_camera=matrix4(matrix),
                )
            )
        return tuple(found)

    def _lights(self) -> list[Light]:
        """Convert KHR_lights_punctual lights, which emit along -Z, from candela and lux to W/sr and W/m^2."""
        entries = self.file.json.get("extensions", {}).get("KHR_lights_punctual", {}).get("lights", [])
        found: list[Light] = []
        names: set[str] = set()
        for placed in self.nodes:
            use = placed.node.get("extensions", {}).get("KHR_lights_punctual")
            if use is None:
                continue
            if not 0 <= int(use.get("light", -1)) < len(entries):
                raise input_error(
                    self.file.path,
                    f"node {placed.name!r}: light",
                    use.get("light"),
                    f"an index below {len(entries)} into lights",
                )
            entry = entries[int(use["light"])]
            matrix = self.asset_from_source @ placed.scene_from_node
            strength = float(entry.get("intensity", 1.0)) / LUMENS_PER_WATT
            red, green, blue = (float(c) * strength for c in entry.get("color", (1.0, 1.0, 1.0)))
            value = (red, green, blue)
            name = unique(placed.name, names)
            names.add(name)
            direction = vector3(-matrix[:3, 2] / np.linalg.norm(matrix[:3, 2]))
            position = vector3(matrix[:3, 3])
            if entry.get("type") == "directional":
                found.append(DirectionalLight(name=name, direction=direction, irradiance=value))
            elif entry.get("type") == "spot":
                cone = entry.get("spot", {})
                outer = float(cone.get("outerConeAngle", math.pi / 4))
                found.append(
                    SpotLight(
                        name=name,
                        position_m=position,
                        direction=direction,
                        intensity=value,
                        cutoff_rad=min(outer, 1.57),
                        beam_width_rad=min(float(cone.get("innerConeAngle", 0.0)), outer),
                    )
                )
            else:
                found.append(PointLight(name=name, position_m=position, intensity=value))
        return found
