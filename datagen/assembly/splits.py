# SPDX-License-Identifier: MIT
"""Distributes configurations and, with ``splits.disjoint``, assets over train, validation and test.

Splits are interleaved by index in exact arithmetic, so any prefix of a dataset has about the given shares.
With ``splits.disjoint``, each pool of assets (environments, objects of one category, materials of one main
class) is distributed in the order of hashed ids. To prevent leakage through copies, rooms and objects with
the same largest mesh go to one split, as do materials that share an image. A slot of a room or object whose
material contains an image of another split must get another material; grouping rooms by images would put all
rooms of a library into one split, since they share images of floors and woods.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal
from weakref import WeakKeyDictionary

from datagen.assembly.daylight import environment_image
from datagen.assembly.materials import is_plain
from datagen.assembly.panoramas import panoramas_of
from datagen.formats.asset import GeometryAsset, Material, MaterialAsset, ObjectAsset
from datagen.formats.base import canonical_json, sha256_hex
from datagen.formats.configuration import Split
from datagen.formats.degenerate_shapes import degenerate_problems
from datagen.formats.package import Package
from datagen.formats.recipe import AssetFilter, Recipe
from datagen.foundation.errors import InputError, Problem, Problems, raise_problems
from datagen.foundation.random import digest
from datagen.library import Library

SPLITS: tuple[Split, ...] = ("train", "validation", "test")


@dataclass(frozen=True)
class Pools:
    """The packages from which a split's configurations draw, each list sorted by id."""

    environments: list[Package]
    objects: list[Package]
    materials: list[Package]
    foreign_slots: frozenset[tuple[str, str]] = frozenset()
    """Pairs (asset id, slot) of slots whose material has an image of another split or is a placeholder."""


def _shares(recipe: Recipe) -> dict[Split, Fraction]:
    raw = {split: Fraction(getattr(recipe.splits, split)).limit_denominator(10**6) for split in SPLITS}
    total = sum(raw.values())
    return {split: share / total for split, share in raw.items()}


def _rounded_share(share: Fraction, count: int) -> int:
    """Return ``share`` times ``count``, rounded to the nearest integer."""
    return (2 * share.numerator * count + share.denominator) // (2 * share.denominator)


def split_of(recipe: Recipe, index: int) -> Split:
    """Return the split of configuration ``index``, in constant time."""
    shares = _shares(recipe)
    tests = _rounded_share(shares["test"], index)
    if _rounded_share(shares["test"], index + 1) > tests:
        return "test"
    if shares["test"] == 1:
        return "test"
    rank = index - tests  # among the configurations outside the test split
    share = shares["validation"] / (1 - shares["test"])
    return "validation" if _rounded_share(share, rank + 1) > _rounded_share(share, rank) else "train"


def split_counts(recipe: Recipe) -> dict[Split, int]:
    """Return the number of configurations in each split."""
    shares = _shares(recipe)
    tests = _rounded_share(shares["test"], recipe.configurations)
    rest = recipe.configurations - tests
    share = shares["validation"] / (1 - shares["test"]) if shares["test"] < 1 else Fraction(0)
    validation = _rounded_share(share, rest)
    return {"train": rest - validation, "validation": validation, "test": tests}


def splits_in_use(recipe: Recipe) -> list[Split]:
    """Return the splits with at least one configuration."""
    counts = split_counts(recipe)
    return [split for split in SPLITS if counts[split] > 0]


def packages_in_use(
    recipe: Recipe, library: Library, pool: Literal["environments", "objects"]
) -> list[Package]:
    """Return the packages of a pool that any split with configurations may use, sorted by id."""
    of_split = (getattr(pools_of_split(recipe, library, split), pool) for split in splits_in_use(recipe))
    found = {package.id: package for packages in of_split for package in packages}
    return [found[name] for name in sorted(found)]


_POOLS: WeakKeyDictionary[Library, dict[str, dict[Split, Pools]]] = WeakKeyDictionary()


def pools_of_split(recipe: Recipe, library: Library, split: Split) -> Pools:
    """Return the assets that a split may use. Raises the same errors as :func:`check_recipe`."""
    per_recipe = _POOLS.setdefault(library, {})
    key = sha256_hex(canonical_json(recipe))
    if key not in per_recipe:
        check_recipe(recipe, library)
        per_recipe.clear()
        per_recipe[key] = _all_pools(recipe, library)
    return per_recipe[key][split]


def _filtered(packages: list[Package], wanted: AssetFilter) -> list[Package]:
    included = None if wanted.include is None else set(wanted.include)
    return [p for p in packages if p.id not in wanted.exclude and (included is None or p.id in included)]


def _everything(recipe: Recipe, library: Library) -> Pools:
    return Pools(
        _filtered(library.select("environment"), recipe.environments),
        _filtered(library.select("object"), recipe.objects),
        _filtered(library.select("material"), recipe.materials),
    )


def _all_pools(recipe: Recipe, library: Library) -> dict[Split, Pools]:
    everything = _everything(recipe, library)
    if not recipe.splits.disjoint:
        return dict.fromkeys(SPLITS, everything)
    home = partition(recipe, everything)
    foreign = _foreign_slots(everything, home)
    pools = (everything.environments, everything.objects, everything.materials)

    def of(split: Split) -> Pools:
        environments, objects, materials = ([p for p in pool if home[p.id] == split] for pool in pools)
        return Pools(environments, objects, materials, foreign)

    return {split: of(split) for split in SPLITS}


def partition(recipe: Recipe, pools: Pools) -> dict[str, Split]:
    """Map the id of each asset to its split.

    Each kind of asset is partitioned separately; every split with a positive share gets at least one asset if
    there are enough, training first. Families (assets that share an identifying file) stay together.
    """
    shares = _shares(recipe)
    used = [split for split in SPLITS if shares[split] > 0]
    family_of = _families([*pools.environments, *pools.objects, *pools.materials])
    assigned: dict[str, Split] = {}
    for pool in _kinds(pools):
        ids = sorted({family_of[p.id] for p in pool}, key=lambda i: digest(recipe.seed, "partition", i))
        counts = {split: sum(assigned.get(i) == split for i in ids) for split in used}
        for family in [i for i in ids if i not in assigned]:
            # the split with the largest deficit, but first splits without assets; ties in the order of SPLITS
            lack = [(counts[s] == 0, float(shares[s] * len(ids)) - counts[s], -k) for k, s in enumerate(used)]
            best = used[max(range(len(used)), key=lambda k: lack[k])]
            assigned[family] = best
            counts[best] += 1
    return {p.id: assigned[family_of[p.id]] for p in (*pools.environments, *pools.objects, *pools.materials)}


def _kinds(pools: Pools) -> list[list[Package]]:
    """Group packages in the order of distribution: rooms, objects by category, materials by main class."""
    groups: dict[tuple[int, str], list[Package]] = {}
    for package in (*pools.environments, *pools.objects, *pools.materials):
        asset, key = package.asset, (0, "")
        if isinstance(asset, ObjectAsset):
            key = (1, asset.category)
        elif isinstance(asset, MaterialAsset):
            key = (2, asset.material.classes[0])
        groups.setdefault(key, []).append(package)
    return [groups[key] for key in sorted(groups)]


def _families(packages: list[Package]) -> dict[str, str]:
    """Map each asset to the smallest id of its family, the assets connected by shared identifying files."""
    parent = {p.id: p.id for p in packages}

    def root(asset_id: str) -> str:
        while parent[asset_id] != asset_id:
            asset_id = parent[asset_id]
        return asset_id

    owner: dict[str, str] = {}
    for package in packages:
        for name in _identifying_files(package):
            content = sha256_hex(package.read_bytes(name))
            one, other = root(owner.setdefault(content, package.id)), root(package.id)
            parent[max(one, other)] = min(one, other)
    return {asset_id: root(asset_id) for asset_id in parent}


def _identifying_files(package: Package) -> list[str]:
    """Return the files that identify an asset: the largest mesh of a room or object, or a material's images.

    Smaller meshes (a quad, a box) are ignored, since different assets may contain equal ones.
    """
    names = list(package.names())
    meshes = [name for name in names if name.lower().endswith(".ply")]
    if not meshes:
        return names
    sizes = {name: len(package.read_bytes(name)) for name in meshes}
    return [max(meshes, key=lambda name: (sizes[name], name))]


def _foreign_slots(pools: Pools, home: dict[str, Split]) -> frozenset[tuple[str, str]]:
    """Find slots, as (asset id, slot), of rooms and objects whose material has an image of another split.

    An image belongs to the split of the first material or, if none, room or object that contains it.
    """
    hashes: dict[tuple[str, str], str] = {}
    owner: dict[str, str] = {}
    rooms_and_objects = sorted((*pools.environments, *pools.objects), key=lambda p: p.id)
    for package in (*pools.materials, *rooms_and_objects):
        for material in _materials(package).values():
            for texture in material.textures():
                content = sha256_hex(package.read_bytes(texture.texture))
                hashes[package.id, texture.texture] = content
                owner.setdefault(content, package.id)
    return frozenset(
        (package.id, slot)
        for package in rooms_and_objects
        for slot, material in _materials(package).items()
        if material.emission is None  # emitters have no ground truth that could leak
        and any(home[owner[hashes[package.id, t.texture]]] != home[package.id] for t in material.textures())
    )


def _materials(package: Package) -> dict[str, Material]:
    if isinstance(package.asset, MaterialAsset):
        return {"": package.asset.material}
    return dict(package.as_kind(GeometryAsset).materials)


def check_recipe(recipe: Recipe, library: Library) -> None:
    """Raise :class:`InputError` with all faults of a recipe that would make a configuration fail.

    These are filters and weights without a match in the library, splits without configurations or assets, a
    library without rooms, objects or materials that the recipe needs, and degenerate shapes.
    """
    where = f"recipe {recipe.name}"
    problems = _name_problems(recipe, library, where)
    pools = _everything(recipe, library)
    if not pools.environments and recipe.environments.needs_library:
        got = "no usable environment"
        if library.select("environment", for_training=False):
            got += " (evaluation_only ones do not count)"
        problems.add("environments", got, "at least one environment in the library", "add one with --library")
    if not pools.objects and recipe.objects.count[0] > 0:
        problems.add(
            "objects",
            "no usable object",
            f"at least one, for objects.count {list(recipe.objects.count)}",
            "add objects to the library or set objects.count to [0, 0]",
        )
    if not pools.materials and recipe.environments.parametric is not None:
        expected, remedy = "materials for generated rooms", "add `bundled` to the recipe's library"
        problems.add("materials", "no usable material", expected, remedy)
    if recipe.objects.library_weights and len(library.paths) < len(recipe.library):
        problems.add(
            "objects.library_weights",
            f"{len(library.paths)} folders",
            f"those of the recipe's library ({', '.join(recipe.library)}), in its order",
            "name all of them with --library, in this order",
        )
    for package in (*pools.environments, *pools.objects):
        problems += degenerate_problems(package.as_kind(GeometryAsset), f"{package.path}/asset.json")
    counts = split_counts(recipe)
    for split in SPLITS:
        share = getattr(recipe.splits, split)
        if share > 0 and counts[split] == 0:
            problems.add(
                f"splits.{split}",
                f"{share:g}, none of {recipe.configurations} configurations",
                "at least one configuration",
                "raise configurations or the share, or set it to 0",
            )
    if recipe.splits.disjoint and not problems:
        problems += _disjoint_problems(recipe, pools, where)
    raise_problems(problems)


def _disjoint_problems(recipe: Recipe, pools: Pools, where: str) -> list[Problem]:
    home = partition(recipe, pools)
    foreign = _foreign_slots(pools, home)
    problems = Problems(where)
    for split in SPLITS:
        if getattr(recipe.splits, split) <= 0:
            continue
        lacking = []
        if recipe.environments.needs_library and not any(home[p.id] == split for p in pools.environments):
            lacking.append("environment")
        if recipe.objects.count[0] > 0 and not any(home[p.id] == split for p in pools.objects):
            lacking.append("object")
        usable = [p for p in pools.materials if home[p.id] == split]
        if not any(is_plain(p) for p in usable) and any(home[asset] == split for asset, _ in foreign):
            lacking.append("material without textures")
        for kind in lacking:
            problems.add(
                "splits.disjoint",
                f"no {kind} for the {split} split",
                "one for every split, which shares no file with those of other splits",
                f"add one to the library, or set splits.disjoint to false or splits.{split} to 0",
            )
    return problems


def _name_problems(recipe: Recipe, library: Library, where: str) -> Problems:
    problems = Problems(where)

    def check(field: str, name: str, known: list[str], what: str) -> None:
        if name not in known:
            near, some = difflib.get_close_matches(name, known, 3), ", ".join(known[:12]) or "none"
            remedy = f"did you mean {', '.join(near)}?" if near else f"known: {some}"
            problems.add(field, repr(name), what, remedy)

    def check_usage(field: str, name: str) -> None:
        if name in library and library.package(name).asset.provenance.usage == "evaluation_only":
            remedy = "it is marked evaluation_only: leave it out"
            problems.add(field, repr(name), "an asset that may be used for training", remedy)

    for field, kind in (("environments", "environment"), ("objects", "object"), ("materials", "material")):
        wanted: AssetFilter = getattr(recipe, field)
        known = [p.id for p in library.select(kind, for_training=False)]  # type: ignore[arg-type]
        for name in wanted.include or ():
            check(f"{field}.include", name, known, f"one of the library's {kind}s")
            check_usage(f"{field}.include", name)
        for name in wanted.exclude:
            check(f"{field}.exclude", name, known, f"one of the library's {kind}s")
    categories = library.categories(for_training=False)
    for name in recipe.objects.category_weights:
        check("objects.category_weights", name, categories, "a category of the library")
    for name in recipe.lights.environment_images:
        check("lights.environment_images", name, [p.id for p in library], "an asset of the library")
        check_usage("lights.environment_images", name)
        if name in library:
            try:
                environment_image(library, name)
            except InputError as error:
                problems += error.problems
    for time in recipe.lights.panoramas.wanted() if recipe.lights.panoramas is not None else ():
        if not panoramas_of(library, time):
            got, remedy = "no such panorama", "add `bundled` to the recipe's library, or leave it out"
            problems.add(f"lights.panoramas.{time}", got, "at least one in the library", remedy)
    return problems
