# SPDX-License-Identifier: MIT
"""Folders of predicted maps, shared by methods that differ only in later stages."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from datagen.foundation.buffers import LIGHT_BUFFERS
from datagen.foundation.versions import LIGHT_REVISION
from model.checkpoint import read_card
from model.evaluation.camera_faults import CameraFaults
from model.evaluation.opened_scene import OpenedScene, key_of
from model.evaluation.suite import Method, NetworkMethod
from model.own_network import network_inputs

_GEOMETRY = 2
"""Revision of the geometry of captures, which predictions depend on."""
_MENDED_MESH = 2
"""Revision of the mending of meshes with errors, which precedes prediction."""


def predictions_folder(
    scene: OpenedScene, method: NetworkMethod, camera: CameraFaults | None, weights: str
) -> Path:
    """Folder for predictions of the checkpoint with the hash ``weights``, named by a hash of their inputs."""
    faults = [None if f is None else f.model_dump(mode="json") for f in (method.geometry, camera)]
    names = scene.prepared.input_names
    revisions = [_GEOMETRY, *light_revision(method), *mesh_revision(method, camera)]
    return scene.root / f"predictions-{key_of(weights, method.is_filtered, names, faults, *revisions)}"


def light_revision(method: NetworkMethod) -> list[int]:
    """Return the revision of recorded light in a list if the method's network uses it as input, else []."""
    inputs = network_inputs(read_card(Path(method.checkpoint)).network)
    return [LIGHT_REVISION] if set(LIGHT_BUFFERS) & set(inputs) else []


def mesh_revision(method: Method, camera: CameraFaults | None) -> list[int]:
    """Return the revision of mended meshes in a list if the mesh of a method has errors, else []."""
    errors = (method.geometry, camera.geometry if camera else None)
    return [_MENDED_MESH] if any(error is not None for error in errors) else []


def link_files(source: Path, target: Path) -> None:
    """Hard-link the files of the folder ``source``, if it exists, into ``target``; keep existing files."""
    if not source.is_dir():
        return
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(source.iterdir()):
        with suppress(FileExistsError):
            os.link(path, target / path.name)
