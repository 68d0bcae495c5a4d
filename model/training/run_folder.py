# SPDX-License-Identifier: MIT
"""The folder of a run: its record, its state, the best weights of each phase, and the final weights.

A run resumes bit for bit from its state. ``state.safetensors`` contains the weights and the optimiser's
moments; its header contains the progress. All random numbers of a step derive from (seed, phase, step, rank),
so no generator's state has to be stored.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from model.checkpoint import CheckpointCard, DataRecord, load_checkpoint, save_checkpoint, software_versions
from model.training.config import PhaseName, TrainingConfig
from model.training.context import TrainingContext
from model.training.phases import Phase

STATE_FILE = "state.safetensors"
RUN_FILE = "run.json"
_KEY = "progress"
_REMEDY = "start the run again in another folder"
FINAL_FILE = "final.safetensors"


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
    remedy = "resume with the same inputs, or choose another --out"
    raise InputError(
        *(
            Problem(path, field, now, f"{then}, as when the run started", remedy)
            for field, then, now in differences(
                earlier.model_dump(mode="json"), record.model_dump(mode="json")
            )
            if ".assets" not in field  # listed in the index, whose hash is compared
        )
    )


class RunProgress(StrictModel):
    """Progress of a run: index of the current phase, completed steps in it and in all phases, its best
    validation score, and the number of skipped crops."""

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
    """Exception for a loss, a gradient or a validation metric that is NaN or Inf; except for a metric, the
    message names the file with the batch."""


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


@dataclass(frozen=True)
class RunFolder:
    """A run's folder: ``run.json`` (inputs of the run), ``state.safetensors`` (its progress),
    ``best-<phase>.safetensors`` and ``final.safetensors``.

    All ranks must call each method unless stated otherwise; only the first rank writes.
    """

    path: Path
    context: TrainingContext

    @property
    def final(self) -> Path:
        """Path of the file of the final weights."""
        return self.path / FINAL_FILE

    def open(self, data: Sequence[Path]) -> tuple[RunProgress, dict[str, Tensor]]:
        """Create the folder of a new run on the dataset folders ``data``, or resume the run in it.

        Returns the progress and the tensors of the saved state (none for a new run), whose weights are
        already restored. Raises :class:`InputError` if the folder contains anything other than this run.
        """
        context = self.context
        record = RunRecord(
            config=context.config,
            folders=tuple(str(Path(folder).resolve()) for folder in data),
            data=context.data.records,
            loss=context.loss.name,
            num_ranks=context.ranks.count,
        )
        path = self.path / RUN_FILE
        if path.is_file():
            check_same_run(path, record)
        elif context.ranks.is_first:
            self.path.mkdir(parents=True, exist_ok=True)
            if any(not entry.name.startswith(".") for entry in self.path.iterdir()):
                expected = "a new or empty folder, or one of an earlier run"
                raise input_error(self.path, "--out", "a folder with other files", expected, "choose another")
            write_bytes_atomically(path, canonical_json(record))
        context.ranks.barrier()
        state = load_state(self.path)
        if state is None:
            return RunProgress(), {}
        restore_module(context.models, state[1], self.path)
        return state

    def save(self, progress: RunProgress, phase: Phase | None = None) -> None:
        """Write the state of the run during ``phase``, or between phases (None)."""
        if self.context.ranks.is_first:
            optimizer, average = (phase.optimizer, phase.average) if phase else (None, None)
            averages = average.tensors() if average else {}
            save_state(self.path, progress, self.context.models, optimizer, averages)
        self.context.ranks.barrier()

    def save_best(self, phase: PhaseName, step: int, metrics: dict[str, float]) -> None:
        """Write the best weights of a phase so far; called by the first rank only."""
        self._save_checkpoint(f"best-{phase}.safetensors", phase, step, metrics)

    def save_final(self, step: int, metrics: dict[str, float]) -> None:
        """Write the final weights; called by the first rank only."""
        self._save_checkpoint(FINAL_FILE, self.context.config.phases[-1].name, step, metrics)

    def _save_checkpoint(self, file: str, phase: PhaseName, step: int, metrics: dict[str, float]) -> None:
        context, config = self.context, self.context.config
        names = [p.name for p in config.phases]
        card = CheckpointCard(
            network=config.network,
            solver=config.solver,
            loss=context.loss.name,
            phase=phase,
            step=step,
            metrics=metrics,
            data=(*(r for r in context.inherited if r not in context.data.records), *context.data.records),
            training=config.model_dump(mode="json"),
            versions=software_versions(),
        )
        has_confidence = "confidence" in names[: names.index(phase) + 1]
        confidence = context.models.confidence if has_confidence else None
        save_checkpoint(self.path / file, card, context.models.network, confidence)

    def load_best(self, phase: PhaseName) -> None:
        """Load the best weights of a phase into the models."""
        models = self.context.models
        best = load_checkpoint(self.path / f"best-{phase}.safetensors", self.context.device)
        models.network.load_state_dict(best.network.state_dict())
        if best.confidence is not None:
            models.confidence.load_state_dict(best.confidence.state_dict())
