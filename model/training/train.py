# SPDX-License-Identifier: MIT
"""The training loop over a run's phases, such as diffuse, specular, joint and confidence.

A run has one folder (``run_folder``), with ``log.csv`` and ``tensorboard/``. After an interruption it resumes
bit for bit on the same machine. Under ``torchrun`` each process is a rank, and the ranks split every batch.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from datagen.foundation.progress import Bars
from model.events import Event, Listeners
from model.training.conditions import generator_for
from model.training.config import TrainingConfig
from model.training.context import make_context
from model.training.dataset import buffer_names
from model.training.phases import Phase
from model.training.run_folder import (
    NonFiniteError,
    RunFolder,
    RunProgress,
    restore_optimizer,
    save_bad_batch,
)
from model.training.run_log import RunLog
from model.training.sources import open_data, spread
from model.training.validation import final_metrics, phase_metrics, score_of, valid_views

_STEP_PURPOSE = 0x57


class Trainer:
    """Trains a run on dataset ``folders``; ``out`` is a new folder or the folder of an interrupted run."""

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
        self.config, self.folders = config, folders
        self.listeners = listeners or Listeners()
        self.data = open_data(folders, config.network, config.data.crop_px)
        self.context = make_context(config, self.data, device)
        self.ranks, self.models = self.context.ranks, self.context.models
        self.folder = RunFolder(out, self.context)
        self.progress = RunProgress()
        self.show_progress = show_progress and self.ranks.is_first
        self.stop_requested = False
        count = config.validation.num_views
        chosen = spread(self.data.validation, count) if count and self.ranks.is_first else []
        self.validation_views = valid_views(chosen, buffer_names(config.network), config.data.on_bad_view)

    def run(self) -> Path:
        """Train to the end and return the final checkpoint's path.

        Raises ``KeyboardInterrupt`` after saving when stopped by SIGINT or SIGTERM, and
        :class:`NonFiniteError` if the loss, a gradient or a validation metric is NaN or Inf.
        """
        config, context, folder = self.config, self.context, self.folder
        self.progress, restored = folder.open(self.folders)
        if self.progress.is_finished:
            return folder.final
        with ExitStack() as stack:
            log, tell = self._outputs(stack)
            stack.enter_context(stop_signals(self.request_stop))
            for index in range(self.progress.phase, len(config.phases)):
                phase = self._phase(index, restored)
                batches = phase.batches(self.progress.step)
                while self.progress.step < phase.num_steps:
                    with context.stopwatch.section("step"):
                        values = self.step(phase, batches)
                    self.progress = self.progress.after_step(round(values.pop("num_skipped")))
                    step, total_step = self.progress.step, self.progress.total_step
                    epoch, is_last = (step - 1) // phase.steps_per_epoch, step == phase.num_steps

                    speed = self._speed()
                    tell(self._note(phase, values, speed))
                    if log is not None and (step % config.log_every_steps == 0 or is_last):
                        log.scalars(total_step, phase.config.name, epoch, "train", values)
                        log.scalars(total_step, phase.config.name, epoch, "speed", speed)

                    every = config.validation.every_steps or phase.steps_per_epoch
                    if is_last or step % every == 0:
                        self._validate(phase, epoch, log)

                    stops = self._stops()
                    if step % config.checkpoint_every_steps == 0 or stops:
                        if log is not None:
                            log.flush()
                        folder.save(self.progress, phase)
                    if stops:
                        raise KeyboardInterrupt

                # the next phase starts from the best weights of this one
                folder.load_best(phase.config.name)
                self.progress = self.progress.after_phase()
                folder.save(self.progress)
        self._finish()
        return folder.final

    def _outputs(self, stack: ExitStack) -> tuple[RunLog | None, Callable[[str], None]]:
        """Open the log, on the first rank only, and the progress bar until ``stack`` is closed; returns the
        log, and a function that shows the step and a note.
        """
        log = None
        if self.ranks.is_first:
            log = RunLog(self.folder.path, self.progress.total_step, listeners=self.listeners)
            stack.enter_context(log)
        bars = stack.enter_context(Bars("steps", is_quiet=not self.show_progress))
        total = sum(self.context.num_steps(index) for index in range(len(self.config.phases)))
        bars.tell("train", self.progress.total_step, total)
        return log, lambda note: bars.tell("train", self.progress.total_step, total, note)

    def _phase(self, index: int, restored: dict[str, Tensor]) -> Phase:
        """Phase ``index``, with the ``restored`` state if some of its steps are done."""
        phase = Phase(self.context, index)
        if self.progress.step > 0:
            restore_optimizer(phase.optimizer, restored)
            if phase.average:
                phase.average.restore(restored)
        return phase

    def _finish(self) -> None:
        """Save the final checkpoint and the state, and send the event ``end`` to listeners."""
        self.progress = self.progress.model_copy(update={"is_finished": True})
        step = self.progress.total_step
        if self.ranks.is_first:
            self.folder.save_final(step, final_metrics(self.context, self.validation_views))
        self.folder.save(self.progress)
        if self.ranks.is_first:
            self.listeners.tell(Event("train", "end", self.folder.path, step=step))

    def step(self, phase: Phase, batches: Iterator[dict[str, Tensor]]) -> dict[str, float]:
        """Run one optimiser step; returns mean loss terms, the gradient norm and the number of skipped crops.

        Raises :class:`NonFiniteError` if the loss or a gradient is NaN or Inf.
        """
        config, context, watch = self.config, self.context, self.context.stopwatch
        sums: dict[str, Any] = {}
        loaded: list[dict[str, Tensor]] = []
        for group in phase.optimizer.param_groups:
            group["lr"] = phase.learning_rate(self.progress.step)
        phase.optimizer.zero_grad(set_to_none=True)

        for micro in range(config.accumulation):
            with watch.section("data"):
                loaded.append(next(batches))
            with watch.section("transfer"):
                batch = {n: value.to(context.device, non_blocking=True) for n, value in loaded[-1].items()}
            key = (config.seed, _STEP_PURPOSE, phase.index, self.progress.step, micro, self.ranks.index)
            generator = generator_for(*key)
            torch.manual_seed(int(torch.randint(0, 2**62, (1,), generator=generator)))  # seed of dropout
            with phase.gradient_sync(is_last=micro == config.accumulation - 1):
                terms = phase.terms(batch, generator)
                with watch.section("backward"):
                    (terms.total / config.accumulation).backward()
            for name, value in {"total": terms.total, **terms.parts}.items():
                sums[name] = sums.get(name, 0.0) + value.detach().float() / config.accumulation
            sums["num_skipped"] = sums.get("num_skipped", 0.0) + batch["is_skipped"].sum() * self.ranks.count

        with watch.section("optimizer"):
            norm = torch.nn.utils.get_total_norm([p.grad for p in phase.parameters if p.grad is not None])
            values = self.ranks.mean({**sums, "gradient_norm": norm})
            if not all(torch.isfinite(torch.tensor([values["total"], values["gradient_norm"]]))):
                self._stop_on_non_finite(phase, loaded, values)
            if config.gradient_clip_norm is not None:
                torch.nn.utils.clip_grads_with_norm_(phase.parameters, config.gradient_clip_norm, norm)
            phase.optimizer.step()
            if phase.average:
                phase.average.update(self.progress.step + 1)
        return values

    def _stop_on_non_finite(
        self, phase: Phase, loaded: list[dict[str, Tensor]], values: dict[str, float]
    ) -> None:
        step = self.progress.total_step
        batch = {name: torch.cat([micro[name] for micro in loaded]) for name in loaded[0]}
        path = save_bad_batch(self.folder.path, batch, values, step, self.ranks.index)
        terms = ", ".join(f"{name} = {value:.4g}" for name, value in values.items())
        raise NonFiniteError(f"{phase.config.name}, step {step}: {terms}; the batch is in {path}")

    def _speed(self) -> dict[str, float]:
        """Crops per second in the last step, and the share of the step's time spent waiting for data."""
        seconds = self.context.stopwatch.take()
        crops = self.config.batch_size * self.config.accumulation * self.ranks.count
        return {"crops_per_s": crops / seconds["step"], "data_wait_share": seconds["data"] / seconds["step"]}

    def _note(self, phase: Phase, values: dict[str, float], speed: dict[str, float]) -> str:
        text = f"{phase.config.name} loss {values['total']:.4f}, {speed['crops_per_s']:.1f} crops/s"
        skipped = self.progress.num_skipped
        return f"{text}, {skipped} crops of bad views skipped" if skipped else text

    def _validate(self, phase: Phase, epoch: int, log: RunLog | None) -> None:
        """Validate on the first rank, and save the weights if they are the phase's best so far."""
        if log is not None:
            name, step = phase.config.name, self.progress.total_step
            best = self.progress.best_score
            with phase.averaged_weights():
                metrics = phase_metrics(self.context, name, self.validation_views, log, step)
                score = score_of(metrics) if metrics else None
                if score is not None and not math.isfinite(score):
                    where = f"{name}, step {step}"
                    raise NonFiniteError(f"{where}: validation errors are not finite; reduce learning_rate")
                if score is None or best is None or score < best:
                    self.folder.save_best(name, step, metrics)
                    best = score
            if score is not None:
                log.scalars(step, name, epoch, "validation", {**metrics, "score": score})
                log.flush()
            self.progress = self.progress.model_copy(update={"best_score": best})
        self.ranks.barrier()

    def request_stop(self) -> None:
        """Request :meth:`run` to save the state and stop after the current step."""
        self.stop_requested = True

    def _stops(self) -> bool:
        """Return whether any rank received a request to stop."""
        if self.ranks.count == 1:
            return self.stop_requested
        flag = torch.tensor(float(self.stop_requested), device=self.context.device)
        return self.ranks.mean({"stop": flag})["stop"] > 0


@contextmanager
def stop_signals(request: Callable[[], None]) -> Iterator[None]:
    """Context in which SIGINT and SIGTERM call ``request``; a second SIGINT calls its previous handler."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    try:
        earlier = {number: signal.getsignal(number) for number in numbers}

        def handle(number: int, frame: Any) -> None:
            request()
            signal.signal(signal.SIGINT, earlier[signal.SIGINT])

        for number in numbers:
            signal.signal(number, handle)
    except ValueError:  # not in the main thread, the only one that can set signal handlers
        yield
        return
    try:
        yield
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)
