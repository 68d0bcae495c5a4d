# SPDX-License-Identifier: MIT
"""Logs of a run: a CSV, TensorBoard scalars and image panels."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from datagen.formats.base import write_bytes_atomically
from datagen.foundation.buffers import MATERIAL_MAPS
from model.events import Event, Listeners
from model.networks import encode_color

CSV_FILE = "log.csv"
_COLUMNS = ("step", "phase", "epoch", "kind", "name", "value")


class RunLog:
    """Log of a run as CSV (one value per row) and for TensorBoard; existing rows after ``step`` are removed.

    ``listeners`` receive the same values and panels.
    """

    def __init__(
        self, folder: Path, step: int = 0, *, tensorboard: bool = True, listeners: Listeners | None = None
    ):
        self.folder, self.listeners = folder, listeners or Listeners()
        self.path = folder / CSV_FILE
        text = ",".join(_COLUMNS) + "\n"
        if step and self.path.is_file():
            _, *lines = self.path.read_text(encoding="utf-8").splitlines(keepends=True)
            # a killed run may have written half of a line
            text += "".join(row for row in lines if row.endswith("\n") and int(row.split(",")[0]) <= step)
        write_bytes_atomically(self.path, text.encode())
        self._file = self.path.open("a", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, _COLUMNS, lineterminator="\n")
        self._board: Any = None
        if tensorboard:
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1 if step else None)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def scalars(self, step: int, phase: str, epoch: int, kind: str, values: Mapping[str, float]) -> None:
        """Record scalar ``values`` by name; ``kind`` is ``train``, ``validation`` or ``speed``."""
        name = f"{kind}/{phase}"
        self.listeners.tell(Event("train", "scalars", self.folder, name, step, dict(values)))
        for name, value in values.items():
            cells = (step, phase, epoch, kind, name, repr(value))
            self._writer.writerow(dict(zip(_COLUMNS, cells, strict=True)))
            if self._board is not None:
                self._board.add_scalar(f"{kind}/{phase}/{name}", value, step)

    def panel(self, step: int, name: str, image: Tensor) -> None:
        """Record an ``image`` (3, H, W) in [0, 1] under ``name``."""
        if self.listeners:
            pixels = (255.0 * image.clamp(0, 1) + 0.5).byte().permute(1, 2, 0).cpu().numpy()
            self.listeners.tell(Event("train", "image", self.folder, name, step, image=pixels))
        if self._board is not None:
            self._board.add_image(name, image, step)

    def flush(self) -> None:
        """Write everything to disk."""
        self._file.flush()
        if self._board is not None:
            self._board.flush()

    def close(self) -> None:
        self.flush()
        self._file.close()
        if self._board is not None:
            self._board.close()


def view_panel(batch: Mapping[str, Tensor], predicted: Mapping[str, Tensor]) -> Tensor:
    """Panel (3, height, width) in [0, 1] of a batch's first view: a row with the input, then a row with
    prediction, truth and error of each map.

    Albedos are shown with gamma 2.2, roughness linearly, absolute errors times 2.
    """
    image = 0.5 * (encode_color(batch["beauty"], batch["exposure"].reshape(-1, 1, 1, 1))[0] + 1.0)
    rows = [torch.cat([image, torch.zeros_like(image), torch.zeros_like(image)], dim=2)]
    mask = batch["mask"][0].float()
    for name in MATERIAL_MAPS:
        if name not in predicted:
            continue
        ours, theirs = (m[name][0].float().clamp(0, 1) * mask for m in (predicted, batch))
        error = 2.0 * (ours - theirs).abs()
        shown = [t if name == "roughness" else t.pow(1 / 2.2) for t in (ours, theirs)]
        rows.append(torch.cat([t.expand(3, -1, -1) for t in (*shown, error)], dim=2))
    return torch.cat(rows, dim=1).clamp(0, 1).cpu()
