# SPDX-License-Identifier: MIT
"""The state of an unfinished run, from which it resumes bit for bit, and batches with a non-finite loss.

``state.safetensors`` contains the weights and the optimiser's moments; its header contains the progress. All
random numbers of a step derive from (seed, phase, step, rank), so no generator's state has to be stored.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from pydantic import Field
from torch import Tensor, nn

from datagen.formats.base import (
    StrictModel,
    canonical_json,
    differences,
    parse_model,
    read_json,
    write_bytes_atomically,
)
from datagen.foundation.errors import InputError, Problem, input_error
from model.checkpoint import DataRecord
from model.training.config import TrainingConfig

STATE_FILE = "state.safetensors"
RUN_FILE = "run.json"
_KEY = "progress"
_REMEDY = "start the run again in another folder"


class RunRecord(StrictModel):
    """``run.json``: the inputs of a run. A run resumes only with the same inputs."""

    config: TrainingConfig
    folders: tuple[str, ...]
    data: tuple[DataRecord, ...]
    loss: str
    num_ranks: int


def check_same_run(path: Path, record: RunRecord) -> None:
    """Raise :class:`InputError` with all fields in which ``record`` differs from the record at ``path``."""
    earlier = read_json(RunRecord, path)
    if earlier == record:
        return
    remedy = "resume with the inputs of its start, or choose another --out"
    raise InputError(
        *(
            Problem(path, field, now, f"{then} as at its start", remedy)
            for field, then, now in differences(
                earlier.model_dump(mode="json"), record.model_dump(mode="json")
            )
            if ".assets" not in field  # the index, whose hash is compared, lists them
        )
    )


class RunProgress(StrictModel):
    """Progress of a run: index of the current phase, and completed steps in it and in all phases."""

    phase: int = Field(default=0, ge=0)
    step: int = Field(default=0, ge=0)
    total_step: int = Field(default=0, ge=0)
    best_score: float | None = None
    num_skipped: int = 0
    is_finished: bool = False

    def after_step(self, num_skipped: int) -> RunProgress:
        """Return the progress after one more step, which skipped ``num_skipped`` crops of bad views."""
        step, total_step, skipped = self.step + 1, self.total_step + 1, self.num_skipped + num_skipped
        return self.model_copy(update={"step": step, "total_step": total_step, "num_skipped": skipped})

    def after_phase(self) -> RunProgress:
        """Return the progress at the first step of the next phase."""
        return self.model_copy(update={"phase": self.phase + 1, "step": 0, "best_score": None})


class NonFiniteError(RuntimeError):
    """A loss, a gradient or an error on validation views is NaN or Inf; for the first two, the message names
    the file with the batch."""


def save_state(
    folder: Path,
    progress: RunProgress,
    module: nn.Module,
    optimizer: torch.optim.Optimizer | None,
    averages: Mapping[str, Tensor] | None = None,
) -> None:
    """Write the state of a run atomically; ``averages`` are the phase's averaged weights."""
    from safetensors.torch import save

    tensors = {f"module.{name}": value for name, value in module.state_dict().items()}
    tensors |= averages or {}
    if optimizer is not None:
        for index, state in optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    # copied, since safetensors refuses tensors that share memory, such as tied weights
    tensors = {name: value.detach().to("cpu", copy=True).contiguous() for name, value in tensors.items()}
    data = save(tensors, {_KEY: canonical_json(progress).decode()})
    write_bytes_atomically(folder / STATE_FILE, data)


def load_state(folder: Path) -> tuple[RunProgress, dict[str, Tensor]] | None:
    """Read the progress and the tensors by name of a run, or None if no state is saved.

    Raises :class:`InputError` for a damaged file.
    """
    from safetensors import SafetensorError, safe_open
    from safetensors.torch import load_file

    path = folder / STATE_FILE
    if not path.is_file():
        return None
    try:
        with safe_open(path, "pt") as file:
            text = (file.metadata() or {}).get(_KEY, "")
        progress = parse_model(RunProgress, json.loads(text), path)
        tensors = load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise input_error(path, "", f"unreadable: {error}", "the state of a run", _REMEDY) from None
    return progress, {name: value.clone() for name, value in tensors.items()}


def restore_module(module: nn.Module, tensors: Mapping[str, Tensor], where: Path) -> None:
    """Set a module's weights from a state's tensors. Raises :class:`InputError` if names or shapes differ."""
    weights = {n.removeprefix("module."): v for n, v in tensors.items() if n.startswith("module.")}
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        raise input_error(where, "", str(error).splitlines()[0], "this run's weights", _REMEDY) from None


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Set an optimiser's moments from a state's tensors."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".", 2)
            state.setdefault(int(index), {})[key] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def save_bad_batch(
    folder: Path, batch: Mapping[str, Tensor], parts: Mapping[str, float], step: int, rank: int
) -> Path:
    """Save a batch with a non-finite loss or gradient, and the loss's terms ``parts``; returns the path."""
    from safetensors.torch import save_file

    path = folder / f"bad_batch_step{step}_rank{rank}.safetensors"
    tensors = {name: value.detach().cpu().contiguous() for name, value in batch.items()}
    save_file(tensors, path, {"terms": json.dumps({name: repr(value) for name, value in parts.items()})})
    return path
