# SPDX-License-Identifier: MIT
"""Builds the sdist and the wheel into dist/, and tests each outside the checkout.

The wheel is built from the sdist and installed with its dependencies into a new environment, first without
extras, then with `train`. The sdist is installed into a second environment, which uses the dependencies of
the first; inference is not run there. In both environments, commands run outside the checkout, and every
module must be imported from the environment. Usage: try_packages.py CONSTRAINTS
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
DIST = REPOSITORY / "dist"
IS_ISOLATED = """
import sys
from pathlib import Path
import blender_addon, datagen, mitsuba_plugins, model
from datagen.foundation.bundled import bundled_folder
here, checkout = Path(sys.prefix).resolve(), Path(sys.argv[1])
for path in [*(Path(m.__file__) for m in (blender_addon, datagen, mitsuba_plugins, model)), bundled_folder()]:
    assert path.resolve().is_relative_to(here), f"{path} is not in {here}"
for path in sys.path:
    assert not Path(path).resolve().is_relative_to(checkout), f"{path} is in the checkout"
"""
WITHOUT_TORCH = """
import importlib.util
assert importlib.util.find_spec("torch") is None, "torch is installed without the extra train"
"""


class Environment:
    """A new virtual environment in ``folder``, in which its commands run."""

    def __init__(self, folder: Path):
        self.folder, self.bin = folder, folder / "venv" / "bin"
        folder.mkdir()
        self._call([sys.executable, "-m", "venv", str(folder / "venv")])

    @property
    def packages(self) -> Path:
        """The site-packages of the environment."""
        return next((self.folder / "venv" / "lib").glob("python*/site-packages"))

    def run(self, program: str, *arguments: str | Path) -> str:
        """Run a program of the environment; returns its output. A failure raises ``SystemExit``."""
        return self._call([str(self.bin / program), *map(str, arguments)])

    def _call(self, command: list[str]) -> str:
        start = time.monotonic()
        clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
        result = subprocess.run(
            command, cwd=self.folder, env=clean, capture_output=True, text=True, timeout=900, check=False
        )
        shown = " ".join([Path(command[0]).name, *(word[:60].split("\n")[0] for word in command[1:])])
        print(f"{time.monotonic() - start:6.1f} s  {shown}", flush=True)
        if result.returncode:
            raise SystemExit(f"{result.stdout}\n{result.stderr}\nfailed with {result.returncode}: {shown}")
        return result.stdout


def build() -> tuple[Path, Path]:
    """Build sdist and wheel into dist/, replacing older ones, and check them; returns both paths."""
    for old in DIST.glob("scene_materials-*"):
        old.unlink()
    command = [sys.executable, "-m", "build", "--outdir", str(DIST), str(REPOSITORY)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise SystemExit(result.stdout + result.stderr)
    sdist, wheel = next(DIST.glob("*.tar.gz")), next(DIST.glob("*.whl"))
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", sdist, wheel], check=True)
    return sdist, wheel


def try_dataset(environment: Environment) -> None:
    """Make a dataset from the bundled library and recipe, with the commands that need no torch."""
    environment.run("python", "-c", IS_ISOLATED, REPOSITORY)
    assert environment.run("datagen", "--version").startswith("scene-materials ")
    assert "bundled library" in environment.run("datagen", "doctor")
    assert "environment" in environment.run("datagen", "library")
    environment.run("datagen", "run", "smoke", "--out", "smoke", "--workers", "2")
    environment.run("datagen", "verify", "smoke")


def try_inference(environment: Environment) -> None:
    """Infer materials from a rendered shard with the bundled checkpoint, and render them."""
    assert environment.run("materials", "--version").startswith("scene-materials ")
    shard = min((environment.folder / "smoke" / "shards").rglob("*.tar"))
    environment.run("materials", "infer", shard, "--out", "asset", "--atlas", "512")
    environment.run("materials", "render", "asset/asset", "--out", "renders", "--samples", "1",
                    "--insert", "bundled:mug@0,0,0")  # fmt: skip


def main() -> None:
    """Build both packages and test each."""
    constraints = Path(sys.argv[1]).resolve()
    sdist, wheel = build()
    install = ("install", "--quiet", "--disable-pip-version-check")
    with tempfile.TemporaryDirectory(prefix="scene-materials-") as scratch:
        first = Environment(Path(scratch) / "wheel")
        first.run("pip", *install, "--constraint", constraints, wheel)
        for name in ("datagen", "mitsuba_plugins", "model"):
            assert (first.packages / name / "py.typed").is_file(), name
        first.run("python", "-c", WITHOUT_TORCH)
        try_dataset(first)
        first.run("pip", *install, "--constraint", constraints, f"{wheel}[train]")
        try_inference(first)
        second = Environment(Path(scratch) / "sdist")
        second.run("pip", *install, "--no-deps", sdist)
        (second.packages / "dependencies.pth").write_text(f"{first.packages}\n")
        try_dataset(second)
    print(f"{sdist.name} and {wheel.name} work where they are installed", flush=True)


if __name__ == "__main__":
    main()
