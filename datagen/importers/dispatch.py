# SPDX-License-Identifier: MIT
"""Entry point of ``datagen import``, which selects an importer by the kind of source."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from datagen.foundation.errors import InputError, Problem, input_error, raise_problems
from datagen.foundation.naming import slug
from datagen.foundation.paths import fault_of, inside
from datagen.importers.blender_files import BLENDER_SUFFIXES, import_by_blender, uses_draco
from datagen.importers.common import ImportedAsset, ImportOptions
from datagen.importers.material_folder import import_material_folder, is_material_folder
from datagen.importers.watch import ImportWatch

_KINDS = {
    ".xml": "mitsuba",
    **dict.fromkeys((".gltf", ".glb"), "gltf"),
    **dict.fromkeys((".obj", ".ply", ".stl"), "mesh"),
    **dict.fromkeys(BLENDER_SUFFIXES, "blender"),
    ".sh3f": "sweet_home",
}
"""Kind of source by file suffix."""
_SCENE_FILES = ("scene.xml", "scene_v3.xml")


@dataclass(frozen=True)
class Source:
    """An importable source; ``kind``: ``material`` for a texture folder, else the entry in :data:`_KINDS`."""

    path: Path
    kind: str


def find_sources(path: Path) -> list[Source]:
    """Return the sources at a path, which is an importable file, a texture folder or a folder of these.

    Raises :class:`InputError` if no importer recognises a source there.
    """
    if path.is_file():
        if path.suffix.lower() in _KINDS:
            return [Source(path, _KINDS[path.suffix.lower()])]
    elif path.is_dir():
        sources = _in_folder(path) or [
            s for child in sorted(path.iterdir()) if _is_folder(path, child) for s in _in_folder(child)
        ]
        if sources:
            return sources
    else:
        raise input_error(path, "", "no such file or folder", "something to import", "check the path")
    expected = (
        "a Mitsuba scene (.xml), a glTF file (.gltf, .glb), a mesh (.obj, .ply, .stl), a file for Blender "
        "(.fbx, .usd, .blend), a Sweet Home 3D library (.sh3f), a PBR texture folder, or a folder of these"
    )
    got = "a folder with nothing to import" if path.is_dir() else "a file of unknown type"
    raise input_error(path, got=got, expected=expected, remedy="check the path")


def _is_folder(path: Path, child: Path) -> bool:
    """Return whether ``child`` is a folder. Raises :class:`InputError` if it is a link out of ``path``."""
    if not child.is_dir():
        return False
    _, fault = fault_of(path, child.name, is_folder=True)
    if fault:
        raise input_error(child, "", fault, f"a folder in {path}", "import this folder separately")
    return True


def _in_folder(folder: Path) -> list[Source]:
    for name in _SCENE_FILES:
        if (folder / name).is_file():
            return [Source(inside(folder, folder / name), "mitsuba")]

    def files_of(*kinds: str) -> list[Source]:
        files = ((path, _KINDS.get(path.suffix.lower(), "")) for path in sorted(folder.iterdir()))
        return [Source(inside(folder, path), kind) for path, kind in files if kind in kinds]

    material = [Source(folder, "material")] if is_material_folder(folder) else []
    return files_of("gltf") or files_of("sweet_home") or material or files_of("mesh", "blender")


def import_asset(
    path: Path,
    out_library: Path,
    options: ImportOptions | None = None,
    *,
    split: bool = False,
    watch: ImportWatch | None = None,
) -> list[ImportedAsset]:
    """Import all sources at a path into the library folder ``out_library``, and return their records.

    ``split`` makes an object of each group of touching nodes in a glTF file; ``watch`` shows the progress and
    the records. An ``asset_id`` requires a single source. Invalid sources do not stop the import; one
    :class:`InputError` at the end lists all their problems.
    """
    options = options or ImportOptions()
    sources = find_sources(Path(path))
    if options.asset_id and (len(sources) > 1 or split):
        raise input_error(
            path, "id", options.asset_id, "no --id, since several assets are imported", "leave --id out"
        )
    if options.asset_id and options.asset_id != slug(options.asset_id):
        expected = f"lower-case letters, digits, '_' and '-', such as {slug(options.asset_id)!r}"
        raise input_error(path, "id", repr(options.asset_id), expected)
    done: list[ImportedAsset] = []
    problems: list[Problem] = []
    for number, source in enumerate(sources):
        if watch is not None and source.kind != "sweet_home":
            watch.begin(source.path, number, len(sources))
        try:
            for record in _import_one(source, Path(out_library), options, split, watch):
                done.append(record)
                if watch is not None and source.kind != "sweet_home":
                    watch.show(record)
        except InputError as error:
            problems.extend(error.problems)
    raise_problems(problems)
    return done


def _import_one(
    source: Source, out_library: Path, options: ImportOptions, split: bool, watch: ImportWatch | None
) -> list[ImportedAsset]:
    if source.kind == "mitsuba":
        from datagen.importers.mitsuba_xml import import_mitsuba_scene

        if options.kind not in ("auto", "environment"):
            raise input_error(
                source.path,
                "kind",
                options.kind,
                "environment or auto: a Mitsuba scene becomes an environment",
                "leave --kind out",
            )
        return [import_mitsuba_scene(source.path, out_library, options)]
    if source.kind == "gltf":
        from datagen.importers.gltf import import_gltf

        if uses_draco(source.path):
            return import_by_blender(source.path, out_library, options, split=split)
        return import_gltf(source.path, out_library, options, split=split)
    if source.kind == "mesh":
        from datagen.importers.mesh_files import import_mesh_file

        return import_mesh_file(source.path, out_library, options, split=split)
    if source.kind == "blender":
        return import_by_blender(source.path, out_library, options, split=split)
    if source.kind == "sweet_home":
        from datagen.importers.sweet_home import import_sweet_home

        on_step = None if watch is None else partial(watch.step, source.path)
        return import_sweet_home(source.path, out_library, options, on_step)
    if options.kind not in ("auto", "material"):
        raise input_error(
            source.path,
            "kind",
            options.kind,
            "material or auto: a texture folder becomes a material",
            "leave --kind out",
        )
    return [import_material_folder(source.path, out_library, replace(options, kind="material"))]
