# SPDX-License-Identifier: MIT
"""Parsing of the option ``--device``."""

from __future__ import annotations

import torch

from datagen.foundation.errors import input_error


def parse_device(text: str) -> torch.device:
    """Return the torch device with the name ``text``: ``cpu``, ``cuda`` or ``cuda:N``.

    Raises :class:`InputError` for other names, and for a GPU that is not available to torch.
    """
    kind, separator, number = text.partition(":")
    if kind not in ("cpu", "cuda") or (separator and not number.isdigit()):
        raise input_error("--device", "", repr(text), "cpu, cuda or cuda:1", "correct it")
    if kind == "cuda" and int(number or 0) >= torch.cuda.device_count():
        remedy = "use --device cpu, or install a torch that is built for CUDA (see `datagen doctor`)"
        got = f"{text}: {torch.cuda.device_count()} GPUs are found"
        raise input_error("--device", "", got, "a GPU of this machine", remedy)
    return torch.device(text)
