# SPDX-License-Identifier: MIT
"""Perceptual distances between images (B, 3, H, W) in [0, 1]: E-LPIPS, LPIPS, and a distance without learned
weights.

E-LPIPS (Kettunen et al. 2019) is LPIPS after random but identical transforms of both images and dropout with
a shared mask, averaged over draws; one draw per call is an unbiased estimate. Plain LPIPS-VGG uses the same
convolutions and has a published check value, which :func:`lpips_check_value` must return: 0.3494.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.training.weights import Convolution, Heads, find_heads, find_vgg, load_lpips_heads

LPIPS_CHECK_VALUE = 0.3494
OFFSET_MAX = 7
DROPOUT = 0.01
MIN_SIDE_PER_SCALE = 64
"""Images are downscaled by a factor k only if their shorter side has at least 64 k pixels."""
_NORM_EPS = 1e-10  # under the square root; added outside it, the gradient at a zero feature would be NaN
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_POOL_BEFORE = (2, 4, 7, 10)
_BLOCK_ENDS = (1, 3, 6, 9, 12)
_PERMUTATIONS = tuple(permutations(range(3)))


# --- the random transforms --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Transform:
    """A transform of B images. All share a box downscaling by ``scale`` after padding by ``scale_offset``
    (top, left) in pixels, and ``transpose``. Each has its own ``offsets`` (down, right) in pixels, ``flips``
    (bit 0: horizontal, bit 1: vertical), ``channel_orders`` and ``gains`` (B, 3).
    """

    scale: int
    scale_offset: tuple[int, int]
    transpose: bool
    offsets: tuple[tuple[int, int], ...]
    flips: tuple[int, ...]
    channel_orders: tuple[tuple[int, ...], ...]
    gains: Tensor


def sample_transform(batch: int, height: int, width: int, generator: torch.Generator) -> Transform:
    """Draw a transform for ``batch`` images; the scale k has a probability proportional to 1/k^2."""

    def integer(high: int) -> int:
        return int(torch.randint(0, high, (1,), generator=generator))

    levels = max(1, min(height, width) // MIN_SIDE_PER_SCALE)
    probabilities = torch.tensor([1.0 / k**2 for k in range(1, levels + 1)])
    scale = 1 + int(torch.multinomial(probabilities, 1, generator=generator))
    # stratified over the batch, as published: flips and gains are evenly distributed over the images
    flips = torch.randperm(-(-batch // 4) * 4, generator=generator)[:batch] % 4
    strata = torch.stack([torch.randperm(batch, generator=generator) for _ in range(3)], dim=1)
    uniform = (strata + torch.rand(batch, 3, generator=generator)) / batch
    orders = torch.randperm(-(-batch // 6) * 6, generator=generator)[:batch] % 6
    return Transform(
        scale=scale,
        scale_offset=(integer(scale), integer(scale)),
        transpose=bool(integer(2)),
        offsets=tuple((integer(OFFSET_MAX + 1), integer(OFFSET_MAX + 1)) for _ in range(batch)),
        flips=tuple(int(f) for f in flips),
        channel_orders=tuple(_PERMUTATIONS[int(o)] for o in orders),
        gains=0.2 + 0.8 * uniform,
    )


def apply_transform(images: Tensor, transform: Transform) -> Tensor:
    """Apply a transform to images (B, 3, H, W)."""
    k = transform.scale
    if k > 1:
        height, width = images.shape[-2:]
        top, left = transform.scale_offset
        bottom, right = ((2 * (k - 1) + n) // k * k - n - o for n, o in ((height, top), (width, left)))
        images = F.avg_pool2d(F.pad(images, (left, right, top, bottom), mode="reflect"), k)
    moved = []
    for index, (dy, dx) in enumerate(transform.offsets):
        pad = (OFFSET_MAX - dx, dx, OFFSET_MAX - dy, dy)
        image = F.pad(images[index : index + 1], pad, mode="reflect")
        axes = [axis for axis, bit in ((3, 1), (2, 2)) if transform.flips[index] & bit]
        image = image.flip(axes) if axes else image
        moved.append(image[:, list(transform.channel_orders[index])])
    out = torch.cat(moved)
    if transform.transpose:
        out = out.transpose(2, 3)
    return out * transform.gains.to(out)[:, :, None, None]


# --- VGG16 and the metric ---------------------------------------------------------------------------------


class VggFeatures(nn.Module):
    """VGG16's 13 convolutions, frozen; the features are the normalised input and the output of each ReLU."""

    def __init__(self, layers: list[Convolution], *, average_pooling: bool):
        super().__init__()
        self.average_pooling = average_pooling
        for index, layer in enumerate(layers):
            self.register_buffer(f"weight{index}", layer.weight.clone(), persistent=False)
            self.register_buffer(f"bias{index}", layer.bias.clone(), persistent=False)
        self.register_buffer("shift", torch.tensor(_SHIFT).reshape(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE).reshape(1, 3, 1, 1), persistent=False)

    def forward(self, images: Tensor, masks: list[Tensor] | None = None) -> list[Tensor]:
        """14 feature maps (B, C, h, w) of images (B, 3, H, W) in [-1, 1]; the 13 ``masks`` multiply the
        inputs of the convolutions."""
        x = (images - self.get_buffer("shift")) / self.get_buffer("scale")
        features = [x]
        pool = F.avg_pool2d if self.average_pooling else F.max_pool2d
        for index in range(13):
            if index in _POOL_BEFORE:
                x = pool(x, 2)
            if masks is not None:
                x = x * masks[index]
            x = F.conv2d(x, self.get_buffer(f"weight{index}"), self.get_buffer(f"bias{index}"), padding=1)
            x = F.relu(x)
            features.append(x)
        return features

    def dropout_masks(self, images: Tensor, generator: torch.Generator) -> list[Tensor]:
        """Masks that drop 1 % of the input of each of 13 convolutions, for images (B, 3, H, W).

        For speed they are drawn on the images' device, by a generator that the CPU ``generator`` seeds.
        """
        seed = int(torch.randint(0, 2**62, (1,), generator=generator))
        on_device = torch.Generator(device=images.device).manual_seed(seed)
        batch, _, height, width = images.shape
        masks = []
        for index in range(13):
            if index in _POOL_BEFORE:
                height, width = height // 2, width // 2
            channels = self.get_buffer(f"weight{index}").shape[1]
            mask = images.new_empty(batch, channels, height, width)
            masks.append(mask.bernoulli_(1.0 - DROPOUT, generator=on_device).div_(1.0 - DROPOUT))
        return masks


def _unit_features(features: Tensor) -> Tensor:
    features = features.float()
    return features * torch.rsqrt(features.square().sum(dim=1, keepdim=True) + _NORM_EPS)


def _weighted_distance(a: list[Tensor], b: list[Tensor], heads: Heads) -> Tensor:
    """LPIPS distance (B,) of two lists of 14 feature maps: the sum over layers of the spatial mean of the
    weighted squared difference of features normalised per pixel."""
    if heads.name == "lpips5":
        a, b = ([maps[1 + k] for k in _BLOCK_ENDS] for maps in (a, b))
    total = torch.zeros(a[0].shape[0], device=a[0].device)
    for x, y, vector in zip(a, b, heads.vectors, strict=True):
        difference = (_unit_features(x) - _unit_features(y)).square().mean(dim=(2, 3))
        total = total + (difference * vector.to(difference)).sum(dim=1)
    return total


class Elpips(nn.Module):
    """E-LPIPS distance (B,) of images (B, 3, H, W) in [0, 1] by VGG16, with E-LPIPS' 14 heads and average
    pooling, or with LPIPS' 5 heads and max pooling."""

    def __init__(self, layers: list[Convolution], heads: Heads, precision: str = "float32"):
        """``precision`` is the number format of VGG's activations; distances are summed in float32."""
        super().__init__()
        self.heads, self.precision = heads, precision
        self.name = f"elpips-vgg16-{heads.name}"
        self.features = VggFeatures(layers, average_pooling=heads.name == "elpips14")

    def forward(self, image: Tensor, reference: Tensor, generator: torch.Generator) -> Tensor:
        batch, _, height, width = image.shape
        transform = sample_transform(batch, height, width, generator)
        transformed = 2.0 * apply_transform(image, transform) - 1.0
        masks = self.features.dropout_masks(transformed, generator)
        with torch.autocast(image.device.type, torch.bfloat16, enabled=self.precision == "bfloat16"):
            with torch.no_grad():
                target = self.features(2.0 * apply_transform(reference, transform) - 1.0, masks)
            features = self.features(transformed, masks)
        return _weighted_distance(features, target, self.heads)


class LpipsVgg:
    """Plain LPIPS-VGG with the heads of the ``lpips`` package; an image's features can be reused."""

    def __init__(self, layers: list[Convolution]):
        self._network, self._heads = VggFeatures(layers, average_pooling=False), load_lpips_heads()

    def features(self, image: Tensor) -> list[Tensor]:
        """VGG's features of images (B, 3, H, W) in [-1, 1], one tensor per layer."""
        return self._network(image)

    def distance(self, image: list[Tensor], reference: list[Tensor]) -> Tensor:
        """LPIPS distance (B,) of two results of :meth:`features`."""
        return _weighted_distance(image, reference, self._heads)


def lpips_vgg(layers: list[Convolution], image: Tensor, reference: Tensor) -> Tensor:
    """Plain LPIPS-VGG distance (B,) of images (B, 3, H, W) in [-1, 1]."""
    lpips = LpipsVgg(layers)
    return lpips.distance(lpips.features(image), lpips.features(reference))


def lpips_check_value(layers: list[Convolution]) -> float:
    """Mean LPIPS-VGG distance of two fixed random batches; must be :data:`LPIPS_CHECK_VALUE`."""
    random = np.random.RandomState(123)
    first, second = (torch.from_numpy(random.rand(10, 3, 100, 100).astype(np.float32)) for _ in range(2))
    with torch.no_grad():
        return float(lpips_vgg(layers, 2.0 * first - 1.0, 2.0 * second - 1.0).mean())


# --- without weights --------------------------------------------------------------------------------------


class GradientSsim(nn.Module):
    """Distance (B,) of images (B, C, H, W) in [0, 1] without learned weights: gradients and SSIM.

    It is the mean over the scales 1, 1/2 and 1/4 of the mean absolute difference of the finite differences
    along x and y, plus half of 1 - SSIM (Gaussian window of 11 pixels, sigma 1.5, data range 1).
    """

    name = "gradient-ssim-3"
    NUM_SCALES = 3

    def __init__(self) -> None:
        super().__init__()
        x = torch.arange(11) - 5.0
        window = torch.exp(-(x**2) / (2 * 1.5**2))
        self.register_buffer("window", (window / window.sum()), persistent=False)

    def _blur(self, images: Tensor) -> Tensor:
        channels = images.shape[1]
        window = self.get_buffer("window").to(images)
        for shape in ((1, 1, 11, 1), (1, 1, 1, 11)):
            images = F.conv2d(images, window.reshape(shape).repeat(channels, 1, 1, 1), groups=channels)
        return images

    def ssim(self, a: Tensor, b: Tensor) -> Tensor:
        """Mean SSIM (B,) of images (B, C, H, W) in [0, 1] with a Gaussian window of 11 x 11 pixels."""
        num = a.shape[1]
        moments = self._blur(torch.cat([a, b, a * a, b * b, a * b], dim=1)).split(num, dim=1)
        mean_a, mean_b, square_a, square_b, product = moments
        variance_a, variance_b = square_a - mean_a**2, square_b - mean_b**2
        covariance = product - mean_a * mean_b
        c1, c2 = 0.01**2, 0.03**2
        top = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
        return (top / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))).mean(dim=(1, 2, 3))

    def forward(self, image: Tensor, reference: Tensor, generator: torch.Generator) -> Tensor:
        total = torch.zeros(image.shape[0], device=image.device)
        num_scales = 0
        for level in range(self.NUM_SCALES):
            if level:
                image, reference = F.avg_pool2d(image, 2), F.avg_pool2d(reference, 2)
            if min(image.shape[-2:]) < 11:  # the window no longer fits
                break
            difference = image - reference
            dx = (difference[..., 1:] - difference[..., :-1]).abs().mean(dim=(1, 2, 3))
            dy = (difference[..., 1:, :] - difference[..., :-1, :]).abs().mean(dim=(1, 2, 3))
            total = total + dx + dy + 0.5 * (1.0 - self.ssim(image, reference))
            num_scales += 1
        return total / max(num_scales, 1)


def make_perceptual(
    kind: str, vgg: Path | None = None, heads: Path | None = None, precision: str = "float32"
) -> nn.Module:
    """Construct the distance ``kind``: ``elpips`` or ``gradient_ssim``. The other arguments are options of
    E-LPIPS (:class:`~model.training.config.PerceptualConfig`).

    Raises :class:`InputError` if E-LPIPS lacks VGG16's weights.
    """
    if kind == "gradient_ssim":
        return GradientSsim()
    return Elpips(find_vgg(vgg), find_heads(heads), precision)
