# SPDX-License-Identifier: MIT
"""Checkpoints: weights as safetensors, with metadata as JSON in the file's header and in a separate file.

``NAME.safetensors`` contains the tensors ``network.*`` and, once trained, ``confidence.*``; its
header and ``NAME.json`` contain the same :class:`CheckpointCard`. Nothing is pickled. Reading builds the
networks from the card (custom ones on the CPU, others on the meta device) and compares every name and shape
with the file before it reads values.
"""

from __future__ import annotations

import json
import platform
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from datagen.formats.base import StrictModel, canonical_json, parse_model, write_bytes_atomically
from datagen.foundation.errors import InputError, Problem, input_error
from model.bilateral_solver import SolverConfig
from model.confidence import ConfidenceNets
from model.networks import MaterialNetwork, NetworkConfig
from model.own_network import OwnNetwork, make_network

_CARD_KEY = "card"
_REMEDY = "train or fetch the checkpoint again"


class DataRecord(StrictModel):
    """Dataset used in training, identified by the hash of its index, which lists the hashes of its shards."""

    name: str
    index_sha256: str
    num_views: int = Field(ge=0)
    assets: dict[str, str] = {}
    """SHA-256 of every asset in the dataset's configurations, by asset id."""


class CheckpointCard(StrictModel):
    """Metadata of a checkpoint: architecture and provenance.

    ``loss`` names the loss's terms and its perceptual distance. The checkpoint was saved in ``phase``, after
    ``step`` steps of the run, with the validation ``metrics``; ``training`` is the resolved configuration.
    """

    format: Literal["scene-materials/checkpoint"] = "scene-materials/checkpoint"
    version: Literal[1] = 1
    network: NetworkConfig
    solver: SolverConfig = SolverConfig()
    has_confidence: bool = False
    loss: str
    phase: str
    step: int = Field(ge=0)
    metrics: dict[str, float] = {}
    data: tuple[DataRecord, ...] = ()
    training: dict[str, Any] = {}
    versions: dict[str, str] = {}


@dataclass(frozen=True)
class Checkpoint:
    """A loaded checkpoint with its networks in eval mode; ``confidence`` is None if untrained."""

    network: MaterialNetwork | OwnNetwork
    confidence: ConfidenceNets | None
    card: CheckpointCard


def software_versions() -> dict[str, str]:
    """Versions of the software that affects results, by name."""
    from importlib.metadata import version

    names = ("scene-materials", "numpy", "safetensors")
    return {"python": platform.python_version(), "torch": torch.__version__, **{n: version(n) for n in names}}


def bundled_checkpoint() -> Path:
    """Path of the bundled checkpoint; its model card is ``docs/model-card.md``."""
    return Path(__file__).parent / "checkpoints" / "small.safetensors"


def save_checkpoint(
    path: Path,
    card: CheckpointCard,
    network: MaterialNetwork | OwnNetwork,
    confidence: ConfidenceNets | None = None,
    dtype: torch.dtype = torch.float32,
) -> None:
    """Write weights in ``dtype`` to ``path`` (.safetensors), and the card as JSON next to it, atomically.

    Tensors with values beyond the range of ``dtype`` are written in float32.
    """
    from safetensors.torch import save

    card = card.model_copy(update={"has_confidence": confidence is not None})
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    if confidence is not None:
        tensors |= {f"confidence.{name}": value for name, value in confidence.state_dict().items()}
    tensors = {name: _stored(value, dtype) for name, value in tensors.items()}
    text = canonical_json(card)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes_atomically(path, save(tensors, {_CARD_KEY: text.decode()}))
    write_bytes_atomically(path.with_suffix(".json"), text)


def _stored(value: Tensor, dtype: torch.dtype) -> Tensor:
    """Copy a tensor for storage: safetensors refuses tensors that share memory, such as tied weights."""
    stored = value.detach().to("cpu", dtype, copy=True).contiguous()
    if dtype != torch.float32 and not bool(torch.isfinite(stored).all()):
        return _stored(value, torch.float32)
    return stored


def read_card(path: Path) -> CheckpointCard:
    """Read the card in a checkpoint's header. Raises :class:`InputError` if the file is not a checkpoint."""
    return _open(path)[0]


def _open(path: Path) -> tuple[CheckpointCard, dict[str, tuple[int, ...]]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise input_error(path, "", "no such file", "a checkpoint (.safetensors)", "check the path")
    try:
        with safe_open(path, "pt") as file:
            text = (file.metadata() or {}).get(_CARD_KEY)
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise input_error(path, "", f"unreadable: {error}", "a safetensors file", _REMEDY) from None
    if text is None:
        raise input_error(path, "header", "no card", "a checkpoint of this project", _REMEDY)
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise input_error(path, "card", str(error), "valid JSON", _REMEDY) from None
    return parse_model(CheckpointCard, data, path), shapes


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> Checkpoint:
    """Load a checkpoint's networks onto ``device``, in eval mode.

    Raises :class:`InputError` if the file is damaged, is not a checkpoint, is of another version, has tensors
    other than its configuration requires, or contains NaN or Inf.
    """
    from safetensors.torch import load_file

    card, shapes = _open(path)
    is_custom = card.network.factory is not None  # its constructor may read values, which meta tensors lack
    with torch.device("cpu" if is_custom else "meta"):
        modules: dict[str, nn.Module] = {"network": make_network(card.network)}
    with torch.device("meta"):
        if card.has_confidence:
            modules["confidence"] = ConfidenceNets()
    expected = {
        f"{prefix}.{name}": tuple(value.shape)
        for prefix, module in modules.items()
        for name, value in module.state_dict().items()
    }
    problems = [
        Problem(
            path, name, str(shapes.get(name, "missing")), str(expected.get(name, "no such tensor")), _REMEDY
        )
        for name in sorted(expected.keys() | shapes.keys())
        if expected.get(name) != shapes.get(name)
    ]
    if problems:
        raise InputError(*problems[:20])
    tensors = load_file(path, device=str(device))
    for name, value in tensors.items():
        if value.dtype not in (torch.float32, torch.float16) or not bool(torch.isfinite(value).all()):
            expected_values = "finite float32 or float16 values"
            raise input_error(path, name, f"{value.dtype}, NaN or Inf", expected_values, _REMEDY)
    for prefix, module in modules.items():
        # copied: tensors mapped from the file lack the alignment that convolutions need
        state = {
            n.removeprefix(f"{prefix}."): v.to(torch.float32, copy=True)
            for n, v in tensors.items()
            if n.startswith(prefix)
        }
        module.load_state_dict(state, assign=True)
        module.eval().requires_grad_(False)
    network, confidence = modules["network"], modules.get("confidence")
    assert isinstance(network, MaterialNetwork | OwnNetwork)
    assert confidence is None or isinstance(confidence, ConfidenceNets)
    return Checkpoint(network, confidence, card)
