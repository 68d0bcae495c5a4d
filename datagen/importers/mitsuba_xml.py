# SPDX-License-Identifier: MIT
"""Import of a Mitsuba scene (XML) as an environment package: one part per shape, metres, Z up.

docs/importing.md lists the conversions and their errors. Unsupported content is refused or, if an option
permits it, replaced or removed, which ``import.json`` records.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.asset import AssetCamera, EnvironmentAsset, MaterialClass, Part, SlotMaterial, Texture
from datagen.formats.base import IDENTITY4, matrix4
from datagen.formats.mitsuba.scene import MitsubaScene, SceneNode, parse_scene
from datagen.formats.mitsuba.sensors import camera_of, guess_up
from datagen.formats.package import FileSource
from datagen.foundation.axes import asset_from_source
from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from datagen.foundation.meshes.mesh import SINGULAR, Mesh, inspect_mesh, welded, without_degenerate
from datagen.foundation.meshes.ply import encode_ply
from datagen.foundation.naming import slug, unique
from datagen.importers import annotate
from datagen.importers.channels import BakedSource, ImageSource
from datagen.importers.classes import REPLACEABLE, guess_class
from datagen.importers.common import ImportedAsset, ImportJob, ImportOptions, note_mended, part_of, provenance
from datagen.importers.mitsuba_lights import LightConverter, emitter_shape_light
from datagen.importers.mitsuba_materials import Draft, MaterialConverter
from datagen.importers.mitsuba_shapes import FILE_SHAPES, SUPPORTED_SHAPES, shape_mesh, transformed_uv
from datagen.importers.mitsuba_values import file_of, normal_from_height
from datagen.importers.packaging import finish

_PANE_RATIO = 0.05  # maximum thickness of a pane relative to its second-largest extent
_SlotKey = tuple[int, tuple[float, float, float] | None]  # id() of the BSDF node, RGB radiance


@dataclass
class _Shape:
    """A shape that becomes a part; ``mesh``: in local coordinates, with UVs whose v points up."""

    node: SceneNode
    label: str
    mesh: Mesh
    file: Path | None
    source_from_shape: NDArray[np.float64]
    draft: Draft
    emission: tuple[float, float, float] | None
    bsdf: int
    slot: str = ""


def import_mitsuba_scene(
    path: Path, out_library: Path, options: ImportOptions | None = None
) -> ImportedAsset:
    """Convert a scene file to an environment package in ``out_library/environments/<id>``.

    Raises :class:`InputError` for unknown plugins, missing files, refused transparent materials or an unknown
    licence.
    """
    return _SceneImporter(path, options or ImportOptions()).run(out_library)


class _SceneImporter(ImportJob):
    def __init__(self, path: Path, options: ImportOptions):
        self.path = path / "scene.xml" if path.is_dir() else path
        super().__init__(self.path, options)
        self.files: dict[str, FileSource] = self.textures.files
        self.annotations = annotate.read_annotations(options.annotations)
        self.scene: MitsubaScene = parse_scene(self.path, options.defines, self.budget, options.allowed)
        self.materials = MaterialConverter(self)
        self.num_mended: list[int] = []  # number of replaced normals per shape
        self.meshes: dict[Any, tuple[Mesh, int]] = {}
        up = guess_up(self.scene) if options.up == "auto" else options.up
        self.asset_from_source = asset_from_source(up, options.unit_m)
        self.lights = LightConverter(self, self.asset_from_source)

    def run(self, out_library: Path) -> ImportedAsset:
        source, title = provenance(self.path, self.path.parent, self.options, self.findings)
        shapes = self.collect_shapes()
        for node in self.scene.all_of("emitter"):
            self.lights.add(node)
        self.problems += self.lights.problems
        raise_problems(self.problems)
        cameras = tuple(
            camera_of(node, k, self.asset_from_source, self.findings)
            for k, node in enumerate(self.scene.all_of("sensor"))
        )
        note_mended(self.findings, self.num_mended)
        shapes = self.apply_dielectric_policy(shapes)
        shapes = self.take_out_lights(shapes)
        parts, placed = self.build_parts(shapes)
        slots = self.build_materials(shapes, parts)
        places = self.find_places(placed, parts, slots, cameras)
        lights = tuple(self.lights.lights)
        places = replace(places, light_slots=annotate.slots_of(lights) + places.light_slots)
        folder_name = self.path.parent.name if self.path.stem in ("scene", "scene_v3") else self.path.stem
        asset = EnvironmentAsset(
            id=self.options.asset_id or slug(folder_name),
            title=self.options.title or title or folder_name,
            provenance=source,
            materials=slots,
            parts=tuple(parts),
            lights=lights,
            cameras=cameras,
            **self.annotations.over(places, annotate.openings_of(lights)),
        )
        return finish(asset, self.files, out_library / "environments", self.options, self.findings)

    # shapes

    def collect_shapes(self) -> list[_Shape]:
        shapes: list[_Shape] = []
        placed = list(self.placed_shapes())
        self.budget.spend("instances", len(placed), "shapes")
        for node, label, outer in placed:
            self.collect(node, label, outer, shapes)
        if not shapes and not self.problems:
            self.problems.add("shapes", "none", "at least one", "check the scene")
        return shapes

    def placed_shapes(self) -> Iterator[tuple[SceneNode, str, NDArray[np.float64]]]:
        """Yield every shape, its label and the (4, 4) transform of its instance (identity if none)."""
        for number, node in enumerate(self.scene.all_of("shape")):
            label = node.id or f"shape_{number:04d}"
            if node.type == "instance":
                group = next((c for c in node.children_of("shape") if c.type == "shapegroup"), None)
                if group is None:
                    self.problems.add(node.where, "no shapegroup", "a reference to one", "correct the scene")
                    continue
                for k, nested in enumerate(group.children_of("shape")):
                    yield nested, f"{label}_{k}", node.to_world()
            elif node.type != "shapegroup":
                yield node, label, np.eye(4)

    def collect(self, node: SceneNode, label: str, outer: NDArray[np.float64], shapes: list[_Shape]) -> None:
        if node.type not in SUPPORTED_SHAPES:
            expected = f"one of {', '.join(SUPPORTED_SHAPES)}, instance"
            self.problems.add(node.where, f"type {node.type!r}", expected, "convert the shape to PLY")
            return
        file = None
        if node.type in FILE_SHAPES:
            field, instead = f"{node.where}: filename", "mesh left out"
            file = file_of(node, field, "the mesh", instead, self, self.problems)
            if file is None or not file.is_file():
                return
        transform = outer @ node.to_world()
        if abs(np.linalg.det(transform[:3, :3])) < SINGULAR:
            field = f"{node.where}: to_world"
            self.problems.add(field, "a singular matrix", "an invertible one", "correct it")
            return
        bsdfs = node.children_of("bsdf")
        draft = self.materials.draft(bsdfs[0]) if bsdfs else Draft("default")
        try:
            mesh, num_mended = self.mesh_of(node, file)
        except InputError as error:
            self.problems.extend(error.problems)
            return
        if draft.uv_matrix is not None and mesh.uv is not None:
            mesh = replace(mesh, uv=transformed_uv(mesh.uv, draft.uv_matrix))
        self.num_mended.append(num_mended)
        emission = self.lights.emission_of(node)
        bsdf = id(bsdfs[0]) if bsdfs else 0
        shapes.append(_Shape(node, label, mesh, file, transform, draft, emission, bsdf))

    def mesh_of(self, node: SceneNode, file: Path | None) -> tuple[Mesh, int]:
        """Return a memoised mesh, charged to the budget at each use, and its number of replaced normals."""
        key = _source_of(node, file)
        if key in self.meshes:
            self.budget.spend("triangles", self.meshes[key][0].weight, node.where)
        else:
            self.meshes[key] = shape_mesh(node, file, self.budget)
        return self.meshes[key]

    def apply_dielectric_policy(self, shapes: list[_Shape]) -> list[_Shape]:
        """Refuse transparent materials or, by option, remove panes and convert solids to opal glass."""
        kept: list[_Shape] = []
        refused: dict[str, str] = {}
        removed: Counter[str] = Counter()
        for shape in shapes:
            name, kind = shape.draft.name, shape.draft.transparency
            if not kind:
                kept.append(shape)
            elif kind == "null":
                removed[f"{name}: null BSDF, surface left out"] += 1
            elif self.options.dielectric == "refuse" and name not in self.options.dielectric_as:
                refused[name] = shape.node.where
            else:
                default = "remove" if kind == "thin" or is_pane(shape.mesh) else "opaque"
                if self.options.dielectric_as.get(name, default) == "remove":
                    removed[f"{name}: transparent, left out (light passes straight)"] += 1
                else:
                    shape.draft = shape.draft.with_note("clear glass as opaque opal glass")
                    kept.append(shape)
        for sentence, count in removed.items():
            self.findings.approximate(f"{sentence}; {count} shape{'s' if count > 1 else ''}")
        expected = "opaque materials: the project's BSDF does not transmit light"
        remedy = "import with --dielectric replace, or choose with --dielectric-as NAME=opaque|remove"
        raise_problems(
            [
                Problem(self.path, f"material {name!r}", f"transparent, on {where}", expected, remedy)
                for name, where in refused.items()
            ]
        )
        return kept

    def take_out_lights(self, shapes: list[_Shape]) -> list[_Shape]:
        """Convert emitting rectangles, disks and spheres to lights, and return the other shapes."""
        kept = []
        for shape in shapes:
            light = None
            if shape.emission is not None:
                transform = self.asset_from_source @ shape.source_from_shape
                light = emitter_shape_light(shape.node, shape.label, transform, shape.emission)
            if light is None:
                kept.append(shape)
            else:
                self.lights.lights.append(light)
        return kept

    # parts and materials

    def build_parts(self, shapes: list[_Shape]) -> tuple[list[Part], list[Mesh]]:
        """Add the mesh files, and return the parts and their meshes in the asset's frame.

        A mesh shared by several shapes is stored once, in its local frame; others are stored in the asset's
        frame. Modifies ``shapes`` in place: those without a surface are removed, the others get their slot.
        """
        parts: list[Part] = []
        placed: list[Mesh] = []
        taken: set[str] = set()
        slots: dict[_SlotKey, str] = {}
        keys = [self.mesh_key(shape) for shape in shapes]
        uses = Counter(keys)
        stored: dict[Any, str] = {}
        kept: list[_Shape] = []
        for shape, key in zip(shapes, keys, strict=True):
            matrix = self.asset_from_source @ shape.source_from_shape
            in_place = shape.mesh.transformed(matrix)
            if inspect_mesh(in_place).is_unusable:
                self.findings.approximate(f"{shape.label}: mesh without a usable surface left out")
                continue
            name = unique(slug(shape.label), taken)
            taken.add(name)
            is_shared = uses[key] > 1
            if key not in stored or not is_shared:
                stored[key] = f"meshes/{name}.ply"
                mesh = without_degenerate(shape.mesh if is_shared else in_place)
                self.files[stored[key]] = encode_ply(mesh)
            shape.slot = self.slot_name(shape, slots)
            asset_from_part = matrix4(matrix) if is_shared else IDENTITY4
            parts.append(part_of(name, shape.slot, in_place, stored[key], asset_from_part))
            placed.append(in_place)
            kept.append(shape)
        shapes[:] = kept
        if not parts:
            raise input_error(self.path, "shapes", "none with a surface", "at least one", "check the scene")
        return parts, placed

    def mesh_key(self, shape: _Shape) -> Any:
        matrix = shape.draft.uv_matrix
        return (
            *_source_of(shape.node, shape.file),
            None if shape.file else shape.node.to_world().tobytes(),
            None if matrix is None else matrix.tobytes(),
        )

    def slot_name(self, shape: _Shape, slots: dict[_SlotKey, str]) -> str:
        """Return the slot for a shape's pair of BSDF and emission; add it to ``slots`` if new."""
        key = (shape.bsdf, shape.emission)
        if key not in slots:
            base = shape.draft.name + ("_emitter" if shape.emission else "")
            slots[key] = unique(base, set(slots.values()))
        return slots[key]

    def build_materials(self, shapes: list[_Shape], parts: list[Part]) -> dict[str, SlotMaterial]:
        slots: dict[str, SlotMaterial] = {}
        densities: dict[str, list[float]] = {}
        for part in parts:
            if part.uv_per_m:
                densities.setdefault(part.material, []).append(part.uv_per_m)
        for shape in shapes:
            if shape.slot not in slots:
                density = densities.get(shape.slot)
                slots[shape.slot] = self.material(shape, float(np.median(density)) if density else None)
            for sentence in slots[shape.slot].approximations:
                self.findings.approximate(sentence)
        return slots

    def material(self, shape: _Shape, uv_per_m: float | None) -> SlotMaterial:
        draft = shape.draft
        guessed: tuple[MaterialClass, ...] = (guess_class(draft.name, fallback=draft.fallback_class),)
        classes = self.annotations.classes.get(shape.slot, guessed)
        if shape.emission is not None:
            return SlotMaterial(
                classes=classes,
                diffuse_albedo=(0.0, 0.0, 0.0),
                specular_albedo=(0.0, 0.0, 0.0),
                roughness=1.0,
                emission=shape.emission,
            )
        normal = None
        if draft.normal is not None:
            normal = draft.normal.texture(self.textures.add_file(draft.normal.file))
        elif draft.height is not None and not isinstance(draft.height, ImageSource):
            normal = self.bump(draft, uv_per_m)
        return SlotMaterial(
            classes=classes,
            diffuse_albedo=self.textures.color(draft.diffuse),
            specular_albedo=self.textures.color(draft.specular),
            roughness=self.textures.scalar(draft.roughness),
            opacity=None if draft.opacity is None else self.textures.scalar(draft.opacity),
            normal=normal,
            approximations=draft.approximations,
            replaceable_by=self.annotations.replaceable_by.get(shape.slot, REPLACEABLE[classes[0]]),
        )

    def bump(self, draft: Draft, uv_per_m: float | None) -> Texture | None:
        if uv_per_m is None:
            self.findings.approximate(f"{draft.name}: bump map left out, the surface has no UVs")
            return None
        height = self.cache.values(draft.height, is_scalar=True) * self.options.unit_m  # type: ignore[arg-type]
        normal = normal_from_height(height, uv_per_m)
        return self.textures.add_baked(
            BakedSource(normal * 0.5 + 0.5, f"{slug(draft.name)}_normal", "linear")
        )

    def find_places(
        self,
        placed: list[Mesh],
        parts: list[Part],
        slots: dict[str, SlotMaterial],
        cameras: tuple[AssetCamera, ...],
    ) -> annotate.RoomPlaces:
        known = self.annotations
        if None not in (known.support_surfaces, known.camera_regions, known.light_slots):
            return annotate.RoomPlaces(None)
        return annotate.places_of_parts(placed, parts, slots, cameras, self.findings)


def _source_of(node: SceneNode, file: Path | None) -> tuple[Any, ...]:
    """Return a key that is equal for shapes with the same mesh."""
    return (
        str(file) if file else node.type,
        None if file else tuple(sorted((k, str(v)) for k, v in node.values.items() if k != "to_world")),
        bool(node.get("face_normals", False)),
        node.get("flip_tex_coords"),
    )


def is_pane(mesh: Mesh) -> bool:
    """Return whether the thickness of each connected piece is at most 5 % of its second-largest extent."""
    points, index = welded(mesh)
    faces = index[mesh.faces]
    labels = _pieces(faces, len(points))
    for label in np.unique(labels):
        piece = points[labels == label].astype(np.float64)
        if len(piece) > 3:  # fewer points are in a plane
            extent = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(piece.T)), 0))
            if extent[0] > _PANE_RATIO * max(extent[1], 1e-12):
                return False
    return True


def _pieces(faces: NDArray[np.int64], num_vertices: int) -> NDArray[np.int32]:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    rows = np.concatenate([faces[:, 0], faces[:, 1]])
    columns = np.concatenate([faces[:, 1], faces[:, 2]])
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(num_vertices, num_vertices))
    return connected_components(graph, directed=False)[1]
