# SPDX-License-Identifier: MIT
"""Predicts maps of views with a checkpoint, in batches, and filters them with the bilateral solver.

All views of a capture have one exposure, which scales the 95th percentile of luminance over all surface
pixels to 0.9, so a surface has the same brightness in every view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.foundation.cameras import Camera
from datagen.foundation.color import exposure_for
from datagen.foundation.errors import input_error
from datagen.multiview.statistics import StatisticsView
from model.checkpoint import Checkpoint
from model.confidence import FILTERED_MAPS, filter_maps
from model.networks import encode_color
from model.reconstruction.infer_options import InferOptions

_EXPOSURE_STEP = 5  # every fifth pixel suffices for a percentile


def has_fast_bfloat16(device: str) -> bool:
    """Return whether the device has native bfloat16 instructions."""
    if device.startswith("cuda"):
        return torch.cuda.is_bf16_supported(including_emulation=False)
    flags = torch.backends.cpu.get_cpu_capability()
    return flags == "AVX512" and torch.ops.mkldnn._is_mkldnn_bf16_supported()


def capture_exposure(views: Sequence[StatisticsView]) -> float:
    """Compute the factor for all views that scales the 95th percentile of surface luminance to 0.9."""
    samples = []
    for view in views:
        color = view.color.reshape(-1, 3)[::_EXPOSURE_STEP]
        samples.append(color[view.surface_mask.ravel()[::_EXPOSURE_STEP] > 0.5])
    return exposure_for(np.concatenate(samples))


def view_tensors(
    camera: Camera,
    view: StatisticsView,
    statistics: dict[str, NDArray[np.float32]],
    light: Mapping[str, NDArray[np.float32]] | None = None,
) -> dict[str, Tensor]:
    """Make the network inputs (1, C, H, W) of a view by name; normals are in camera space, 0 off the surface.

    ``statistics`` are the view's buffers ``color_min`` etc. by name; ``light`` are the buffers of
    :class:`~datagen.light.view_light.ViewLight`.
    """
    normal = view.normal_world.astype(np.float32) @ camera.world_from_camera[:3, :3].astype(np.float32)
    on_surface = (view.surface_mask > 0.5) & (view.depth_z_m > 0)
    buffers = {
        "beauty": view.color,
        "normal_camera": np.where(on_surface, normal, 0.0),
        "depth_z_m": view.depth_z_m,
        **{name: statistics[name] for name in ("color_min", "color_median", "color_max")},
        **(light or {}),
    }
    return {
        name: torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1), np.float32))[None]
        for name, array in buffers.items()
    }


class Predictor:
    """A checkpoint prepared for a capture; ``exposure`` is the result of :func:`capture_exposure`.

    ``has_confidence``: True if the output of the confidence networks is also returned, as weights for the
    merge. The precision "auto" is bfloat16 if the device supports it natively, else float32.

    Raises :class:`InputError` if confidence is requested from a checkpoint without confidence networks.
    """

    def __init__(self, checkpoint: Checkpoint, exposure: float, options: InferOptions):
        self.options, self.exposure = options, exposure
        self.has_confidence = options.weights == "confidence"
        device = self.options.device
        wants_bfloat16 = self.options.precision == "bfloat16" or (
            self.options.precision == "auto" and has_fast_bfloat16(device)
        )
        self.dtype = torch.bfloat16 if wants_bfloat16 else torch.float32
        self._network = checkpoint.network.to(device).to(memory_format=torch.channels_last)  # type: ignore
        confidence = checkpoint.confidence
        if self.has_confidence and confidence is None:
            expected = "a checkpoint with confidence networks"
            raise input_error(
                "infer",
                "weights",
                "confidence",
                expected,
                "use other --weights, or train confidence networks",
            )
        self._confidence = confidence.to(device) if confidence is not None else None
        self._solver = checkpoint.card.solver

    @property
    def is_filtered(self) -> bool:
        """True if the bilateral solver runs."""
        return self.options.is_filtered and self._confidence is not None

    @torch.no_grad()
    def predict(self, batch: Sequence[dict[str, Tensor]]) -> list[dict[str, NDArray[np.float32]]]:
        """Predict maps (H, W, 3 or 1) in [0, 1] of equally large views from their :func:`view_tensors`; with
        ``has_confidence``, also ``confidence`` (H, W, 3) in [0, 1] of D (always 1), S and R.
        """
        device = self.options.device
        names = list(batch[0])
        tensors = {name: torch.cat([view[name] for view in batch]).to(device) for name in names}
        exposure = torch.full((len(batch),), self.exposure, device=device)
        depth_max = tensors["depth_z_m"].amax(dim=(1, 2, 3))
        with torch.autocast(device.split(":")[0], torch.bfloat16, enabled=self.dtype == torch.bfloat16):
            maps = self._network(tensors, exposure, depth_max)
        maps = {name: value.float().contiguous() for name, value in maps.items()}
        if self._confidence is not None and (self.is_filtered or self.has_confidence):
            image = encode_color(tensors["beauty"], self.exposure)
            confidences = self._confidence(image, maps)
            if self.is_filtered:
                maps = filter_maps(maps, confidences, self._solver)
            if self.has_confidence:
                of_specular, of_roughness = (confidences[name] for name in FILTERED_MAPS)
                of_diffuse = torch.ones_like(of_specular)
                maps["confidence"] = torch.cat([of_diffuse, of_specular, of_roughness], dim=1)
        arrays = {name: value.permute(0, 2, 3, 1).cpu().numpy() for name, value in maps.items()}
        return [{name: value[k] for name, value in arrays.items()} for k in range(len(batch))]
