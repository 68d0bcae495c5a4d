# SPDX-License-Identifier: MIT
"""Custom networks in place of the two tracks: ``package.module:Class``.

The class is a ``torch.nn.Module`` with ``inputs``, a tuple of names from :data:`~model.networks.INPUTS`.
``forward`` takes a dictionary of these inputs, encoded to [-1, 1], (B, C, H, W) of any H and W, and returns
the three maps by name: ``diffuse_albedo`` and ``specular_albedo`` (B, 3, H, W), ``roughness`` (B, 1, H, W),
all in [0, 1]. The configuration's ``arguments`` are passed to the constructor. docs/howto/network.md has an
example.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from datagen.foundation.errors import input_error
from model.named_code import load_named
from model.networks import (
    INPUTS,
    TRACK_OUTPUTS,
    MaterialNetwork,
    NetworkConfig,
    TrackName,
    encode_input,
    input_channels,
    track_inputs,
)

OUTPUTS = {name: channels for outputs in TRACK_OUTPUTS.values() for name, channels in outputs.items()}
_TRIAL_SIZE = (23, 38)  # not a multiple of any stride


class OwnNetwork(nn.Module):
    """A custom network with the interface of :class:`~model.networks.MaterialNetwork`.

    Raises :class:`InputError` for an invalid class or invalid arguments.
    """

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        made, self.inputs = _class_of(config)
        try:
            self.module = made(**config.arguments)
        except TypeError as error:
            expected = f"arguments of {config.factory}"
            raise input_error("network", "arguments", str(error), expected, "correct it") from None

    def parts(self) -> dict[str, nn.Module]:
        """The single module, by the name of its class."""
        return {str(self.config.factory): self.module}

    def trained(self, tracks: tuple[TrackName, ...]) -> list[nn.Module]:
        """The whole module, which every phase trains."""
        return [self.module]

    def forward(
        self,
        buffers: Mapping[str, Tensor],
        exposure: Tensor,
        depth_max_m: Tensor | None = None,
        tracks: tuple[TrackName, ...] = ("diffuse", "specular"),
    ) -> dict[str, Tensor]:
        """Predicted maps (B, 3 or 1, H, W) by name, for the outputs of ``tracks``.

        Raises :class:`InputError` if the module returns maps of other names or shapes.
        """
        shaped = exposure.reshape(-1, 1, 1, 1)
        inputs = {name: encode_input(name, buffers, shaped, depth_max_m) for name in self.inputs}
        maps = self.module(inputs)
        batch, _, height, width = buffers["beauty"].shape
        expected = {name: (batch, channels, height, width) for name, channels in OUTPUTS.items()}
        got = (
            {name: tuple(value.shape) for name, value in maps.items()} if isinstance(maps, Mapping) else maps
        )
        if got != expected:
            raise input_error("network", self.config.factory or "", got, f"maps of {expected}")
        return {name: maps[name].float() for track in tracks for name in TRACK_OUTPUTS[track]}


def make_network(config: NetworkConfig) -> MaterialNetwork | OwnNetwork:
    """Construct the network of a configuration. Raises :class:`InputError` for an invalid ``factory``."""
    return MaterialNetwork(config) if config.factory is None else OwnNetwork(config)


def network_inputs(config: NetworkConfig) -> tuple[str, ...]:
    """Names of all inputs of a configuration's network."""
    if config.factory is None:
        return tuple(dict.fromkeys(n for track in TRACK_OUTPUTS for n in track_inputs(track, config)))
    return _class_of(config)[1]


@torch.no_grad()
def try_network(network: OwnNetwork) -> None:
    """Run a network once on grey inputs of 23 x 38 pixels.

    Raises :class:`InputError` if it has no parameters, or the outputs are not the three maps in [0, 1].
    """
    if not any(True for _ in network.parameters()):
        raise input_error("network", network.config.factory or "", "no parameters", "weights to train")
    buffers = {name: torch.full((1, input_channels(name), *_TRIAL_SIZE), 0.5) for name in INPUTS}
    buffers["depth_z_m"] = torch.ones(1, 1, *_TRIAL_SIZE)
    was_training = network.training
    maps = network.eval()(buffers, torch.ones(1), torch.ones(1))
    network.train(was_training)
    for name, value in maps.items():
        if not bool(((value >= 0) & (value <= 1)).all()):
            low, high = float(value.min()), float(value.max())
            where = f"{network.config.factory}: {name}"
            got = f"{low:.3g} to {high:.3g}"
            raise input_error("network", where, got, "values in [0, 1]", "end with a sigmoid")


def _class_of(config: NetworkConfig) -> tuple[type[nn.Module], tuple[str, ...]]:
    """Import the class named by ``factory``; return it with the names of its inputs.

    Raises :class:`InputError` if it is not a ``torch.nn.Module`` or its ``inputs`` are invalid.
    """
    name = config.factory or ""
    expected = "MODULE:CLASS of a torch.nn.Module with `inputs`"
    try:
        found = load_named(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise input_error("network", "factory", f"{name} ({error})", expected, "correct it") from None
    if not (isinstance(found, type) and issubclass(found, nn.Module)):
        raise input_error("network", "factory", f"{name}, not a class of networks", expected, "correct it")
    inputs = getattr(found, "inputs", None)
    if not (isinstance(inputs, tuple | list) and inputs and set(inputs) <= set(INPUTS)):
        names = f"some of {', '.join(INPUTS)}"
        raise input_error("network", f"{name}.inputs", repr(inputs), names, "correct it")
    return found, tuple(inputs)
