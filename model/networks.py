# SPDX-License-Identifier: MIT
"""The two tracks that predict materials: U-Nets with a global track (Deschaintre et al. 2018 and 2019).

Axes: images are (B, C, H, W), row 0 at the top. Inputs are selected from buffers by name and encoded to [-1,
1]; the diffuse track predicts D (3 channels), the specular track S (3) and R (1), all linear in [0, 1].

A level halves (encoder) or doubles (decoder) the resolution. Parallel to the convolutions, the global track
updates a vector g with the spatial mean of every layer before its normalisation, and adds a linear map of g
to the next layer. Padding would affect instance norms and means; with ``ignores_padding`` (the default, see
docs/decisions/0010), they are computed over the image without padding, and the padding is set to zero after
every convolution, so its size does not affect the result.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
import torch.nn.functional as F
from pydantic import Field, field_validator, model_validator
from torch import Tensor, nn

from datagen.formats.base import StrictModel
from datagen.foundation.buffers import LIGHT_BUFFERS

NUM_LEVELS = 4
STRIDE = 2**NUM_LEVELS
"""Inputs are padded at the bottom and the right to a multiple of this number of pixels."""
RECEPTIVE_FIELD_PX = 142
"""Maximum side of the square of input pixels that affect an output pixel through convolutions: 126 or 142,
depending on the pixel's position in its 16 x 16 block. Norms and the global track depend on all pixels."""
STRIP_ELEMENTS = 2**25
"""Inference applies the decoder's convolutions to strips of about this many upsampled values, since these
layers need the most memory. Norms and the global track are applied afterwards over the whole layer, so the
maps are the same up to rounding (docs/decisions/0054)."""
_STRIP_MARGIN = 3  # rows on either side of a strip's input that affect its result
_LEAK = 0.2
_NORM_EPS = 1e-5  # keeps the norm finite on a constant feature map
_LOG_EPSILON = 0.01

TrackName = Literal["diffuse", "specular"]
LightInput = Literal["reflectance", "known_share", "mirror_sharp", "mirror_broad"]
COLOR_STATISTICS = ("color_median", "color_max", "color_min")
INPUTS = ("beauty", *COLOR_STATISTICS, "normal_camera", "depth", *LIGHT_BUFFERS)
"""Names of all possible inputs of a network."""
MAX_REFLECTANCE = 2.0
"""Value at which the buffer ``reflectance`` is clipped; highlights and unseen lamps raise it above 1."""


class NetworkConfig(StrictModel):
    """Architecture of the two tracks. The defaults are from Prakash et al. 2022."""

    base_channels: int = Field(default=64, ge=1, le=512)
    """Channels of the first encoder layer; deeper ones have 2, 4 and 8 times as many."""
    global_channels: int = Field(default=128, ge=1, le=4096)
    """Number of components of the global track's vector."""
    wide_decoder: bool = False
    """Decoder layers have 8, 4, 2 times ``base_channels`` channels, as in the paper, instead of 4, 2, 1."""
    dropout: float = Field(default=0.5, ge=0.0, lt=1.0)
    """Dropout rate of the three inner decoder layers, off at inference."""
    ignores_padding: bool = True
    """Exclude the padding from instance norms, global means and convolutions."""
    uses_statistics: bool = True
    """Use the reprojected colour statistics as input; False: the paper's single-view ablation *No RP*."""
    light_inputs: tuple[LightInput, ...] = Field(default=(), exclude_if=lambda value: not value)
    """Buffers of recorded light that are inputs of both tracks; datasets contain them if their recipe has
    ``statistics: {light: true}``."""
    blends_reflectance: bool = Field(default=False, exclude_if=lambda value: not value)
    """Blend the predicted D with ``reflectance``, with a weight and a gain predicted per pixel: recorded
    reflectance has the texture's full resolution and, where the light is known, the right scale."""
    factory: str | None = Field(default=None, exclude_if=lambda value: value is None)
    """``package.module:Class`` of a custom network in place of the two tracks (model.own_network)."""
    arguments: dict[str, Any] = Field(default={}, exclude_if=lambda value: not value)
    """Keyword arguments of ``factory``."""

    @field_validator("arguments")
    @classmethod
    def _round_trip_json(cls, arguments: dict[str, Any]) -> dict[str, Any]:
        # checkpoints store them as JSON, in which a resumed run is also compared with its start
        try:
            is_same = json.loads(json.dumps(arguments, allow_nan=False)) == arguments
        except (TypeError, ValueError):
            is_same = False
        if not is_same:
            raise ValueError("expected text, finite numbers, true, false, null, lists, and keys of text")
        return arguments

    @model_validator(mode="after")
    def _one_kind(self) -> NetworkConfig:
        if self.factory is None and self.arguments:
            raise ValueError("expected arguments only with factory")
        fields = type(self).model_fields.items()
        own = ("factory", "arguments")
        changed = [n for n, f in fields if n not in own and getattr(self, n) != f.default]
        if self.blends_reflectance and "reflectance" not in self.light_inputs:
            raise ValueError("expected reflectance in light_inputs, as blends_reflectance is true")
        if self.factory is not None and changed:
            raise ValueError(f"expected no {', '.join(changed)} with factory, whose settings are arguments")
        return self


def track_inputs(track: TrackName, config: NetworkConfig) -> tuple[str, ...]:
    """Names of a track's inputs in channel order."""
    names: tuple[str, ...] = ("beauty", "color_median", "color_max")
    if track == "specular":
        names += ("color_min", "normal_camera", "depth")
    if not config.uses_statistics:
        names = tuple(n for n in names if n not in COLOR_STATISTICS)
    return (*names, *(name for name in LIGHT_BUFFERS if name in config.light_inputs))


def input_channels(name: str) -> int:
    """Number of channels of the input ``name``."""
    return 1 if name == "known_share" else 3


TRACK_OUTPUTS: dict[TrackName, dict[str, int]] = {
    "diffuse": {"diffuse_albedo": 3},
    "specular": {"specular_albedo": 3, "roughness": 1},
}
_BLEND_CHANNELS = (3, 1, 3)  # predicted D, weight of the reflectance, gain of the reflectance
_MAX_GAIN_STOPS = 2.0


def track_channels(track: TrackName, config: NetworkConfig) -> int:
    """Number of output channels of a track, before the blend with ``reflectance``."""
    if track == "diffuse" and config.blends_reflectance:
        return sum(_BLEND_CHANNELS)
    return sum(TRACK_OUTPUTS[track].values())


def blend_reflectance(outputs: Tensor, reflectance: Tensor) -> Tensor:
    """Return D (B, 3, H, W) in [0, 1], blended from recorded ``reflectance`` (B, 3, H, W) and the diffuse
    track's ``outputs`` (B, 7, H, W) in [0, 1]: D (3), the reflectance's weight (1) and gain (3).
    """
    base, share, gain = outputs.split(_BLEND_CHANNELS, dim=1)
    scale = torch.exp2(_MAX_GAIN_STOPS * (2.0 * gain - 1.0))
    return torch.lerp(base, (reflectance.clamp(0.0, MAX_REFLECTANCE) * scale).clamp(max=1.0), share)


def encode_color(linear: Tensor, exposure: Tensor | float) -> Tensor:
    """Encode linear HDR colour to [-1, 1]: multiply by ``exposure``, clip to [0, 1], take the logarithm."""
    x = (linear * exposure).clamp(0.0, 1.0)
    span = math.log(1.0 + _LOG_EPSILON) - math.log(_LOG_EPSILON)
    return 2.0 * (torch.log(x + _LOG_EPSILON) - math.log(_LOG_EPSILON)) / span - 1.0


def encode_depth(depth_z_m: Tensor, depth_max_m: Tensor | None = None) -> Tensor:
    """Encode depth (B, 1, H, W) in metres, 0 without a surface, as (B, 3, H, W): -1 at 0, 1 at the maximum.

    ``depth_max_m`` (B,) is the whole view's maximum; None uses the tensor's, which differs for a crop.
    """
    if depth_max_m is None:
        depth_max_m = depth_z_m.amax(dim=(1, 2, 3))
    scale = depth_max_m.reshape(-1, 1, 1, 1).clamp_min(1e-6)  # a view without surface would divide by 0
    return (2.0 * depth_z_m / scale - 1.0).expand(-1, 3, -1, -1)


def encode_input(
    name: str, buffers: Mapping[str, Tensor], exposure: Tensor, depth_max_m: Tensor | None = None
) -> Tensor:
    """Encode the input ``name`` of :data:`INPUTS`: (B, 3 or 1, H, W) in [-1, 1]. Arguments are as for
    :func:`assemble_inputs`, but ``exposure`` is (B, 1, 1, 1)."""
    if name == "depth":
        return encode_depth(buffers["depth_z_m"], depth_max_m)
    if name == "normal_camera":
        return buffers[name]
    if name == "known_share":
        return 2.0 * buffers[name] - 1.0
    return encode_color(buffers[name], 1 / MAX_REFLECTANCE if name == "reflectance" else exposure)


def assemble_inputs(
    track: TrackName,
    buffers: Mapping[str, Tensor],
    exposure: Tensor,
    config: NetworkConfig,
    depth_max_m: Tensor | None = None,
) -> Tensor:
    """Assemble a track's input (B, C, H, W) in [-1, 1] from buffers by name.

    ``buffers`` contains linear colours ``beauty``, ``color_median``, ``color_max``, ``color_min`` (B, 3, H,
    W), ``normal_camera`` (B, 3, H, W) unit vectors, ``depth_z_m`` (B, 1, H, W) and the configuration's
    ``light_inputs``; ``exposure`` (B,) is the factor from :func:`color.exposure_for`, ``depth_max_m`` as for
    :func:`encode_depth`. Raises ``KeyError`` for a missing buffer.
    """
    exposure = exposure.reshape(-1, 1, 1, 1)
    names = track_inputs(track, config)
    return torch.cat([encode_input(name, buffers, exposure, depth_max_m) for name in names], dim=1)


def _zero_padding(x: Tensor, valid: tuple[int, int]) -> Tensor:
    """Set x (B, C, H, W) to 0 outside its top left ``valid`` (height, width), as zero padding would."""
    height, width = x.shape[-2:]
    if valid == (height, width):
        return x
    return F.pad(x[:, :, : valid[0], : valid[1]], (0, width - valid[1], 0, height - valid[0]))


class _GlobalLink(nn.Module):
    """Global track at a layer: ``add`` maps the vector g to a term added to the layer; ``update`` maps g and
    the layer's spatial mean to the next layer's g."""

    def __init__(self, global_channels: int, layer_channels: int, has_update: bool):
        super().__init__()
        self.add = nn.Linear(global_channels, layer_channels, bias=False)
        _draw_normal(self.add.weight, 0.01 / math.sqrt(global_channels))
        self.update: nn.Linear | None = None
        if has_update:
            self.update = _selu_linear(global_channels + layer_channels, global_channels)

    def next(self, g: Tensor, mean: Tensor) -> Tensor:
        """Return g (B, ``global_channels``) of the next layer, given this layer's spatial mean (B, C)."""
        if self.update is None:
            return g
        return F.selu(self.update(torch.cat([g, mean.to(g.dtype)], dim=1)))


def _draw_normal(weights: Tensor, deviation: float, mean: float = 0.0) -> None:
    # Checkpoints are checked with meta tensors, which have no values; initialising them would import torch's
    # compiler (1 s), which creates a temporary folder.
    if not weights.is_meta:
        nn.init.normal_(weights, mean, deviation)


def _selu_linear(num_in: int, num_out: int) -> nn.Linear:
    layer = nn.Linear(num_in, num_out)
    # the standard deviation at which SELU keeps unit variance
    _draw_normal(layer.weight, 1.0 / math.sqrt(num_in))
    _draw_normal(layer.bias, 0.002)
    return layer


def _conv(num_in: int, num_out: int, stride: int) -> nn.Conv2d:
    layer = nn.Conv2d(num_in, num_out, 4, stride=stride, padding=1 if stride == 2 else 0, bias=False)
    _draw_normal(layer.weight, 0.02)
    return layer


class Layer(nn.Module):
    """Base class of the layers; applies affine instance norm and adds the global track in a single pass."""

    def __init__(self, num_out: int, global_channels: int, *, has_norm: bool, has_update: bool):
        super().__init__()
        self.link = _GlobalLink(global_channels, num_out, has_update)
        self.scale: nn.Parameter | None = None
        self.shift: nn.Parameter | None = None
        if has_norm:
            self.scale = nn.Parameter(torch.empty(num_out))
            _draw_normal(self.scale, 0.02, mean=1.0)
            self.shift = nn.Parameter(torch.zeros(num_out))

    def modulate(self, x: Tensor, g: Tensor, valid: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Return the normalised x (B, C, H, W) plus a linear map of g, and the next layer's g. Mean and
        variance are taken over the top left ``valid`` (height, width) of x."""
        inside = x[:, :, : valid[0], : valid[1]]
        if inside.dtype != torch.float32 and inside.dtype != torch.float64:
            inside = inside.float()
        added = self.link.add(g).to(inside.dtype)
        if self.scale is None or self.shift is None:
            mean = inside.mean(dim=(2, 3))
            y = x + added.to(x.dtype)[:, :, None, None]
        else:
            variance, mean = torch.var_mean(inside, dim=(2, 3), correction=0)
            gain = self.scale * torch.rsqrt(variance + _NORM_EPS)
            offset = self.shift + added - mean * gain
            y = torch.addcmul(offset.to(x.dtype)[:, :, None, None], x, gain.to(x.dtype)[:, :, None, None])
        return _zero_padding(y, valid), self.link.next(g, mean)


class _Down(Layer):
    """LeakyReLU, 4x4 stride-2 convolution, norm, global track."""

    def __init__(self, num_in: int, num_out: int, global_channels: int, *, has_norm: bool):
        super().__init__(num_out, global_channels, has_norm=has_norm, has_update=True)
        self.conv = _conv(num_in, num_out, stride=2)

    def forward(self, x: Tensor, g: Tensor, valid: tuple[int, int]) -> tuple[Tensor, Tensor]:
        return self.modulate(self.conv(F.leaky_relu(x, _LEAK)), g, valid)


def _strip_rows(x: Tensor) -> int:
    """Rows of x per strip of about ``STRIP_ELEMENTS`` upsampled values; all rows if x has fewer values."""
    count = x.numel()
    return x.shape[2] if count <= STRIP_ELEMENTS else max(1, x.shape[2] * STRIP_ELEMENTS // (4 * count))


class _Up(Layer):
    """LeakyReLU, nearest x2, two 4x4 stride-1 convolutions (pad 1 before, 2 after), norm, global track."""

    def __init__(self, num_in: int, num_out: int, global_channels: int, *, has_norm: bool, dropout: float):
        super().__init__(num_out, global_channels, has_norm=has_norm, has_update=has_norm)
        self.conv1 = _conv(num_in, num_out, stride=1)
        self.conv2 = _conv(num_out, num_out, stride=1)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, g: Tensor, valid: tuple[int, int]) -> tuple[Tensor, Tensor]:
        strip = _strip_rows(x)
        if self.training or strip >= x.shape[2]:
            x = self._convolved(x, 0, x.shape[2], valid)
        else:
            starts = range(0, x.shape[2], strip)
            parts = [self._convolved(x, start, min(start + strip, x.shape[2]), valid) for start in starts]
            x = torch.cat(parts, dim=2)
        y, g = self.modulate(x, g, valid)
        return self.dropout(y), g

    def _convolved(self, x: Tensor, first: int, last: int, valid: tuple[int, int]) -> Tensor:
        """Upsample x's rows [first, last) by 2 and apply both convolutions: (B, C, 2 (last - first), 2 W).

        A row of the result depends on upsampled rows from 2 above to 4 below it; rows beyond the image are 0,
        also in the result of the first convolution.
        """
        low, high = max(first - _STRIP_MARGIN, 0), min(last + _STRIP_MARGIN, x.shape[2])
        rows = F.interpolate(F.leaky_relu(x[:, :, low:high], _LEAK), scale_factor=2, mode="nearest")
        inside = (min(max(valid[0] - 2 * low, 0), rows.shape[2]), valid[1])
        rows = _zero_padding(self._padded_convolution(self.conv1, rows), inside)
        rows = self._padded_convolution(self.conv2, rows)
        return rows[:, :, 2 * (first - low) : 2 * (last - low)]

    @staticmethod
    def _padded_convolution(layer: nn.Conv2d, x: Tensor) -> Tensor:
        """Convolve x, padded by 1 before and 2 after, without a padded copy, which would be slower."""
        return F.conv2d(x, layer.weight, padding=2)[:, :, 1:, 1:]


class Track(nn.Module):
    """One U-Net with its global track: (B, ``num_in``, H, W) in [-1, 1] to (B, ``num_out``, H, W) in [0, 1].

    H and W are arbitrary: inputs are padded with zeros at the bottom and the right to a multiple of 16, and
    the result is cropped. For an input that is already padded, ``valid_size`` is the (height, width) of the
    image at its top left.
    """

    def __init__(self, num_in: int, num_out: int, config: NetworkConfig):
        super().__init__()
        self.config = config
        base, width = config.base_channels, config.global_channels
        enc = [base, base * 2, base * 4, base * 8]
        dec = [base * 8, base * 4, base * 2] if config.wide_decoder else [base * 4, base * 2, base]
        self.global_start = _selu_linear(num_in, width)
        self.enc1 = _conv(num_in, enc[0], stride=2)
        self.enc2 = _Down(enc[0], enc[1], width, has_norm=True)
        self.enc3 = _Down(enc[1], enc[2], width, has_norm=True)
        self.enc4 = _Down(enc[2], enc[3], width, has_norm=False)
        drop = config.dropout
        self.dec4 = _Up(enc[3], dec[0], width, has_norm=True, dropout=drop)
        self.dec3 = _Up(dec[0] + enc[2], dec[1], width, has_norm=True, dropout=drop)
        self.dec2 = _Up(dec[1] + enc[1], dec[2], width, has_norm=True, dropout=drop)
        self.dec1 = _Up(dec[2] + enc[0], num_out, width, has_norm=False, dropout=0.0)

    def forward(self, x: Tensor, valid_size: tuple[int, int] | None = None) -> Tensor:
        height, width = valid_size or (x.shape[-2], x.shape[-1])
        bottom, right = (-n % STRIDE for n in x.shape[-2:])
        if bottom or right:
            x = F.pad(x, (0, right, 0, bottom))
        used = (height, width) if self.config.ignores_padding else (x.shape[-2], x.shape[-1])
        valid = [(-(-used[0] // 2**k), -(-used[1] // 2**k)) for k in range(NUM_LEVELS + 1)]
        mean = x[:, :, : used[0], : used[1]].mean(dim=(2, 3))
        g = F.selu(self.global_start(mean))
        e1 = _zero_padding(self.enc1(_zero_padding(x, valid[0])), valid[1])
        e2, g = self.enc2(e1, g, valid[2])
        e3, g = self.enc3(e2, g, valid[3])
        e4, g = self.enc4(e3, g, valid[4])
        d, g = self.dec4(e4, g, valid[3])
        d, g = self.dec3(torch.cat([d, e3], dim=1), g, valid[2])
        d, g = self.dec2(torch.cat([d, e2], dim=1), g, valid[1])
        d, _ = self.dec1(torch.cat([d, e1], dim=1), g, valid[0])
        d = d[:, :, :height, :width]
        return 0.5 * (torch.tanh(d.float() if d.dtype == torch.bfloat16 else d) + 1.0)


class MaterialNetwork(nn.Module):
    """The diffuse and the specular track. Calling the module runs ``tracks`` and returns maps by name."""

    def __init__(self, config: NetworkConfig | None = None):
        super().__init__()
        self.config = config or NetworkConfig()
        tracks: dict[str, nn.Module] = {}
        for name in TRACK_OUTPUTS:
            num_in = sum(input_channels(n) for n in track_inputs(name, self.config))
            tracks[name] = Track(num_in, track_channels(name, self.config), self.config)
        self.tracks = nn.ModuleDict(tracks)

    def parts(self) -> dict[str, nn.Module]:
        """The tracks, by names such as "diffuse track"."""
        return {f"{name} track": track for name, track in self.tracks.items()}

    def trained(self, tracks: tuple[TrackName, ...]) -> list[nn.Module]:
        """Modules whose weights are optimised in a phase that trains ``tracks``."""
        return [self.tracks[track] for track in tracks]

    def forward(
        self,
        buffers: Mapping[str, Tensor],
        exposure: Tensor,
        depth_max_m: Tensor | None = None,
        tracks: tuple[TrackName, ...] = ("diffuse", "specular"),
    ) -> dict[str, Tensor]:
        """Predicted maps (B, 3 or 1, H, W) in [0, 1] by name; arguments as for :func:`assemble_inputs`."""
        maps: dict[str, Tensor] = {}
        for track in tracks:
            x = assemble_inputs(track, buffers, exposure, self.config, depth_max_m)
            if self.is_channels_last:
                x = x.contiguous(memory_format=torch.channels_last)
            outputs = TRACK_OUTPUTS[track]
            predicted = self.tracks[track](x)
            if track == "diffuse" and self.config.blends_reflectance:
                predicted = blend_reflectance(predicted, buffers["reflectance"])
            for name, part in zip(outputs, predicted.split(list(outputs.values()), dim=1), strict=True):
                maps[name] = part
        return maps

    @property
    def is_channels_last(self) -> bool:
        """True if the weights are in channels-last order."""
        weight = self.get_parameter("tracks.diffuse.enc2.conv.weight")
        return weight.is_contiguous(memory_format=torch.channels_last) and not weight.is_contiguous()


def num_parameters(module: nn.Module) -> int:
    """Number of trainable parameters of ``module``."""
    return sum(p.numel() for p in module.parameters() if p.requires_grad)
