# SPDX-License-Identifier: MIT
"""Recipes, suites and presets: schemas, positions of faults, and recipes made by answering questions."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from datagen.cli import app
from datagen.farm.new_recipe import SCHEMA_FILE, write_recipe
from datagen.formats.base import read_yaml
from datagen.formats.recipe import Recipe
from datagen.foundation.errors import InputError
from model.evaluation.suite import Suite
from model.training.config import resolve_config
from tests.conftest import REPOSITORY

HEADER = "# yaml-language-server: $schema="
WRITTEN = sorted(
    [
        *(REPOSITORY / "scenes" / "recipes").glob("*.yaml"),
        *(REPOSITORY / "scenes" / "suites").rglob("*.yaml"),
        *(REPOSITORY / "model" / "training" / "presets").glob("*.yaml"),
    ]
)


def _keys_are_known(schema: dict, node: object, root: dict) -> list[str]:
    """Return the keys of ``node`` that its schema lacks, which an editor would mark."""
    if "$ref" in schema:
        schema = root["$defs"][schema["$ref"].removeprefix("#/$defs/")]
    if "anyOf" in schema or "oneOf" in schema:
        choices = [_keys_are_known(s, node, root) for s in schema.get("anyOf", schema.get("oneOf", []))]
        return min(choices, key=len)
    if isinstance(node, list):
        items = schema.get("items", {})
        return [key for item in node for key in _keys_are_known(items, item, root)] if items else []
    if not isinstance(node, dict):
        return []
    known = schema.get("properties")
    if known is None:
        inner = schema.get("additionalProperties", {})
        return [k for v in node.values() for k in _keys_are_known(inner, v, root)] if inner else []
    unknown = [key for key in node if key not in known]
    return unknown + [
        key
        for name, value in node.items()
        if name in known
        for key in _keys_are_known(known[name], value, root)
    ]


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_every_file_names_the_schema_with_its_keys(path: Path) -> None:
    lines = path.read_text().splitlines()
    (line,) = [line for line in lines[:2] if line.startswith(HEADER)]
    schema = json.loads((path.parent / line.removeprefix(HEADER)).read_text())
    document = yaml.safe_load(path.read_text())
    assert _keys_are_known(schema, document, schema) == []
    assert _keys_are_known(schema, {**document, "veiws": 1}, schema) == ["veiws"]


def _problems(tmp_path: Path, text: str, model: type = Recipe) -> list[str]:
    path = tmp_path / "r.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_yaml(model, path)
    return str(caught.value).replace(f"{tmp_path}/", "").splitlines()


def test_faults_have_line_and_column(tmp_path: Path) -> None:
    text = "# head\nname: x\nviews: 2\nrender:\n  denoise: 7\n  path_smaples: 3\nresolution: [64, 4]\n"
    found = sorted(_problems(tmp_path, text))
    assert [line.split("=")[0] for line in found] == [
        "r.yaml:2:1: configurations; expected this key to be present; add it",
        "r.yaml:5:3: render.denoise ",
        "r.yaml:6:3: render.path_smaples ",
        "r.yaml:7:18: resolution[1] ",
    ]


def test_faults_in_lists_choices_and_merged_keys_have_positions(tmp_path: Path) -> None:
    text = (
        "name: x\nscenes:\n  - &room\n    name: a\n    source: here\n    resolution: [0, 64]\n"
        "  - {<<: *room, name: b}\nmethods:\n  - {name: n, kind: network}\n"
        "  - {name: c, kind: constant, x: 1}\n"
    )
    found = [line.split(" = ")[0] for line in _problems(tmp_path, text, Suite)]
    assert "r.yaml:6:18: scenes[0].resolution[0]" in found
    assert "r.yaml:6:18: scenes[1].resolution[0]" in found, "where the merged key stands"
    assert any(line.startswith("r.yaml:10:31: methods[1]") for line in found)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("name: x\nviews: [2\nseed: 1\n", r"r.yaml:3:5: expected ',' or '\]'.*valid YAML"),
        ("name: x\n\tviews: 2\n", "r.yaml:2:1: .*valid YAML"),
    ],
)
def test_invalid_yaml_has_a_position(tmp_path: Path, text: str, expected: str) -> None:
    import re

    (line,) = _problems(tmp_path, text)
    assert re.match(expected, line), line


def test_four_answers_give_a_recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["recipe", "new", "Küche.yaml"], input="3\n4\n64 x 48\nstandard\n")
    assert result.exit_code == 0, result.output
    assert result.output.count("?") + result.output.count("]:") >= 4
    recipe = read_yaml(Recipe, tmp_path / "Küche.yaml")
    assert (recipe.name, recipe.configurations, recipe.views) == ("kueche", 3, 4)
    assert recipe.resolution == (64, 48) and recipe.render.max_rel_mse == 0.005
    first = (tmp_path / "Küche.yaml").read_text().splitlines()[0]
    assert first == f"{HEADER}{SCHEMA_FILE}"
    assert "properties" in json.loads((tmp_path / SCHEMA_FILE).read_text())


def test_invalid_answers_write_nothing(tmp_path: Path) -> None:
    for answers, expected in (
        ((3, 4, "64", "draft"), "WIDTHxHEIGHT"),
        ((3, 4, "64x48", "best"), "render.quality = 'best'"),
        ((3, 4, "64x4", "draft"), r"resolution\[1\]"),
    ):
        with pytest.raises(InputError, match=expected):
            write_recipe(tmp_path / "r.yaml", *answers)
    assert list(tmp_path.iterdir()) == []
    write_recipe(tmp_path / "r.yaml", 1, 2, "64x48", "draft")
    with pytest.raises(InputError, match="an existing file"):
        write_recipe(tmp_path / "r.yaml", 1, 2, "64x48", "draft")


def test_faults_of_training_settings_have_a_position(tmp_path: Path) -> None:
    path = tmp_path / "t.yaml"
    path.write_text("batch_size: [2\n")
    with pytest.raises(InputError, match=r"t\.yaml:2:1: "):
        resolve_config("smoke", path)
    path.write_text("batch_size: 2\ndata:\n  crop: 3\n")
    with pytest.raises(InputError, match=r"t\.yaml:3:3: data\.crop = 3"):
        resolve_config("smoke", path)
