# SPDX-License-Identifier: MIT
"""Maps that a checkpoint predicted, shared by the methods that differ only in what follows."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from model.evaluation.camera_faults import CameraFaults
from model.evaluation.opened_scene import OpenedScene, key_of
from model.evaluation.suite import NetworkMethod


def predictions_folder(
    scene: OpenedScene, method: NetworkMethod, camera: CameraFaults | None, weights: str
) -> Path:
    """Where predictions of ``weights`` (their hash) are kept, named by all that decides them."""
    faults = [None if f is None else f.model_dump(mode="json") for f in (method.geometry, camera)]
    names = scene.prepared.input_names
    return scene.root / f"predictions-{key_of(weights, method.is_filtered, names, faults)}"


def link_files(source: Path, target: Path) -> None:
    """Let ``target`` have the files of ``source``, too. Hard links: nothing is stored twice, and whoever
    replaces a file leaves the other folder's alone."""
    if not source.is_dir():
        return
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(source.iterdir()):
        with suppress(FileExistsError):
            os.link(path, target / path.name)
