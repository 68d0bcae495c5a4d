# SPDX-License-Identifier: MIT
"""Exponential moving average of trained weights, which validation and checkpoints use."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

_WARM_UP = 10.0  # at first, the last tenth of the steps is averaged, almost without the initial weights


class WeightAverage:
    """Exponential moving average of ``parameters`` over about the last 1 / (1 - ``decay``) steps."""

    def __init__(self, parameters: Sequence[nn.Parameter], decay: float):
        self.parameters, self.decay = list(parameters), decay
        self.values = [parameter.detach().clone() for parameter in self.parameters]

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Update the averages with the current weights, those after step ``step`` (from 1)."""
        share = 1.0 - min(self.decay, step / (_WARM_UP + step))
        for value, parameter in zip(self.values, self.parameters, strict=True):
            value.lerp_(parameter, share)

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Replace the weights by their averages within the context."""
        trained = [parameter.detach().clone() for parameter in self.parameters]
        self._set(self.values)
        try:
            yield
        finally:
            self._set(trained)

    @torch.no_grad()
    def _set(self, values: Sequence[Tensor]) -> None:
        for parameter, value in zip(self.parameters, values, strict=True):
            parameter.copy_(value)

    def tensors(self) -> dict[str, Tensor]:
        """The averages by name, for the state of a run."""
        return {f"average.{index}": value for index, value in enumerate(self.values)}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Set the averages from the saved result of :meth:`tensors`."""
        for index, value in enumerate(self.values):
            value.copy_(tensors[f"average.{index}"])
