# SPDX-License-Identifier: MIT
"""Listeners that follow training and inference, for example to log them to wandb or rerun.

    materials train rooms --out run --listener my_hooks:to_wandb

A listener is a function that takes an :class:`Event`. It is called in the process that trains (rank 0 of
several) or infers, and should therefore return quickly. A listener that raises is reported on standard error
and not called again, so a lost connection does not end a long training run.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from datagen.foundation.errors import Problem, raise_problems
from model.named_code import load_named


@dataclass(frozen=True)
class Event:
    """An event of training or inference.

    The fields depend on ``kind``. ``scalars``: ``values`` are numbers by name at training step ``step``;
    ``name`` is ``train/PHASE``, ``validation/PHASE`` or ``speed/PHASE``. ``image``: ``image`` (H, W, 3) is
    uint8, with the title ``name``. ``progress``: ``step`` out of ``values["total"]`` steps of the inference
    stage ``name`` are done. ``end``: the run is finished and its result is in ``folder``.
    """

    source: Literal["train", "infer"]
    kind: Literal["scalars", "image", "progress", "end"]
    folder: Path
    name: str = ""
    step: int = 0
    values: Mapping[str, float] = field(default_factory=dict)
    image: Any = None


Listener = Callable[[Event], object]
ListenerOption = Annotated[
    list[str] | None,
    typer.Option("--listener", help="MODULE:FUNCTION that receives events of the run, repeatable."),
]


class Listeners:
    """The listeners of a run, possibly none."""

    def __init__(self, listeners: Iterable[Listener] = ()):
        self._listeners = list(listeners)

    def __bool__(self) -> bool:
        return bool(self._listeners)

    def tell(self, event: Event) -> None:
        """Call every listener with ``event``; a listener that raises is reported and removed."""
        for listener in list(self._listeners):
            try:
                listener(event)
            except Exception:
                self._listeners.remove(listener)
                name = getattr(listener, "__qualname__", repr(listener))
                print(f"listener {name} failed and is not called again:", file=sys.stderr)
                traceback.print_exc()


def load_listeners(names: Iterable[str]) -> Listeners:
    """Import listeners by name, ``MODULE:FUNCTION``; modules may be in the working directory.

    Raises :class:`InputError` with every name that cannot be imported or is not callable.
    """
    found: list[Listener] = []
    problems = []
    for name in names:
        try:
            listener = load_named(name)
        except (ImportError, AttributeError, ValueError) as error:
            problems.append(Problem("--listener", "", f"{name} ({error})", "MODULE:FUNCTION", "correct it"))
            continue
        if callable(listener):
            found.append(listener)
        else:
            problems.append(Problem("--listener", "", repr(name), "MODULE:FUNCTION", "correct it"))
    raise_problems(problems)
    return Listeners(found)
