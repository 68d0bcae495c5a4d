# SPDX-License-Identifier: MIT
"""Finding, selecting and describing packages."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen.formats.asset import Material, MaterialAsset, Provenance
from datagen.formats.package import write_package
from datagen.foundation.errors import InputError
from datagen.library import Library, check_library, describe_library
from tests.datagen.test_package import cube_asset, cube_files


def add_material(folder: Path, asset_id: str, *classes: str, usage: str = "any") -> None:
    asset = MaterialAsset(
        id=asset_id,
        title=asset_id.title(),
        provenance=Provenance(license="CC0-1.0", author="A. Maker", usage=usage),
        material=Material(classes=classes),
    )
    write_package(folder / "materials" / asset_id, asset, {})


@pytest.fixture
def library_folder(tmp_path: Path) -> Path:
    root = tmp_path / "library"
    add_material(root, "oak", "wood")
    add_material(root, "lacquer", "painted", "wood")
    add_material(root, "secret", "wood", usage="evaluation_only")
    write_package(root / "objects" / "cube.zip", cube_asset("textures/c.png"), cube_files()).close()
    (root / "objects" / ".half.1.partial").mkdir()
    (root / "objects" / ".half.1.partial" / "asset.json").write_text("{")
    return root


def test_index_and_selection(library_folder: Path) -> None:
    with Library([library_folder]) as library:
        assert [p.id for p in library] == ["cube", "lacquer", "oak", "secret"]
        assert [p.id for p in library.select("material")] == ["lacquer", "oak"]
        everything = library.select("material", for_training=False)
        assert [p.id for p in everything] == ["lacquer", "oak", "secret"]
        assert library.categories() == ["box"]
        with pytest.raises(InputError, match="did you mean lacquer"):
            library.package("laquer")


def test_duplicate_ids_missing_folders_and_broken_packages_are_all_reported(
    library_folder: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    add_material(other, "oak", "wood")
    (other / "materials" / "bad").mkdir()
    (other / "materials" / "bad" / "asset.json").write_text("{}")
    with pytest.raises(InputError) as caught:
        Library([library_folder, other, tmp_path / "absent"])
    text = str(caught.value)
    assert "a unique id" in text
    assert "bad/asset.json: kind" in text
    assert "absent: no such folder" in text


def test_the_same_folder_twice_is_harmless(library_folder: Path) -> None:
    with Library([library_folder, library_folder / "materials"]) as library:
        assert len(library) == 4


def test_table_has_licences_and_hashes(library_folder: Path) -> None:
    lines = describe_library([library_folder], with_hash=True)
    assert [line.kind for line in lines] == ["object", "material", "material", "material"]
    assert lines[0].detail == "box"
    assert all(line.license == "CC0-1.0" and len(line.sha256) == 64 for line in lines)
    assert lines[-1].usage == "evaluation_only"


def test_check_continues_after_broken_packages(library_folder: Path) -> None:
    (library_folder / "materials" / "bad").mkdir()
    (library_folder / "materials" / "bad" / "asset.json").write_text("{}")
    bad_cube = cube_asset(id="tall", maximum_m=(0.5, 0.5, 3.0))
    write_package(library_folder / "objects" / "tall", bad_cube, cube_files())
    result = check_library([library_folder])
    text = "\n".join(map(str, result.errors))
    assert result.num_packages == 6
    assert "bad/asset.json" in text
    assert "maximum_m" in text
    assert len(result.errors) == 2
