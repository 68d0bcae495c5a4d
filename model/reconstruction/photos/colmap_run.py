# SPDX-License-Identifier: MIT
"""Runs COLMAP to compute cameras and a mesh from a folder of photographs; each step runs only once.

WORK/size-K.txt     photographs of one size, if there are several sizes
WORK/database.db    features and matches
WORK/found/         all models of the mapper
WORK/sparse/0/      the largest model
WORK/dense/         undistorted photographs and depth, if there is a suitable GPU
WORK/mesh.ply       a Poisson surface of the dense points, else a Delaunay surface of the sparse ones
WORK/STEP.done      mark of a finished step; WORK/STEP.log: output of COLMAP in it
"""

from __future__ import annotations

import shlex
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.formats.base import write_bytes_atomically
from datagen.foundation.budget import Budget
from datagen.foundation.errors import input_error
from datagen.foundation.images import image_size
from datagen.foundation.meshes.ply import encode_ply
from model.reconstruction.captures.colmap import read_sights
from model.reconstruction.photos.sparse_mesh import sparse_surface

MAX_IMAGE_PX = 2400
"""Maximum longer side of photographs for feature extraction, in pixels; larger ones are scaled down."""
MAX_POINT_ERROR_PX = 2.0
"""Maximum mean reprojection error, in pixels, of sparse points from which the mesh is made."""
_OVERLAP = "take more sharp, overlapping photographs from different positions; see the log"
_TAIL = 400  # characters of the log in an error
_RENAMED = {"--SiftExtraction.": "--FeatureExtraction.", "--SiftMatching.": "--FeatureMatching."}
"""Prefixes of options up to COLMAP 3.12, and their replacements, in most options, since 3.13."""


@dataclass(frozen=True)
class Step:
    """Commands that run as one step; ``clears`` lists files to remove and folders to empty first."""

    name: str
    commands: tuple[tuple[str, ...], ...]
    clears: tuple[str, ...] = ()


def lists_by_size(photographs: Sequence[Path], work: Path) -> dict[Path, list[str]]:
    """Return the names of the photographs of each size, by the path of a list file; {} for a single size.

    Photographs of different sizes, such as landscape and portrait, cannot share a camera in COLMAP.
    """
    names: dict[tuple[int, int], list[str]] = {}
    for file in photographs:
        names.setdefault(image_size(file), []).append(file.name)
    if len(names) < 2:
        return {}
    return {work / f"size-{k}.txt": of_size for k, of_size in enumerate(names.values(), start=1)}


def camera_steps(program: str, photographs: Path, work: Path, lists: Sequence[Path]) -> tuple[Step, ...]:
    """Return the steps that compute features, matches and cameras on the CPU with COLMAP's ``program``.

    Each of the ``lists`` (:func:`lists_by_size`) has a camera; without lists, all photographs share one.
    """
    database = ("--database_path", str(work / "database.db"))
    images = ("--image_path", str(photographs))
    features = (
        program, "feature_extractor", *database, *images, "--ImageReader.single_camera", "1",
        "--ImageReader.camera_model", "SIMPLE_RADIAL", "--SiftExtraction.use_gpu", "0",
        "--SiftExtraction.max_image_size", str(MAX_IMAGE_PX), "--SiftExtraction.peak_threshold", "0.003",
    )  # fmt: skip
    of_lists = tuple((*features, "--image_list_path", str(path)) for path in lists) or (features,)
    matches = (
        program, "exhaustive_matcher", *database, "--SiftMatching.use_gpu", "0",
        "--SiftMatching.guided_matching", "1",
    )  # fmt: skip
    mapper = (program, "mapper", *database, *images, "--output_path", str(work / "found"))
    return (
        Step("features", of_lists, ("database.db",)),
        Step("matches", (matches,)),
        Step("cameras", (mapper,), ("found",)),
    )


def dense_step(program: str, photographs: Path, work: Path) -> Step:
    """Return the step that computes depth maps and a Poisson surface, for which COLMAP needs CUDA."""
    dense, points = str(work / "dense"), str(work / "dense" / "fused.ply")
    return Step(
        "dense",
        (
            (program, "image_undistorter", "--image_path", str(photographs),
             "--input_path", str(work / "sparse" / "0"), "--output_path", dense),
            (program, "patch_match_stereo", "--workspace_path", dense),
            (program, "stereo_fusion", "--workspace_path", dense, "--output_path", points),
            (program, "poisson_mesher", "--input_path", points, "--output_path", str(work / "mesh.ply")),
        ),
        ("dense", "mesh.ply"),
    )  # fmt: skip


def _printed(lines: Sequence[str]) -> str:
    """Return a shell command that prints ``lines``."""
    return shlex.join(["printf", r"%s\n", *lines])


class ColmapRun:
    """Runs unfinished steps on the photographs ``files`` of ``folder``, in the folder ``work``.

    ``tell`` is called with the name of each step.
    """

    def __init__(
        self, program: str, folder: Path, files: Sequence[Path], work: Path, tell: Callable[[str], None]
    ):
        self.program, self.photographs, self.work, self.tell = program, folder, work, tell
        self._lists = lists_by_size(files, work)

    def commands(self) -> str:
        """Return the shell commands that install COLMAP and compute the cameras."""
        found, largest = self.work / "found", shlex.quote(str(self.model))
        steps = camera_steps(self.program, self.photographs, self.work, list(self._lists))
        return "\n".join(
            [
                "apt-get install colmap    # or https://colmap.github.io/install.html",
                f"mkdir -p {shlex.quote(str(found))}",
                *(f"{_printed(names)} > {shlex.quote(str(path))}" for path, names in self._lists.items()),
                *(shlex.join(command) for step in steps for command in step.commands),
                f"mkdir -p {shlex.quote(str(self.model.parent))}",
                f"cp -r {shlex.quote(str(found / '0'))} {largest}    # the largest model",
                "# then run the same command again",
            ]
        )

    @property
    def has_cameras(self) -> bool:
        """True if the folder with the cameras exists."""
        return self.model.is_dir()

    @property
    def model(self) -> Path:
        """Folder of the COLMAP model with the cameras."""
        return self.work / "sparse" / "0"

    def cameras(self) -> Path:
        """Compute the cameras and return their folder. Raises :class:`InputError` if COLMAP fails."""
        if self.has_cameras:
            return self.model
        (self.work / "found").mkdir(parents=True, exist_ok=True)
        for path, names in self._lists.items():
            write_bytes_atomically(path, "".join(f"{name}\n" for name in names).encode())
        for step in camera_steps(self.program, self.photographs, self.work, list(self._lists)):
            self._do(step)
        models = [folder for folder in (self.work / "found").iterdir() if _size(folder)]
        if not models:
            raise input_error(
                self.work / "cameras.log", "cameras", "no model", "overlapping photographs", _OVERLAP
            )
        partial = self.work / "sparse" / "partial"
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(max(models, key=_size), partial)
        partial.rename(self.model)
        return self.model

    def mesh(self) -> Path:
        """Compute a mesh in the cameras' frame, from dense points if COLMAP can use a GPU; return its path.

        Raises :class:`InputError` if the sparse points do not define a surface.
        """
        mesh = self.work / "mesh.ply"
        if (self.work / "mesh.done").is_file() or (self.work / "dense.done").is_file():
            return mesh
        if (
            shutil.which("nvidia-smi")
            and shutil.which(self.program)
            and not (self.work / "dense.failed").is_file()
        ):
            try:
                self._do(dense_step(self.program, self.photographs, self.work))
                return mesh
            except subprocess.SubprocessError:
                write_bytes_atomically(self.work / "dense.failed", b"")
                self.tell("dense points need COLMAP with CUDA; the mesh is made from sparse points")
        self.tell("mesh")
        surface = sparse_surface(read_sights(self.model, Budget(self.model), MAX_POINT_ERROR_PX))
        if not len(surface.faces):
            raise input_error(
                self.model, "points3D.bin", "no surface", "points that enclose a room", _OVERLAP
            )
        write_bytes_atomically(mesh, encode_ply(surface))
        write_bytes_atomically(self.work / "mesh.done", b"")
        return mesh

    @property
    def has_sparse_mesh(self) -> bool:
        """True if the mesh was triangulated from COLMAP's sparse points, without dense depth."""
        return (self.work / "mesh.done").is_file()

    def _do(self, step: Step) -> None:
        done = self.work / f"{step.name}.done"
        if done.is_file():
            return
        self.tell(step.name)
        for name in step.clears:
            path = self.work / name
            if path.is_dir():
                shutil.rmtree(path)
                path.mkdir()
            else:
                path.unlink(missing_ok=True)
        log = self.work / f"{step.name}.log"
        with log.open("wb") as out:
            for command in step.commands:
                ended = subprocess.run(
                    _as_installed(command), stdout=out, stderr=subprocess.STDOUT, check=False
                )
                if ended.returncode and step.name == "dense":
                    raise subprocess.CalledProcessError(ended.returncode, command)
                if ended.returncode:
                    tail = log.read_text(errors="replace")[-_TAIL:].strip() or "nothing"
                    got = f"{Path(command[0]).name} {command[1]} exited with code {ended.returncode}: {tail}"
                    remedy = _OVERLAP if command[1] == "mapper" else "see the log, then run it again"
                    raise input_error(log, step.name, got, "exit code 0", remedy)
        write_bytes_atomically(done, b"")


def _as_installed(command: tuple[str, ...]) -> list[str]:
    """Return ``command``, with the options renamed that the installed COLMAP lists by their new name."""
    if not any(word.startswith(tuple(_RENAMED)) for word in command):
        return list(command)
    shown = subprocess.run([*command[:2], "-h"], capture_output=True, check=False)
    known = set((shown.stdout + shown.stderr).decode(errors="replace").split())
    renamed = list(command)
    for old, new in _RENAMED.items():
        renamed = [word.replace(old, new) if word.replace(old, new) in known else word for word in renamed]
    return renamed


def _size(model: Path) -> int:
    """Return the size in bytes of a model's image file, or 0 if there is no model."""
    for name in ("images.bin", "images.txt"):
        if (model / name).is_file():
            return (model / name).stat().st_size
    return 0
