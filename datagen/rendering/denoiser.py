# SPDX-License-Identifier: MIT
"""Denoising with noise-free guides, by OptiX on NVIDIA GPUs if its weights exist, else by OIDN on the CPU.

With noise-free albedo and normal, two paths per pixel have less error than sixteen with noisy guides; guides
are therefore rendered in a separate pass (:mod:`mitsuba_plugins.material_buffers`).
"""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

OPTIX_WEIGHTS = Path("/usr/share/nvidia/nvoptix.bin")
"""Weights of the OptiX denoiser on Linux, part of the NVIDIA driver but often missing in containers."""


class Denoiser(Protocol):
    """A denoiser of images; ``name`` is written to the view's record.

    ``wants_camera_normals`` states whether :meth:`denoise` requires normals in camera instead of world space.
    """

    name: str
    wants_camera_normals: ClassVar[bool]

    def denoise(
        self, color: NDArray[np.float32], albedo: NDArray[np.float32], normal: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Denoise linear radiance ``color`` with the guides ``albedo`` and unit ``normal``, all (H, W, 3)."""
        ...


def auxiliary_albedo(
    diffuse: NDArray[np.float32], specular: NDArray[np.float32], mask: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Albedo guide (H, W, 3), the reflectance at normal incidence, (1 - S) D + S, times ``mask``.

    ``mask`` (H, W, 1) is the share of the pixel covered by surface. With it, the guide fades to 0 at
    silhouettes like the image, which contains only reflected light.
    """
    return (mask * ((1.0 - specular) * diffuse + specular)).astype(np.float32)


def _import_pyoidn() -> ModuleType:
    """Import pyoidn without its optional import of torch, which takes 2 s and 200 MB.

    Only its functions for tensors need torch; they import it again when called.
    """
    if "pyoidn" in sys.modules or "torch" in sys.modules:
        return importlib.import_module("pyoidn")
    sys.modules["torch"] = ModuleType("torch")
    try:
        return importlib.import_module("pyoidn")
    finally:
        del sys.modules["torch"]


@dataclass
class OidnDenoiser:
    """Intel Open Image Denoise on the CPU, not thread-safe. ``num_threads`` 0 uses all cores.

    ``quality`` is fast, balanced or high. If ``is_guided`` is false, albedo and normal are ignored (for
    measurements of their effect).
    """

    quality: str = "high"
    num_threads: int = 0
    is_guided: bool = True
    wants_camera_normals: ClassVar[bool] = False

    def __post_init__(self) -> None:
        pyoidn = _import_pyoidn()
        self.name = f"oidn-{'.'.join(version('pyoidn').split('.')[:3])}-{self.quality}"
        if not self.is_guided:
            self.name += "-unguided"
        self._device = pyoidn.Device()
        if self.num_threads:
            self._device.set_int("numThreads", self.num_threads)
        self._device.set_bool("setAffinity", False)  # workers share the machine; pinned threads would collide
        self._device.commit()
        self._check()
        self._filters: dict[tuple[int, int], tuple[Any, dict[str, NDArray[np.float32]]]] = {}

    def denoise(
        self, color: NDArray[np.float32], albedo: NDArray[np.float32], normal: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Denoise as in :class:`Denoiser`, clamped to at least 0. Raises ``RuntimeError`` if OIDN fails."""
        shape = (int(color.shape[0]), int(color.shape[1]))
        if shape not in self._filters:
            self._filters[shape] = self._make_filter(shape)
        oidn_filter, images = self._filters[shape]
        for name, array in (("color", color), ("albedo", albedo), ("normal", normal)):
            images[name][...] = array
        oidn_filter.execute()
        self._check()
        return np.maximum(images["output"], 0.0)

    def _make_filter(self, shape: tuple[int, int]) -> tuple[Any, dict[str, NDArray[np.float32]]]:
        """Create and commit a filter, which is slow, and its image buffers for ``shape`` (H, W)."""
        pyoidn = _import_pyoidn()
        from pyoidn.denoise import _QUALITIES
        from pyoidn.filter import OIDN_FORMAT_FLOAT3

        images = {name: np.zeros((*shape, 3), np.float32) for name in ("color", "albedo", "normal", "output")}
        oidn_filter = pyoidn.Filter(self._device, "RT")
        for name, array in images.items():
            if self.is_guided or name in ("color", "output"):
                oidn_filter.set_image(name, array, OIDN_FORMAT_FLOAT3)
        oidn_filter.set_bool("hdr", True)
        if self.is_guided:
            oidn_filter.set_bool("cleanAux", True)
        oidn_filter.set_quality(_QUALITIES[self.quality])
        oidn_filter.commit()
        self._check()
        return oidn_filter, images

    def _check(self) -> None:
        error = self._device.get_error()
        if error is not None:
            raise RuntimeError(f"OIDN failed: {error}")

    def close(self) -> None:
        """Release the native filters and the device."""
        for oidn_filter, _ in self._filters.values():
            oidn_filter.release()
        self._filters.clear()
        self._device.release()


class OptixDenoiser:
    """NVIDIA's OptiX denoiser in Mitsuba; requires the CUDA variant."""

    name = "optix"
    wants_camera_normals: ClassVar[bool] = True

    def __init__(self) -> None:
        self._denoisers: dict[tuple[int, int], Any] = {}

    def denoise(
        self, color: NDArray[np.float32], albedo: NDArray[np.float32], normal: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Denoise as in :class:`Denoiser`; clamp negative results to 0."""
        import mitsuba as mi

        height, width = color.shape[:2]
        if (height, width) not in self._denoisers:
            self._denoisers[height, width] = mi.OptixDenoiser(
                input_size=mi.ScalarVector2u(width, height), albedo=True, normals=True, temporal=False
            )
        result = self._denoisers[height, width](
            mi.TensorXf(np.ascontiguousarray(color, np.float32)),
            albedo=mi.TensorXf(np.ascontiguousarray(albedo, np.float32)),
            # Mitsuba's sensor frame: x to the left, y up, z forward
            normals=mi.TensorXf(np.ascontiguousarray(normal * np.array([-1, -1, 1], np.float32), np.float32)),
        )
        return np.maximum(np.array(result, dtype=np.float32)[..., :3], 0.0)


def uses_optix(variant: str) -> bool:
    """Return whether to denoise by OptiX: in CUDA variants, if the driver's denoiser weights are installed.

    Without them, OptiX aborts the process.
    """
    return variant.startswith("cuda") and (sys.platform == "win32" or OPTIX_WEIGHTS.is_file())


def make_denoiser(variant: str) -> OidnDenoiser | OptixDenoiser:
    """Create an OptiX denoiser if :func:`uses_optix` returns true for the Mitsuba variant, else OIDN."""
    return OptixDenoiser() if uses_optix(variant) else OidnDenoiser()
