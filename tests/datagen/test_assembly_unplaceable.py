# SPDX-License-Identifier: MIT
"""Assets that cannot be placed are reported with the reason, and library folders are drawn by weight."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from datagen.assembly.notes import implausible_sizes, unplaceable
from datagen.assembly.plan import assemble
from datagen.asset_check import check_package
from datagen.cli import app
from datagen.formats.recipe import Recipe
from datagen.foundation.errors import InputError
from datagen.library import Library
from tests.datagen.small_library import ball, box, cylinder, write_object, write_small_library


def recipe(**changes: object) -> Recipe:
    fields = {
        "name": "few",
        "configurations": 8,
        "views": 2,
        "resolution": (32, 24),
        "objects": {"count": (2, 4)},
    }
    return Recipe.model_validate({**fields, **changes})


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("own")
    write_object(
        root, "boombox", "electronics", {"case": box([-1, -0.2, 0], [1, 0.2, 0.5])}, supports=("table",)
    )
    write_object(root, "tower", "frame", {"body": box([-0.1, -0.1, 0], [0.1, 0.1, 2.0])}, supports=("table",))
    write_object(root, "duvet", "cushion", {"body": box([-0.4, -0.4, 0], [0.4, 0.4, 0.1])}, supports=("bed",))
    write_object(root, "hung", "frame", {"body": box([-0.1, -0.1, 0], [0.1, 0.1, 0.1])}, supports=())
    lean = box([0.3, -0.05, 0.2], [0.6, 0.05, 0.3]) + box([-0.02, -0.02, 0], [0.02, 0.02, 0.2])
    write_object(root, "leaning", "statuette", {"body": lean}, supports=("table",))
    write_object(root, "tin", "box", {"body": cylinder(0.05, 0.1)}, supports=("table", "shelf"))
    write_object(root, "marble", "toy", {"body": ball(0.04)}, supports=("table", "shelf"))
    return root


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_library(tmp_path_factory.mktemp("small"))


def test_unplaceable_assets_are_named_with_the_reason(own: Path, small: Path) -> None:
    found = unplaceable(recipe(), Library([small, own]))
    assert set(found) == {"boombox", "tower", "duvet", "hung", "leaning"}
    assert "2.00 x 0.40 m" in found["boombox"]
    assert "2.00 m tall" in found["tower"]
    assert "bed" in found["duvet"] and "supports is empty" in found["hung"] and "topple" in found["leaning"]
    assert unplaceable(recipe(objects={"count": (0, 0)}), Library([small, own])) == {}
    assert (
        unplaceable(recipe(objects={"count": (1, 1), "exclude": sorted(found)}), Library([small, own])) == {}
    )


def test_unlikely_sizes_are_reported(own: Path, small: Path) -> None:
    library = Library([small, own])
    (warning,) = implausible_sizes(recipe(), library)
    assert warning.startswith("boombox is 2 m long") and "0.02 to 1.6 m" in warning
    warnings = [str(w) for w in check_package(library.package("boombox")).warnings]
    assert any("2 m long" in warning for warning in warnings)
    assert not any("m long" in str(w) for w in check_package(library.package("tin")).warnings)


def test_plan_reports_unplaceable_assets_and_unlikely_sizes(own: Path, small: Path, tmp_path: Path) -> None:
    path = tmp_path / "few.yaml"
    path.write_text(
        "format: scene-materials/recipe\nversion: 1\nname: few\nconfigurations: 1\nviews: 2\n"
        f"resolution: [32, 24]\nlibrary: [{small}, {own}]\nobjects: {{count: [1, 2]}}\n"
    )
    done = CliRunner().invoke(app, ["plan", str(path), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert "hung is never placed" in done.output and "boombox is 2 m long" in done.output


def test_libraries_are_drawn_by_weight(own: Path, small: Path) -> None:
    library = Library([small, own])

    def share(names: tuple[str, ...] = ("small", "own"), **weights: float) -> float:
        asked = recipe(library=names, objects={"count": (3, 3), "library_weights": weights})
        used: Counter[bool] = Counter()
        for index in range(8):
            used.update(t.asset in ("tin", "marble") for t in assemble(asked, index, library).objects)
        return used[True] / used.total()

    assert share() < 0.5
    assert 0.25 < share(own=1, small=1) < 0.8
    assert share(own=1, small=0) == 1.0
    assert share(("small",), small=0) == 1.0  # folders that are not in the recipe have weight 1
    with pytest.raises(
        InputError, match=r"library_weights = 2 folders; expected those of .* \(small, own, more\)"
    ):
        share(("small", "own", "more"), own=2)
    with pytest.raises(ValidationError, match="library_weights"):
        recipe(objects={"library_weights": {"mine": 2}})


def test_absent_weights_change_nothing(small: Path) -> None:
    library = Library([small])
    weighed = recipe(library=("small",), objects={"count": (2, 4), "library_weights": {"small": 3}})
    plain = recipe(library=("small",))
    assert all(assemble(weighed, i, library).objects == assemble(plain, i, library).objects for i in range(4))
