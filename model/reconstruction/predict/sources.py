# SPDX-License-Identifier: MIT
"""Sources of the views' maps: a checkpoint, the capture's ground truth, or given maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.formats.base import sha256_file
from datagen.formats.capture import CaptureView
from datagen.foundation.buffers import MATERIAL_MAPS
from datagen.foundation.errors import input_error
from datagen.geometry.views import TracedCapture
from model.reconstruction.infer_options import InferOptions
from model.reconstruction.stages import Maps, Run


@dataclass(frozen=True)
class CheckpointMaps:
    """Predictions of a checkpoint's networks."""

    path: Path
    is_predicted: bool = True

    @property
    def identity(self) -> str:
        """SHA-256 of the checkpoint file. Raises :class:`InputError` if it cannot be read."""
        try:
            return sha256_file(self.path)
        except OSError as error:
            expected = "a checkpoint (.safetensors)"
            raise input_error(self.path, "", str(error), expected, "check the path") from None

    def prepare(self, options: InferOptions) -> None:
        """Raise :class:`InputError` for an unreadable checkpoint or an unavailable device."""
        from model.checkpoint import read_card
        from model.devices import parse_device

        read_card(self.path)
        parse_device(options.device)

    def maps(self, traced: TracedCapture, run: Run) -> list[Maps]:
        """Read the maps that an earlier run stored, and predict the maps of the other views."""
        # imports torch, which other sources do not need
        from model.reconstruction.predict.view_maps import predicted_maps

        return predicted_maps(traced, self.path, run)


@dataclass(frozen=True)
class GivenMaps:
    """Maps from another source; ``read`` returns the maps of every view, in the capture's order."""

    identity: str
    read: Callable[[TracedCapture], list[Maps]]
    is_predicted: bool = False

    def prepare(self, options: InferOptions) -> None:
        """Do nothing, since given maps need no preparation."""

    def maps(self, traced: TracedCapture, run: Run) -> list[Maps]:
        with run.stage("read maps"):
            return self.read(traced)


def _truth(view: CaptureView) -> Maps:
    maps = view.source.read_maps(MATERIAL_MAPS)
    if set(maps) != set(MATERIAL_MAPS):
        expected = "a rendered capture"
        raise input_error(view.name, "ground truth", "none", expected, "leave --truth out")
    exact = {name: np.clip(values.astype(np.float32), 0, 1) for name, values in maps.items()}
    return {**exact, "confidence": np.ones_like(exact[MATERIAL_MAPS.diffuse_albedo])}


TRUTH = GivenMaps("truth", lambda traced: [_truth(view) for view in traced.capture.views])
"""Ground truth of a rendered capture, for tests of the later stages alone."""
