# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the assets to export: materials, objects and collections with tags."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import bpy

from .gather.tags import role_of, slug
from .problems import ERROR, ProblemList
from .settings import ExportSettings


@dataclass(frozen=True)
class Target:
    """An asset to export.

    ``tagged``: the data-block with its tags; ``owners``: names of its objects, instancers included.
    """

    kind: str
    id: str
    title: str
    tagged: bpy.types.ID
    owners: frozenset[str] = field(default_factory=frozenset)


def _identify(block: bpy.types.ID, fallback: str) -> tuple[str, str]:
    return str(block.get("sm_id", "")) or slug(fallback), str(block.get("sm_title", "")) or fallback


def find_targets(scene: bpy.types.Scene, settings: ExportSettings, problems: ProblemList) -> list[Target]:
    """The assets that the settings select, in the order of their ids; adds errors to ``problems``."""
    targets: list[Target] = []
    if settings.kind in ("auto", "material"):
        tagged = [m for m in bpy.data.materials if role_of(m) == "material"]
        if settings.kind == "material" and not tagged:
            tagged = [m for m in bpy.data.materials if m.get("sm_class")] or list(bpy.data.materials)
        targets += [_target("material", material, frozenset()) for material in tagged]
    objects = _tagged(scene, "object")
    if settings.kind in ("auto", "object"):
        targets += [_target("object", block, owners) for block, owners in objects]
        if settings.kind == "object" and not objects and not settings.only:
            remedy = "set sm_role = object on objects or collections"
            problems.add(ERROR, "nothing is tagged as an object", remedy)
    if settings.kind in ("auto", "environment"):
        environments = _tagged(scene, "environment")
        taken = frozenset().union(*(owners for _, owners in objects)) if objects else frozenset()
        if environments:
            targets += [_target("environment", block, owners - taken) for block, owners in environments]
        elif settings.kind == "environment" or not targets:
            name = Path(bpy.data.filepath).stem if bpy.data.filepath else scene.name
            identity, title = _identify(scene, name)
            everything = frozenset(thing.name for thing in scene.objects)
            targets.append(Target("environment", identity, title, scene, everything - taken))
    if settings.only:
        names = set(settings.only)
        known = {name for target in targets for name in (target.id, target.tagged.name)}
        for name in sorted(names - known):
            problems.add(ERROR, f"there is nothing to export named {name!r}", "check the name and its tag")
        targets = [target for target in targets if names & {target.id, target.tagged.name}]
    seen: dict[str, Target] = {}
    for target in targets:
        if target.id in seen:
            problems.add(
                ERROR,
                f"{target.tagged.name!r} and {seen[target.id].tagged.name!r} both have the id {target.id!r}",
                "give one of them another sm_id",
            )
        seen[target.id] = target
    return sorted(targets, key=lambda target: target.id)


def _target(kind: str, block: bpy.types.ID, owners: frozenset[str]) -> Target:
    identity, title = _identify(block, block.name)
    return Target(kind, identity, title, block, owners)


def _tagged(scene: bpy.types.Scene, role: str) -> list[tuple[bpy.types.ID, frozenset[str]]]:
    found: list[tuple[bpy.types.ID, frozenset[str]]] = []
    for collection in scene.collection.children_recursive:
        if role_of(collection) == role:
            found.append((collection, frozenset(thing.name for thing in collection.all_objects)))
    in_collection = {name for _, owners in found for name in owners}
    for thing in scene.objects:
        if role_of(thing) == role and thing.name not in in_collection:
            found.append((thing, frozenset(part.name for part in (thing, *thing.children_recursive))))
    return found
