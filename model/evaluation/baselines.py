# SPDX-License-Identifier: MIT
"""Maps of methods that do not use a checkpoint; they are merged like predicted maps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import sha256_file, sha256_hex, write_bytes_atomically
from datagen.formats.capture import Capture, CaptureView
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.errors import InputError, Problem, raise_problems
from datagen.foundation.exr import decode_view, encode_view
from datagen.geometry.views import TracedCapture, TracedView
from model.evaluation.suite import ConstantMethod, MapsMethod, OracleMethod, TextureMethod
from model.reconstruction.predict.predictor import capture_exposure
from model.reconstruction.predict.sources import TRUTH, GivenMaps
from model.reconstruction.stages import Maps

Given = TextureMethod | ConstantMethod | MapsMethod | OracleMethod


def given_maps(method: Given, scene: str, capture: Capture, kept: Path, judged: Sequence[str]) -> GivenMaps:
    """Return the source of a method's maps for the views of ``capture``, a capture of the scene ``scene``.

    Reading the source also writes the maps of the views ``judged`` (compared with the truth) to
    ``kept``/VIEW.exr. Raises :class:`InputError` for missing or invalid files of a method of kind ``maps``.
    """
    identity, read = _source(method, scene, capture)

    def read_and_keep(traced: TracedCapture) -> list[Maps]:
        maps = read(traced)
        kept.mkdir(parents=True, exist_ok=True)
        for view, view_maps in zip(traced.views, maps, strict=True):
            if view.name in judged:
                judged_maps = {name: view_maps[name] for name in MATERIAL_MAPS}
                write_bytes_atomically(kept / f"{view.name}.exr", encode_view(judged_maps))
        return maps

    return GivenMaps(identity, read_and_keep)


def _source(method: Given, scene: str, capture: Capture) -> tuple[str, Callable[[TracedCapture], list[Maps]]]:
    if isinstance(method, TextureMethod):
        return "texture", _texture
    if isinstance(method, OracleMethod):
        return "oracle", TRUTH.read
    if isinstance(method, ConstantMethod):
        values = {name: np.ravel(getattr(method, name)) for name in MATERIAL_MAPS}
        return f"constant {values}", lambda traced: [_constant(view, values) for view in traced.views]
    files = maps_files(method.folder / scene, capture)
    hashes = sha256_hex("".join(sha256_file(path) for path in files.values()).encode())
    return f"maps {hashes}", lambda traced: [_read(files[view.name]) for view in traced.views]


def _texture(traced: TracedCapture) -> list[Maps]:
    """Return maps of each view: D is the photograph, exposed and clipped to [0, 1]; S is 0 and R is 1."""
    exposure = capture_exposure(traced.statistics)
    maps = []
    for view in traced.views:
        color = np.clip(view.color * exposure, 0, 1).astype(np.float16)
        ones = np.ones((*color.shape[:2], 1), np.float16)
        maps.append({"diffuse_albedo": color, "specular_albedo": np.zeros_like(color), "roughness": ones})
    return maps


def _constant(view: TracedView, values: dict[str, NDArray]) -> Maps:
    shape = (view.camera.height_px, view.camera.width_px)
    return {name: np.broadcast_to(v.astype(np.float16), (*shape, len(v))) for name, v in values.items()}


def maps_files(folder: Path, capture: Capture) -> dict[str, Path]:
    """Return each view's file in ``folder``: ``VIEW.exr``, or ``views/VIEW.exr`` from ``materials infer``.

    Raises :class:`InputError` for files that are missing, damaged, of another size, or outside [0, 1].
    """
    problems, files = [], {}
    for view in capture.views:
        candidates = [folder / f"{view.name}.exr", folder / "views" / f"{view.name}.exr"]
        path = next((candidate for candidate in candidates if candidate.is_file()), None)
        if path is None:
            remedy = "make maps of all input views; docs/evaluation.md describes the format"
            problems.append(Problem(folder, view.name, "no file", f"{view.name}.exr", remedy))
            continue
        files[view.name] = path
        try:
            maps = _read(path)
        except InputError as error:
            problems += error.problems
            continue
        problems += _map_faults(path, view, maps)
    raise_problems(problems)
    return files


def _read(path: Path) -> Maps:
    return decode_view(path, MATERIAL_MAPS)


def _map_faults(path: Path, view: CaptureView, maps: Maps) -> list[Problem]:
    size = (view.camera.height_px, view.camera.width_px)
    found = []
    for name, values in maps.items():
        if values.shape[:2] != size:
            got, expected = f"{values.shape[1]} x {values.shape[0]}", f"{size[1]} x {size[0]} pixels"
            found.append(Problem(path, name, got, expected, "make it at the photograph's size"))
        elif not np.isfinite(values).all() or values.min() < 0 or values.max() > 1:
            got = f"values from {values.min():g} to {values.max():g}"
            found.append(Problem(path, name, got, "finite values in [0, 1], linear", "clip or rescale them"))
    return found
