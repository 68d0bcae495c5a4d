# SPDX-License-Identifier: MIT
"""Configuration of a training run: presets, files and flags.

Precedence is preset < file < flags. Unknown keys are errors. The resolved configuration is saved in the run's
folder before training starts.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, ValidationError, model_validator

from datagen.formats.base import StrictModel, problems_of
from datagen.formats.yaml_places import YamlPlaces, syntax_error
from datagen.foundation.errors import InputError, input_error
from model.bilateral_solver import SolverConfig
from model.networks import NetworkConfig, TrackName
from model.training.losses import LossConfig

_Decay = Annotated[float, Field(ge=0, lt=1)]
PRESETS = ("paper", "small", "light", "smoke")
PhaseName = Literal["diffuse", "specular", "joint", "confidence"]
BadViewPolicy = Literal["refuse", "skip"]
PHASE_TRACKS: dict[PhaseName, tuple[TrackName, ...]] = {
    "diffuse": ("diffuse",),
    "specular": ("specular",),
    "joint": ("diffuse", "specular"),
    "confidence": (),
}


class PhaseConfig(StrictModel):
    """A phase of the schedule: ``epochs`` passes over the data, or ``steps`` optimiser steps."""

    name: PhaseName
    epochs: int | None = Field(default=None, ge=1)
    steps: int | None = Field(default=None, ge=1)
    learning_rate: float | None = Field(default=None, gt=0)
    """Initial rate; None: the run's ``learning_rate``."""
    final_learning_rate: float | None = Field(default=None, gt=0)
    """Rate at the end of the phase; None: the run's ``final_learning_rate``."""

    @model_validator(mode="after")
    def _one_length(self) -> PhaseConfig:
        if (self.epochs is None) == (self.steps is None):
            raise ValueError("expected either epochs or steps")
        return self


class PerceptualConfig(StrictModel):
    """Perceptual distance: ``elpips`` needs VGG16's weights, ``gradient_ssim`` needs none."""

    kind: Literal["elpips", "gradient_ssim"] = "elpips"
    vgg: Path | None = None
    """File of VGG16's weights; None searches the weights folder and torch hub's cache."""
    heads: Path | None = None
    """File of E-LPIPS' 14 heads; None searches the weights folders and falls back to LPIPS' five heads."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of VGG16's activations."""


class DataConfig(StrictModel):
    """Options of the batches drawn from shards."""

    crop_px: int = Field(default=256, ge=16)
    crops_per_view: int = Field(default=7, ge=1)
    flips: bool = True
    exposure_jitter_stops: float = Field(default=0.5, ge=0, le=4)
    """Each crop's exposure is multiplied by 2^u, with u uniform between minus and plus this value."""
    spread_jitter_stops: float = Field(default=0.0, ge=0, le=4)
    """Each crop's ``color_min`` is divided, and its ``color_max`` multiplied, by 2^u with independent u
    uniform from 0 to this value, since noise and errors of cameras and geometry can only widen this range."""
    light_jitter_stops: float = Field(default=0.0, ge=0, le=4)
    """Each crop's reflectance and mirror buffers are multiplied by the same 2^u, with u uniform between minus
    and plus this value, since errors of geometry and exposure scale the recorded light."""
    noise: float = Field(default=0.0, ge=0, le=1)
    """Maximum standard deviation of a crop's Gaussian noise in ``beauty``, at an exposed radiance of 1. The
    deviation is proportional to the square root of radiance, like photon noise."""
    light_color_stops: float = Field(default=0.0, ge=0, le=4)
    """Each crop's colour channels are permuted at random, and its radiance is multiplied by 2^u per channel,
    with u uniform between minus and plus this value: colour channels of light transport are independent, so
    the result is consistent. 0 disables both."""
    block_views: int = Field(default=32, ge=1)
    """Crops are shuffled within blocks of this many views, which each loader process decodes once."""
    workers: int = Field(default=1, ge=0)
    """Loader processes per rank; 0 decodes in the training process."""
    in_memory: bool = False
    """Decode each view once per rank, into memory shared by its loader processes (about 70 bytes per pixel),
    instead of once per block. The batches are the same."""
    on_bad_view: BadViewPolicy = "refuse"
    """``refuse`` raises for an invalid view, ``skip`` excludes it from loss and validation, and counts its
    crops."""


class ValidationConfig(StrictModel):
    """Options of validation, which evaluates whole views."""

    num_views: int = Field(default=40, ge=0)
    """Maximum number of views of the validation split, evenly spaced; 0 turns validation off."""
    num_panels: int = Field(default=4, ge=0)
    """Number of views logged as image panels."""
    every_steps: int | None = Field(default=None, ge=1)
    """Interval of validations in steps; None: after each epoch."""


class TrainingConfig(StrictModel):
    """All options of a run that affect its result, except the path of the data and the device."""

    seed: int = Field(default=0, ge=0, lt=2**31)
    network: NetworkConfig = NetworkConfig()
    loss: LossConfig = LossConfig()
    perceptual: PerceptualConfig = PerceptualConfig()
    solver: SolverConfig = SolverConfig()
    data: DataConfig = DataConfig()
    phases: tuple[PhaseConfig, ...] = Field(min_length=1)
    batch_size: int = Field(default=8, ge=1)
    """Crops per rank and micro-batch; an optimiser step uses batch_size x accumulation x ranks."""
    accumulation: int = Field(default=1, ge=1)
    learning_rate: float = Field(default=2e-5, gt=0)
    final_learning_rate: float | None = Field(default=None, gt=0)
    """Learning rate at the end of each phase, reached by cosine annealing; None: constant rate."""
    adam_betas: tuple[_Decay, _Decay] = (0.5, 0.999)
    gradient_clip_norm: float | None = Field(default=None, gt=0)
    """Gradients with a larger norm, over all weights that a phase trains, are scaled down to it; None: no
    clipping. At a high rate, one steep batch can push outputs into the flat part of tanh, where gradients
    vanish."""
    average_decay: _Decay = 0.0
    """Validation and checkpoints use weights averaged over about the last 1 / (1 - average_decay) steps."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of the networks' activations; losses and weights stay float32."""
    channels_last: bool = False
    compile: bool = False
    validation: ValidationConfig = ValidationConfig()
    initial_checkpoint: Path | None = None
    """Start from the weights of this checkpoint. Its network must be the same, except that it may lack
    ``light_inputs``, whose weights then start at 0, and ``blends_reflectance``."""
    checkpoint_every_steps: int = Field(default=500, ge=1)
    log_every_steps: int = Field(default=10, ge=1)

    @model_validator(mode="after")
    def _phases_once(self) -> TrainingConfig:
        names = [phase.name for phase in self.phases]
        if len(set(names)) != len(names):
            raise ValueError("expected each phase at most once")
        if self.network.factory is not None and {"diffuse", "specular"} & set(names):
            raise ValueError("expected phases joint and confidence alone, as network.factory has no tracks")
        return self


def _layered(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of ``base``, overridden by the settings in ``over``.

    A custom network in ``over`` replaces all network settings of ``base`` and, unless ``over`` has phases, a
    phase ``joint`` with the settings of the first phase replaces the phases ``diffuse`` and ``specular``.
    """
    network = over.get("network")
    if isinstance(network, dict) and network.get("factory") is not None:
        base = {**base, "network": {}}
        if "phases" not in over:
            base["phases"] = _joined_phases(base.get("phases"))
    return _merge(base, over)


def _joined_phases(phases: Any) -> Any:
    if not isinstance(phases, list) or not all(isinstance(phase, dict) for phase in phases):
        return phases  # unchanged: the schema reports the fault
    rest = [phase for phase in phases if phase.get("name") not in ("diffuse", "specular")]
    if len(rest) < len(phases) and all(phase.get("name") != "joint" for phase in rest):
        rest.insert(0, {**phases[0], "name": "joint"})
    return rest


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = _merge(merged[key], value)
        else:
            merged[key] = value
    return merged


class _Loader(yaml.SafeLoader):
    """Safe YAML in which 1e-4 is a number, as in YAML 1.2; PyYAML reads it as text."""


_EXPONENT = re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+0123456789"))


def _parsed(text: str) -> Any:
    return _Loader(text).get_single_data()


def _read_mapping(path: Path) -> dict[str, Any]:
    try:
        data = _parsed(path.read_text(encoding="utf-8"))
    except OSError as error:
        got = (error.strerror or str(error)).lower()
        raise input_error(path, "", got, "a readable YAML file", "check the path") from None
    except (ValueError, yaml.YAMLError) as error:  # PyYAML raises ValueError for a date such as 2020-13-01
        where, got = syntax_error(path, error) if isinstance(error, yaml.YAMLError) else (path, str(error))
        raise input_error(where, "", got, "a readable YAML file", "correct the file") from None
    if not isinstance(data, dict):
        raise input_error(path, "", type(data).__name__, "keys and values", "see model/training/presets/")
    return data


def resolve_config(
    preset: str | None = None, file: Path | None = None, overrides: dict[str, Any] | None = None
) -> TrainingConfig:
    """Resolve the configuration of a preset (default ``paper``), a YAML file and nested ``overrides``; later
    ones take precedence.

    Raises :class:`InputError` for unknown keys and invalid values.
    """
    preset = preset or "paper"
    if preset not in PRESETS:
        raise input_error("--preset", "", preset, f"one of {', '.join(PRESETS)}", "correct it")
    data = _read_mapping(Path(__file__).parent / "presets" / f"{preset}.yaml")
    where: str | Path = f"preset {preset}"
    if file is not None:
        data, where = _layered(data, _read_mapping(file)), file
    if overrides:
        data, where = _layered(data, overrides), f"{where} with the given options"
    try:
        return TrainingConfig.model_validate(data)
    except ValidationError as error:
        if isinstance(where, Path):
            raise InputError(*problems_of(YamlPlaces(where, where.read_text("utf-8")), error)) from None
        raise InputError(*problems_of(where, error)) from None


def parse_overrides(items: list[str]) -> dict[str, Any]:
    """Parse items such as ``["batch_size=4", "data.workers=2"]``, with YAML values, to nested dictionaries.

    Raises :class:`InputError` for an item of invalid form.
    """
    result: dict[str, Any] = {}
    for item in items:
        key, separator, text = item.partition("=")
        if not separator or not all(key.split(".")):
            raise input_error("--set", "", item, "KEY=VALUE, such as data.workers=2", "write it in this form")
        try:
            value = _parsed(text)
        except (yaml.YAMLError, ValueError) as error:
            raise input_error("--set", key, str(error), "a YAML value") from None
        nested: dict[str, Any] = {key.split(".")[-1]: value}
        for part in reversed(key.split(".")[:-1]):
            nested = {part: nested}
        result = _merge(result, nested)
    return result
