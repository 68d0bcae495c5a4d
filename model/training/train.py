# SPDX-License-Identifier: MIT
"""The training loop: phases diffuse, specular, joint and confidence over one order of crops.

A run lives in one folder: ``run.json`` (what it was started with), ``state.safetensors`` (where it stands),
``best-<phase>.safetensors`` (each phase's best by validation, from which the next starts),
``final.safetensors``, ``log.csv`` and ``tensorboard/``. Interrupted, it continues bit for bit on the same
machine. Under ``torchrun`` each process is a rank and the ranks share every step.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from datagen.formats.base import canonical_json, write_bytes_atomically
from datagen.foundation.errors import InputError, Problem, input_error
from model.checkpoint import CheckpointCard, load_checkpoint, save_checkpoint, software_versions
from model.events import Event, Listeners
from model.training.conditions import generator_for
from model.training.config import PHASE_TRACKS, TrainingConfig
from model.training.dataset import buffer_names
from model.training.losses import MaterialLoss
from model.training.perceptual import make_perceptual
from model.training.phases import Models, Phase, Ranks, Workshop
from model.training.run_log import RunLog, progress_bar, view_panel
from model.training.run_state import (
    RUN_FILE,
    NonFiniteError,
    RunProgress,
    RunRecord,
    check_same_run,
    load_state,
    restore_module,
    restore_optimizer,
    save_bad_batch,
    save_state,
)
from model.training.sources import TrainingData, open_data, spread
from model.training.stopwatch import Stopwatch
from model.training.validation import evaluate, filtered_predictor, network_predictor, score_of, whole_views

_STEP_PURPOSE, _INIT_PURPOSE = 0x57, 0x11
FINAL_FILE = "final.safetensors"


class Trainer:
    """One run, from an empty or an interrupted folder to ``final.safetensors``."""

    def __init__(
        self,
        config: TrainingConfig,
        folders: list[Path],
        out: Path,
        *,
        device: torch.device | None = None,
        show_progress: bool = False,
        listeners: Listeners | None = None,
    ):
        self.config, self.folders, self.out = config, folders, out
        self.listeners = listeners or Listeners()
        self.ranks = Ranks()
        self.device = device or default_device(self.ranks.local_index)
        self.show_progress = show_progress and self.ranks.is_first
        self.data: TrainingData = open_data(folders, config.network, config.data.crop_px)
        perceptual = None
        if config.loss.perceptual_weight > 0:
            chosen = config.perceptual
            perceptual = make_perceptual(chosen.kind, chosen.vgg, chosen.heads, chosen.precision)
        self.loss = MaterialLoss(config.loss, perceptual).to(self.device)
        self.models = self._make_models()
        self.progress = RunProgress()
        self.shop = Workshop(config, self.data, self.models, self.loss, self.device, self.ranks, Stopwatch())
        self.stop_requested = False
        count = config.validation.num_views
        self.validation_views = spread(self.data.validation, count) if count else []

    def _make_models(self) -> Models:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(generator_for(self.config.seed, _INIT_PURPOSE).initial_seed()))
            models = Models(self.config)
        if self.config.initial_checkpoint is not None:
            first = load_checkpoint(self.config.initial_checkpoint)
            if first.card.network != self.config.network:
                raise input_error(
                    self.config.initial_checkpoint, "network", first.card.network, f"{self.config.network}"
                )
            models.network.load_state_dict(first.network.state_dict())
            if first.confidence is not None:
                models.confidence.load_state_dict(first.confidence.state_dict())
        models.to(self.device)
        if self.config.channels_last:
            models.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if self.config.compile:
            for track in models.network.tracks.values():
                track.compile()
        return models

    # --- the run ------------------------------------------------------------------------------------------

    def run(self) -> Path:
        """Train to the end and return the final checkpoint's path.

        Raises ``KeyboardInterrupt`` after saving where SIGINT or SIGTERM asked to stop, and
        :class:`NonFiniteError` where the loss or a gradient is no number.
        """
        restored = self._open_folder()
        if self.progress.is_finished:
            return self.out / FINAL_FILE
        step = self.progress.total_step
        log = RunLog(self.out, step, listeners=self.listeners) if self.ranks.is_first else None
        phases_left = range(self.progress.phase, len(self.config.phases))
        try:
            with _stop_signals(self._request_stop):
                for index in phases_left:
                    self._run_phase(index, restored, log)
                    restored = None
        finally:
            if log is not None:
                log.close()
        self.progress = self.progress.model_copy(update={"is_finished": True})
        if self.ranks.is_first:
            metrics = self._validate(None, self.config.phases[-1].name, None)
            self._save_checkpoint(FINAL_FILE, self.config.phases[-1].name, metrics)
            save_state(self.out, self.progress, self.models, None)
            self.listeners.tell(Event("train", "end", self.out, step=self.progress.total_step))
        self.ranks.barrier()
        return self.out / FINAL_FILE

    def _open_folder(self) -> dict[str, Tensor] | None:
        """Start a new run's folder, or check that it belongs to this run and load its state."""
        folders = tuple(str(Path(f).resolve()) for f in self.folders)
        record = RunRecord(
            config=self.config,
            folders=folders,
            data=self.data.records,
            loss=self.loss.name,
            num_ranks=self.ranks.count,
        )
        path = self.out / RUN_FILE
        if path.is_file():
            check_same_run(path, record)
        elif self.ranks.is_first:
            self.out.mkdir(parents=True, exist_ok=True)
            if any(not entry.name.startswith(".") for entry in self.out.iterdir()):
                expected = "a new or empty folder, or one of an earlier run"
                raise input_error(self.out, "--out", "a folder with other files", expected, "choose another")
            write_bytes_atomically(path, canonical_json(record))
        self.ranks.barrier()
        state = load_state(self.out)
        if state is None:
            return None
        self.progress, tensors = state
        restore_module(self.models, tensors, self.out)
        return tensors

    def _run_phase(self, index: int, restored: dict[str, Tensor] | None, log: RunLog | None) -> None:
        phase = Phase(self.shop, index)
        if restored is not None and self.progress.step > 0:
            restore_optimizer(phase.optimizer, restored)
        config = self.config
        total = sum(self.shop.num_steps(i) for i in range(len(config.phases)))
        batches = phase.loader(self.progress.step)
        with progress_bar(total, self.progress.total_step, shown=self.show_progress) as advance:
            while self.progress.step < phase.num_steps:
                started = time.perf_counter()
                values = self._step(phase, batches)
                elapsed = time.perf_counter() - started
                step = self.progress.step + 1
                self.progress = self.progress.model_copy(
                    update={
                        "step": step,
                        "total_step": self.progress.total_step + 1,
                        "num_skipped": self.progress.num_skipped + round(values.pop("num_skipped")),
                    }
                )
                name = phase.config.name
                crops = config.batch_size * config.accumulation * self.ranks.count
                waited = values.pop("data_wait_s")
                speed = {"crops_per_s": crops / elapsed, "data_wait_share": waited / elapsed}
                text = f"{name} loss {values['total']:.4f}, {speed['crops_per_s']:.1f} crops/s"
                if self.progress.num_skipped:
                    text += f", {self.progress.num_skipped} crops of bad views skipped"
                advance(self.progress.total_step, text)
                epoch = (step - 1) // phase.steps_per_epoch
                is_last = step == phase.num_steps
                if log is not None and (step % config.log_every_steps == 0 or is_last):
                    log.scalars(self.progress.total_step, name, epoch, "train", values)
                    log.scalars(self.progress.total_step, name, epoch, "speed", speed)
                every = config.validation.every_steps
                if is_last or step % phase.steps_per_epoch == 0 or (every is not None and step % every == 0):
                    self._validate_and_keep_best(phase, epoch, log)
                stop = self._must_stop()
                if step % config.checkpoint_every_steps == 0 or stop:
                    self._save(phase, log)
                if stop:
                    raise KeyboardInterrupt
        self._finish_phase(phase)

    def _step(self, phase: Phase, batches: Iterator[dict[str, Tensor]]) -> dict[str, float]:
        """One optimiser step; returns the loss's terms, averaged over micro-batches and ranks."""
        config, watch = self.config, self.shop.stopwatch
        sums: dict[str, Tensor] = {}
        waited = 0.0
        for group in phase.optimizer.param_groups:
            group["lr"] = phase.learning_rate(self.progress.step)
        phase.optimizer.zero_grad(set_to_none=True)
        batch: dict[str, Tensor] = {}
        for micro in range(config.accumulation):
            begin = time.perf_counter()
            with watch.section("data"):
                batch = _next_batch(batches)
            waited += time.perf_counter() - begin
            with watch.section("transfer"):
                batch = {name: value.to(self.device, non_blocking=True) for name, value in batch.items()}
            key = (config.seed, _STEP_PURPOSE, phase.index, self.progress.step, micro, self.ranks.index)
            generator = generator_for(*key)
            torch.manual_seed(int(torch.randint(0, 2**62, (1,), generator=generator)))  # of dropout
            is_last = micro == config.accumulation - 1
            with _gradient_sync(phase.module, is_last):
                terms = phase.terms(batch, generator)
                with watch.section("backward"):
                    (terms.total / config.accumulation).backward()
            parts = {
                "total": terms.total,
                **terms.parts,
                "num_skipped": batch["is_skipped"].sum() * self.ranks.count,
            }
            for name, value in parts.items():
                scaled = value.detach().float() / (1 if name == "num_skipped" else config.accumulation)
                sums[name] = sums.get(name, torch.zeros_like(scaled)) + scaled
        with watch.section("optimizer"):
            norm = torch.nn.utils.get_total_norm([p.grad for p in phase.parameters if p.grad is not None])
            sums["gradient_norm"] = norm
            values = self.ranks.mean(sums)
            if not all(torch.isfinite(torch.tensor([values["total"], values["gradient_norm"]]))):
                self._stop_on_non_finite(phase, batch, values)
            if config.gradient_clip_norm is not None:
                torch.nn.utils.clip_grads_with_norm_(phase.parameters, config.gradient_clip_norm, norm)
            phase.optimizer.step()
        values["data_wait_s"] = waited
        return values

    def _stop_on_non_finite(self, phase: Phase, batch: dict[str, Tensor], values: dict[str, float]) -> None:
        step = self.progress.total_step
        path = save_bad_batch(self.out, batch, values, step, self.ranks.index)
        what = ", ".join(f"{name} = {value:.4g}" for name, value in values.items())
        raise NonFiniteError(f"{phase.config.name}, step {step}: {what}; the batch is in {path}")

    # --- validation, checkpoints --------------------------------------------------------------------------

    def _validate(self, phase: Phase | None, name: str, log: RunLog | None) -> dict[str, float]:
        """Errors on the validation views: of the active maps in a phase, of all maps at the end."""
        if not self.validation_views:
            return {}
        config, network = self.config, self.models.network
        names = buffer_names(config.network)
        tracks = PHASE_TRACKS[phase.config.name] if phase is not None else ()
        predict = network_predictor(network, tracks or ("diffuse", "specular"), config.precision)
        if phase is not None and not tracks:
            predict = filtered_predictor(predict, self.models.confidence, config.solver)
        metrics = evaluate(predict, whole_views(self.validation_views, names, self.device))
        if phase is None and name == "confidence":
            filtered = filtered_predictor(predict, self.models.confidence, config.solver)
            after = evaluate(filtered, whole_views(self.validation_views, names, self.device))
            metrics |= {f"filtered_{key}": value for key, value in after.items()}
        if log is not None:
            shown = spread(self.validation_views, config.validation.num_panels)
            for index, batch in enumerate(whole_views(shown, names, self.device)):
                with torch.no_grad():
                    panel = view_panel(batch, predict(batch))
                log.panel(self.progress.total_step, f"{name}/view{index}", panel)
        return metrics

    def _validate_and_keep_best(self, phase: Phase, epoch: int, log: RunLog | None) -> None:
        if self.ranks.is_first:
            name = phase.config.name
            metrics = self._validate(phase, name, log)
            best = self.progress.best_score
            score = score_of(metrics) if metrics else None
            if score is None or best is None or score < best:
                self._save_checkpoint(f"best-{name}.safetensors", name, metrics)
                best = score
            if log is not None and score is not None:
                figures = {**metrics, "score": score}
                log.scalars(self.progress.total_step, name, epoch, "validation", figures)
                log.flush()
            self.progress = self.progress.model_copy(update={"best_score": best})
        self.ranks.barrier()

    def _save_checkpoint(self, file: str, phase: str, metrics: dict[str, float]) -> None:
        names = [p.name for p in self.config.phases]
        has_confidence = "confidence" in names[: names.index(phase) + 1]  # type: ignore[arg-type]
        card = CheckpointCard(
            network=self.config.network,
            solver=self.config.solver,
            loss=self.loss.name,
            phase=phase,
            step=self.progress.total_step,
            metrics=metrics,
            data=self.data.records,
            training=self.config.model_dump(mode="json"),
            versions=software_versions(),
        )
        confidence = self.models.confidence if has_confidence else None
        save_checkpoint(self.out / file, card, self.models.network, confidence)

    def _save(self, phase: Phase | None, log: RunLog | None) -> None:
        if log is not None:
            log.flush()
        if self.ranks.is_first:
            save_state(self.out, self.progress, self.models, phase.optimizer if phase else None)
        self.ranks.barrier()

    def _finish_phase(self, phase: Phase) -> None:
        """Go on from the phase's best weights, and record that it is over."""
        best = load_checkpoint(self.out / f"best-{phase.config.name}.safetensors", self.device)
        with torch.no_grad():
            for ours, theirs in (
                (self.models.network, best.network),
                (self.models.confidence, best.confidence),
            ):
                if theirs is not None:
                    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
                        mine.copy_(other)
        update = {"phase": phase.index + 1, "step": 0, "best_score": None}
        self.progress = self.progress.model_copy(update=update)
        self._save(None, None)

    # --- stopping -----------------------------------------------------------------------------------------

    def _request_stop(self) -> None:
        self.stop_requested = True

    def _must_stop(self) -> bool:
        if self.ranks.count == 1:
            return self.stop_requested
        flag = torch.tensor(float(self.stop_requested), device=self.device)
        return self.ranks.mean({"stop": flag})["stop"] > 0


def default_device(local_index: int = 0) -> torch.device:
    """The GPU of this rank where there is one, else the CPU."""
    return torch.device("cuda", local_index) if torch.cuda.is_available() else torch.device("cpu")


def _next_batch(batches: Iterator[dict[str, Tensor]]) -> dict[str, Tensor]:
    """The next batch; a loader process's error comes back without its traceback."""
    try:
        return next(batches)
    except InputError as error:
        text = str(error)
        marker = "datagen.foundation.errors.InputError: "
        if marker in text:
            where, _, rest = text.rsplit(marker, 1)[1].strip().partition(": ")
            raise InputError(Problem(where, got=rest)) from None
        raise


def _gradient_sync(module: nn.Module, is_last: bool) -> AbstractContextManager[Any]:
    """Ranks exchange gradients only in the last micro-batch of a step."""
    if isinstance(module, DistributedDataParallel) and not is_last:
        return module.no_sync()
    return nullcontext()


@contextmanager
def _stop_signals(request: Callable[[], None]) -> Iterator[None]:
    """SIGINT and SIGTERM ask for a stop after the current step; a second SIGINT stops at once."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    try:
        earlier = {number: signal.getsignal(number) for number in numbers}

        def handle(number: int, frame: Any) -> None:
            request()
            signal.signal(signal.SIGINT, earlier[signal.SIGINT])

        for number in numbers:
            signal.signal(number, handle)
    except ValueError:  # not the main thread: whoever runs the thread handles signals
        yield
        return
    try:
        yield
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)
