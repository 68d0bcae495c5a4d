# SPDX-License-Identifier: MIT
"""The folder of a run: its record, its state, the best weights of each phase, and the final weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from datagen.formats.base import canonical_json, write_bytes_atomically
from datagen.foundation.errors import input_error
from model.checkpoint import CheckpointCard, load_checkpoint, save_checkpoint, software_versions
from model.training.config import PhaseName
from model.training.context import TrainingContext
from model.training.phases import Phase
from model.training.run_state import (
    RUN_FILE,
    RunProgress,
    RunRecord,
    check_same_run,
    load_state,
    restore_module,
    save_state,
)

FINAL_FILE = "final.safetensors"


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
