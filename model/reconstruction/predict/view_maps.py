# SPDX-License-Identifier: MIT
"""Predicts maps of a capture's views and stores them view by view, so that interrupted runs can resume."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from datagen.formats.base import write_bytes_atomically
from datagen.formats.capture import Capture, CaptureView
from datagen.foundation.buffers import LIGHT_BUFFERS, MATERIAL_MAPS
from datagen.foundation.errors import InputError
from datagen.foundation.exr import decode_view, encode_view
from datagen.geometry.views import TracedCapture
from datagen.light.view_light import ViewLight
from datagen.multiview.statistics import StatisticsOptions, compute_statistics
from datagen.multiview.visibility import VisibilityOptions
from model.checkpoint import load_checkpoint
from model.own_network import network_inputs
from model.reconstruction.predict.predictor import Predictor, capture_exposure, view_tensors
from model.reconstruction.stages import Maps, Run

USUAL_PIXELS = 640 * 384
"""Number of pixels above which views are processed in smaller batches, to bound the memory of a batch."""


def predicted_maps(traced: TracedCapture, checkpoint_path: Path, run: Run) -> list[Maps]:
    """Return the maps of all views; stored maps are read, missing ones are predicted and stored."""
    capture, views, options, report = traced.capture, traced.statistics, run.options, run.report
    with report.stage("predict"):
        checkpoint = load_checkpoint(checkpoint_path, options.device)
        report.exposure = capture_exposure(views)
        predictor = Predictor(checkpoint, report.exposure, options)
    report.precision = str(predictor.dtype).removeprefix("torch.")
    report.is_filtered = predictor.is_filtered
    if options.is_filtered and not predictor.is_filtered:
        report.notes.append("the checkpoint has no confidence networks: maps are not filtered")
    maps: list[Maps | None] = [_stored(run.out, view, predictor.has_confidence) for view in capture.views]
    batches = _batches(capture, options.batch)
    pending = [batch for batch in batches if any(maps[index] is None for index in batch)]
    statistics = compute_statistics(
        views,
        StatisticsOptions(visibility=VisibilityOptions(mode=options.visibility)),
        traced.geometry.scene if options.visibility == "trace" else None,
        only=[index for batch in pending for index in batch],
    )
    light = None
    if pending and set(LIGHT_BUFFERS) & set(network_inputs(checkpoint.card.network)):
        with run.stage("light for the network"):
            light = ViewLight(traced.views, traced.geometry, capture.geometry.emitter_mask())
    run.tell("predict", sum(m is not None for m in maps), len(maps))
    for batch in pending:
        tensors = []
        for index in batch:
            with report.stage("statistics"):
                gathered = next(statistics)
                of_light = light.buffers(index, gathered["color_median"]) if light else None
            tensors.append(view_tensors(capture.views[index].camera, views[index], gathered, of_light))
        with report.stage("predict"):
            predicted = predictor.predict(tensors)
        with report.stage("write maps"):
            for index, view_maps in zip(batch, predicted, strict=True):
                if maps[index] is None:
                    # rounded as stored, so that a resumed run equals an uninterrupted one
                    maps[index] = {name: values.astype(np.float16) for name, values in view_maps.items()}
                    _store(run.out, capture.views[index], view_maps)
        run.tell("predict", sum(m is not None for m in maps), len(maps))
    return [view_maps for view_maps in maps if view_maps is not None]


def _batches(capture: Capture, size: int) -> list[list[int]]:
    """Group consecutive views of equal size into batches of at most ``size`` indices, fewer for large views.

    Batches do not depend on stored maps, since convolutions round differently for other batch sizes.
    """
    batches: list[list[int]] = []
    for index, camera in enumerate(capture.cameras):
        last = capture.cameras[batches[-1][-1]] if batches else None
        fits = last is not None and (last.width_px, last.height_px) == (camera.width_px, camera.height_px)
        most = min(size, size * USUAL_PIXELS // (camera.width_px * camera.height_px))
        if fits and len(batches[-1]) < most:
            batches[-1].append(index)
        else:
            batches.append([index])
    return batches


def _paths(out: Path, view: CaptureView) -> tuple[Path, Path]:
    """Return the paths of a view's maps and of their confidence."""
    return out / "views" / f"{view.name}.exr", out / "views" / f"{view.name}.confidence.npy"


def _store(out: Path, view: CaptureView, maps: Maps) -> None:
    path, confidence_path = _paths(out, view)
    if "confidence" in maps:
        stream = io.BytesIO()
        np.save(stream, maps["confidence"].astype(np.float16))
        write_bytes_atomically(confidence_path, stream.getvalue())
    write_bytes_atomically(path, encode_view({name: maps[name] for name in MATERIAL_MAPS}))


def _stored(out: Path, view: CaptureView, wants_confidence: bool) -> Maps | None:
    path, confidence_path = _paths(out, view)
    if not path.is_file() or (wants_confidence and not confidence_path.is_file()):
        return None
    try:
        maps = decode_view(path, MATERIAL_MAPS)
        if wants_confidence:
            maps["confidence"] = np.load(confidence_path)
    except (InputError, ValueError, EOFError):
        return None  # damaged files are predicted again
    shape = (view.camera.height_px, view.camera.width_px)
    return maps if all(values.shape[:2] == shape for values in maps.values()) else None
