# SPDX-License-Identifier: MIT
"""Test scenes drawn from a recipe: rooms with objects, materials and lights as in datasets.

The scene is the recipe's configuration number ``configuration`` with other cameras: their number, resolution
and sampling are those of the test scene, and a walk of novel views is added.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from datagen.assembly.plan import assemble, world_of
from datagen.assembly.splits import check_recipe
from datagen.formats.asset import EnvironmentAsset
from datagen.formats.base import read_yaml
from datagen.formats.configuration import Configuration, ViewCamera
from datagen.formats.recipe import CameraRecipe, Recipe
from datagen.foundation.errors import input_error
from datagen.importers.common import ImportOptions
from datagen.importers.dispatch import import_asset
from datagen.library import Library, resolve_library_paths
from model.evaluation.photographer import walk_between

RECIPE_SUFFIXES = (".yaml", ".yml")


def imported(sources: Sequence[Path], folder: Path) -> tuple[Path, ...]:
    """Import ``sources`` into a new ``folder``, or reuse it. Returns (``folder``,), or () without sources."""
    if not sources:
        return ()
    if not folder.is_dir():
        begun = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(begun, ignore_errors=True)
        for source in sources:
            import_asset(source, begun, ImportOptions(missing="replace", dielectric="replace"))
        begun.rename(folder)
    return (folder,)


def recipe_library(source: Path, own: tuple[Path, ...]) -> tuple[Path, ...]:
    """Library folders of the recipe at ``source``, followed by the folders ``own``."""
    return (*resolve_library_paths(read_yaml(Recipe, source).library, source.parent), *own)


def draw_room(
    source: Path,
    index: int,
    library: Library,
    cameras: CameraRecipe,
    resolution: tuple[int, int],
    num_views: int,
    num_novel: int,
) -> Configuration:
    """Draw configuration ``index`` of the recipe at ``source`` with ``num_views`` cameras (view-000, ...) and
    ``num_novel`` on a walk between two of them (path-000, ...), at ``resolution`` (width, height).

    Raises :class:`InputError` if the recipe is invalid, has no such configuration, or generates its rooms.
    """
    changes = {"views": num_views, "resolution": resolution, "cameras": cameras}
    recipe = read_yaml(Recipe, source).model_copy(update=changes)
    if index >= recipe.configurations:
        expected = f"a number below {recipe.configurations}, of the recipe's configurations"
        raise input_error(source, "configuration", index, expected)
    if recipe.environments.parametric is not None:
        expected = "environments of a library, which all compared methods can read"
        remedy = "plan the recipe, add the dataset's rooms/ to its libraries and omit parametric"
        raise input_error(source, "environments.parametric", "generated rooms", expected, remedy)
    check_recipe(recipe, library)
    drawn = assemble(recipe, index, library)
    room = library.package(drawn.environment.asset).asset
    assert isinstance(room, EnvironmentAsset)
    scene = world_of(drawn, library)
    walk = walk_between([c.camera() for c in drawn.cameras], num_novel, room, scene.rays, cameras)
    added = tuple(ViewCamera.from_camera(f"path-{k:03d}", camera) for k, camera in enumerate(walk))
    return drawn.model_copy(update={"split": "test", "cameras": (*drawn.cameras, *added)})
