# SPDX-License-Identifier: MIT
"""Assembly is a pure function of recipe, index and library; its result is complete and round-trips."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from datagen.assembly import plan
from datagen.assembly.placement import Shortfall
from datagen.assembly.plan import assemble
from datagen.formats.base import canonical_json, parse_model, sha256_hex
from datagen.formats.configuration import Configuration
from datagen.formats.package import write_package
from datagen.formats.recipe import Recipe
from datagen.foundation.errors import InputError, Problem
from datagen.library import Library
from tests.conftest import REPOSITORY
from tests.datagen.small_library import write_small_library


def recipe(**fields: Any) -> Recipe:
    base: dict[str, Any] = {"name": "pure", "configurations": 6, "views": 4, "resolution": (160, 96)}
    return Recipe.model_validate({**base, **fields})


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_library(tmp_path_factory.mktemp("library"), num_rooms=2)


@pytest.fixture(scope="module")
def configurations(root: Path) -> list[Configuration]:
    return [assemble(recipe(), index, Library([root])) for index in range(recipe().configurations)]


def test_configurations_are_complete(configurations: list[Configuration], root: Path) -> None:
    library = Library([root])
    for index, c in enumerate(configurations):
        assert (c.id, c.index, c.split) == (f"pure-{index:05d}", index, "train")
        assert len(c.cameras) == 4 and len(c.lights) >= 1 and 8 <= len(c.objects) <= 20
        used = {c.environment.asset, *(o.asset for o in c.objects)}
        used |= {m.asset for p in (c.environment, *c.objects) for m in p.materials.values() if m.asset}
        assert set(c.assets) == used
        assert all(library.package(a).sha256 == h for a, h in c.assets.items())
        assert parse_model(Configuration, json.loads(canonical_json(c)), "again") == c
    assert len({c.seed for c in configurations}) == len(configurations)
    assert {c.environment.asset for c in configurations} == {"room-0", "room-1"}


def test_order_and_other_indices_do_not_matter(configurations: list[Configuration], root: Path) -> None:
    library = Library([root])
    for index in (4, 1, 4):
        assert canonical_json(assemble(recipe(), index, library)) == canonical_json(configurations[index])
    longer = assemble(recipe(configurations=50), 1, library)
    assert canonical_json(longer) == canonical_json(configurations[1])


def test_other_seeds_and_indices_give_other_rooms(configurations: list[Configuration], root: Path) -> None:
    bytes_of = {canonical_json(c) for c in configurations}
    bytes_of.add(canonical_json(assemble(recipe(seed=1), 0, Library([root]))))
    assert len(bytes_of) == len(configurations) + 1


@pytest.mark.parametrize("hash_seed", ["1", "2"])
def test_other_processes_give_the_same_bytes(
    configurations: list[Configuration], root: Path, hash_seed: str
) -> None:
    code = (
        "import sys; from datagen.assembly.plan import assemble; from datagen.library import Library\n"
        "from datagen.formats.base import canonical_json, sha256_hex\n"
        "from datagen.formats.recipe import Recipe\n"
        "r = Recipe.model_validate_json(sys.argv[2]); l = Library([sys.argv[1]])\n"
        "print(*[sha256_hex(canonical_json(assemble(r, i, l))) for i in (5, 0, 2)])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(root), recipe().model_dump_json()],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONHASHSEED": hash_seed},
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [sha256_hex(canonical_json(configurations[i])) for i in (5, 0, 2)]


def test_zipped_packages_give_the_same_bytes(
    configurations: list[Configuration], root: Path, tmp_path: Path
) -> None:
    with Library([root]) as library:
        for package in library:
            files = {name: package.path / name for name in package.names()}
            write_package(tmp_path / f"{package.id}.zip", package.asset, files)
    with Library([tmp_path]) as zipped:
        assert canonical_json(assemble(recipe(), 3, zipped)) == canonical_json(configurations[3])


def test_rejected_draws_are_repeated(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library, place, calls = Library([root]), plan.place_things, []

    def unlucky(room: Any, things: Any, recipe: Any, key: Any, rejections: Any, weights: Any) -> Any:
        calls.append(key)
        rejections["placement.unstable"] += 3
        if len(calls) < 3:
            raise Shortfall(Problem("environment", "objects", "0 placed", "more"))
        return place(room, things, recipe, key, rejections, weights)

    first = assemble(recipe(), 1, library)
    monkeypatch.setattr(plan, "place_things", unlucky)
    again = assemble(recipe(), 1, library)
    assert calls == [(0, 1), (0, 1, "again", 1), (0, 1, "again", 2)]
    assert again.rejections["configuration.retried"] == 2 and again.rejections["placement.unstable"] >= 9
    assert again.environment.asset == first.environment.asset and again.objects != first.objects
    calls.clear()
    monkeypatch.setattr(plan, "NUM_TRIES", 2)
    with pytest.raises(InputError, match="objects = 0 placed"):
        assemble(recipe(), 1, library)


def test_an_index_outside_the_recipe_is_refused(root: Path) -> None:
    with pytest.raises(IndexError, match="configuration 6 of 6"):
        assemble(recipe(), 6, Library([root]))


def test_importing_assembly_loads_no_heavy_module() -> None:
    heavy = ("mitsuba", "torch", "bpy", "scipy")
    code = f"import sys, datagen.assembly.plan; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY
    )
    assert done.stdout.strip() == "[]"
