# SPDX-License-Identifier: MIT
"""LPIPS of many methods' images against the same true images, whose VGG features are computed once.

Features are stored in half precision in files named by the hash of the image: 34 MB for 480 x 288 pixels.
Half precision changes a distance by less than 1e-4.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.formats.base import sha256_hex, write_bytes_atomically
from datagen.foundation.errors import InputError

_REVISION = 1


class Lpips:
    """LPIPS-VGG distance of images; ``absence`` is the reason for missing weights, '' if they exist.

    ``folder`` stores the features of true images (None: not stored); ``layers`` are VGG16's convolutions, by
    default those of :func:`~model.training.weights.find_vgg`.
    """

    def __init__(self, folder: Path | None = None, layers: Sequence[Any] | None = None) -> None:
        from model.training.perceptual import LpipsVgg
        from model.training.weights import find_vgg

        self.absence, self._folder = "", folder
        try:
            self._network = LpipsVgg(list(layers) if layers is not None else find_vgg())
        except InputError as error:
            self.absence = str(error)

    def __call__(self, image: NDArray, truth: NDArray) -> float | None:
        """Return the distance of two (H, W, 3) sRGB-encoded images in [0, 1]; None without weights."""
        if self.absence:
            return None
        import torch

        with torch.no_grad():
            return float(self._network.distance(self._features(image), self._true_features(truth)))

    def _features(self, image: NDArray) -> list[Any]:
        import torch

        planes = np.ascontiguousarray(image.transpose(2, 0, 1), np.float32)
        return self._network.features(torch.from_numpy(planes)[None] * 2 - 1)

    def _true_features(self, truth: NDArray) -> list[Any]:
        import torch

        if self._folder is None:
            return self._features(truth)
        pixels = np.ascontiguousarray(truth, np.float32)
        key = sha256_hex(f"{_REVISION} {pixels.shape} ".encode() + pixels.tobytes())[:16]
        path = self._folder / f"{key}.npz"
        if not path.is_file():
            stream = io.BytesIO()
            np.savez(stream, *(layer.numpy().astype(np.float16) for layer in self._features(truth)))
            self._folder.mkdir(parents=True, exist_ok=True)
            write_bytes_atomically(path, stream.getvalue())
        with np.load(path) as data:
            return [torch.from_numpy(data[name].astype(np.float32)) for name in data.files]
