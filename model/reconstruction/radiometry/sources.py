# SPDX-License-Identifier: MIT
"""Finds light sources that all photographs clip.

Sources are clipped emitters, blocks of directions in openings (connected parts of a face of the room's box
with a clipped background), and patches of neighbouring surfels that are clipped in all views. A source has
one radiance per channel, which is unknown in clipped channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from datagen.geometry.traced import TracedGeometry
from datagen.geometry.views import TracedView
from datagen.light.background import NEAR, Background, photographed_background
from datagen.light.bright_guide import adjacent_cells
from datagen.light.cells import cell_indices
from datagen.light.emitters import Emitters, photographed_emitters
from datagen.light.surfels import Surfels, clipped_shares

CLIPPED_SHARE = 0.5
"""Minimum share of clipped pixels of an emitter or background bin whose radiance is unknown, by channel."""
MIN_SURFEL_SHARE = 0.9
"""Minimum share of clipped pixels of a surfel that counts as clipped in all views."""
MIN_CELLS = 4
"""Minimum number of surfels in a patch."""
MIN_PIXELS, MAX_OPENINGS = 0.03, 6
"""Minimum share of all clipped background pixels in an opening, and maximum number of openings; others are
merged with the largest."""
BLOCK_OF_HEIGHT, AZIMUTHS_PER_BLOCK = (0, 0, 0, 0, 0, 0, 1, 2, 2, 3, 3, 3), 3
"""Block of each row of directions in an opening, from nadir to zenith, and columns of azimuth per block; all
directions below the horizon are one block. Near the sun, a clear sky is ten times as bright as elsewhere."""
SKY_REACH = 1.0
"""Distance, in radians, up to which an empty bin counts as clipped if the nearest photographed one is. A
larger distance would add blocks of sky that photographs do not distinguish, hence larger errors."""
MAX_SOURCES = 24
"""Maximum number of emitters and of patches; further ones are merged into the last."""


@dataclass(frozen=True)
class Sources:
    """S clipped sources.

    ``bound`` (S, 3): photographed radiance, a lower bound in clipped channels; ``is_open`` (S, 3): mask of
    clipped channels; ``of_emitter`` (K,), ``of_bin`` (B,) and ``of_surfel`` (N,): index of the source of each
    emitter, background bin and surfel, -1 for none. ``neighbours`` (J, 2): pairs of adjacent blocks of sky.
    """

    bound: NDArray[np.float64]
    is_open: NDArray[np.bool_]
    of_emitter: NDArray[np.int64]
    of_bin: NDArray[np.int64]
    of_surfel: NDArray[np.int64]
    neighbours: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))

    def __len__(self) -> int:
        return len(self.bound)

    def colored(
        self, values: NDArray, emitters: Emitters, background: Background, surfels: Surfels
    ) -> Colored:
        """Replace the clipped channels of every source's radiance by its row of ``values`` (S, 3)."""
        return Colored(
            _replaced(emitters.radiance, self.of_emitter, values, self.is_open),
            _replaced(background.radiance, self.of_bin, values, self.is_open),
            _replaced(surfels.radiance, self.of_surfel, values, self.is_open),
        )


@dataclass(frozen=True)
class Colored:
    """Radiance of ``emitters`` (K, 3), ``background`` bins (B, 3) and ``surfels`` (N, 3)."""

    emitters: NDArray[np.float32]
    background: NDArray[np.float32]
    surfels: NDArray[np.float32]


def _replaced(radiance: NDArray, source: NDArray, values: NDArray, is_open: NDArray) -> NDArray[np.float32]:
    found = radiance.astype(np.float32)
    rows = np.flatnonzero(source >= 0)
    owner = source[rows]
    found[rows] = np.where(is_open[owner], values[owner], found[rows])
    return found


def find_sources(
    views: Sequence[TracedView],
    surfels: Surfels,
    emitters: Emitters,
    background: Background,
    emits: NDArray[np.bool_],
    region_of_face: NDArray[np.int32],
    traced: TracedGeometry,
) -> Sources:
    """Find the clipped sources in ``views``.

    ``emits`` (M,): mask of triangles known to emit; ``region_of_face`` (M,): smooth region of each triangle.
    """
    marked = [replace(view, color=_mask_of(view).astype(np.float32)) for view in views]
    emitting = photographed_emitters(marked, traced, emits, region_of_face).radiance
    low, high = background.low, background.high
    bins = photographed_background(marked, low, high, NEAR, SKY_REACH).radiance
    of_bin, pairs = _labelled_bins(bins, _seen_bins(marked, low, high))
    parts = [
        (emitters.radiance, *_labelled_emitters(emitting)),
        (background.radiance, of_bin, bins),
        (surfels.radiance, *_labelled_surfels(views, surfels)),
    ]
    bound: list[NDArray] = []
    opened: list[NDArray] = []
    labels: list[NDArray[np.int64]] = []
    for radiance, label, share in parts:
        count, first = int(label.max(initial=-1)) + 1, len(np.concatenate([np.zeros((0, 3)), *bound]))
        bound.append(_label_means(radiance, label, count))
        opened.append(_label_means(share, label, count))
        labels.append(np.where(label >= 0, label + first, -1))
    is_open = np.concatenate(opened) >= CLIPPED_SHARE
    pairs = pairs + len(bound[0])
    return Sources(np.concatenate(bound), is_open, labels[0], labels[1], labels[2], pairs)


def _label_means(values: NDArray, label: NDArray, count: int) -> NDArray[np.float64]:
    """Compute the means (count, 3) of ``values`` (N, 3) by ``label`` (N,), numbered from 0; -1 is ignored."""
    found, is_labelled = np.zeros((count, 3)), label >= 0
    num = np.maximum(np.bincount(label[is_labelled], minlength=count), 1)
    for channel in range(3 if count else 0):
        found[:, channel] = (
            np.bincount(label[is_labelled], values[is_labelled, channel].astype(np.float64), count) / num
        )
    return found


def _mask_of(view: TracedView) -> NDArray[np.bool_]:
    return np.zeros(view.color.shape, dtype=bool) if view.clipped_mask is None else view.clipped_mask


def _labelled_emitters(share: NDArray) -> tuple[NDArray[np.int64], NDArray]:
    clipped = (share >= CLIPPED_SHARE).any(axis=1)
    return np.where(clipped, np.minimum(np.cumsum(clipped) - 1, MAX_SOURCES - 1), -1), share


def _seen_bins(marked: Sequence[TracedView], low: NDArray, high: NDArray) -> NDArray[np.int64]:
    """Count the clipped pixels (B,), where colours in ``marked`` exceed 0, in each bin of the background."""
    total = np.zeros(NEAR.num_bins, np.int64)
    for view in marked:
        clipped = (view.geometry.face < 0) & view.valid_mask & (view.color.max(axis=2) > 0)
        pixel = np.flatnonzero(clipped)
        direction = view.camera.ray_directions().reshape(-1, 3)[pixel]
        origin = np.broadcast_to(view.camera.position_m, direction.shape)
        total += np.bincount(NEAR.bins_of(origin, direction, low, high), minlength=len(total))
    return total


def _labelled_bins(share: NDArray, seen: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the source (B,) of each bin, -1 for none, and the pairs (J, 2) of adjacent blocks of sky.

    ``share`` (B, 3) and ``seen`` (B,): share and number of a bin's pixels that are clipped. Each block of
    directions in an opening is a source.
    """
    opening = _openings((share >= CLIPPED_SHARE).any(axis=1), seen)
    row, column = np.divmod(np.arange(NEAR.num_directions), NEAR.azimuths)
    height = np.array(BLOCK_OF_HEIGHT)[row]
    across = NEAR.azimuths // AZIMUTHS_PER_BLOCK
    block = np.where(height > 0, height * across + column // AZIMUTHS_PER_BLOCK, 0)
    num_blocks = (max(BLOCK_OF_HEIGHT) + 1) * across
    key = np.where(opening >= 0, opening * num_blocks + np.resize(block, len(opening)), -1)
    kept = np.unique(key[key >= 0])
    height, azimuth = np.divmod(kept % num_blocks, across)
    azimuth_steps = np.abs(azimuth[:, None] - azimuth)
    steps = np.abs(height[:, None] - height) + np.minimum(azimuth_steps, across - azimuth_steps)
    same_opening = kept[:, None] // num_blocks == kept // num_blocks
    is_pair = (steps == 1) & same_opening & (np.minimum(height[:, None], height) > 0)
    return np.where(key >= 0, np.searchsorted(kept, key), -1), np.argwhere(np.triu(is_pair))


def _openings(clipped: NDArray[np.bool_], seen: NDArray) -> NDArray[np.int64]:
    """Return the opening (B,) of each ``clipped`` bin, -1 for others and for directions into the room.

    An opening is a connected part of a face of the box with clipped bins.
    """
    shape = 6, NEAR.places, NEAR.places, NEAR.num_directions
    leaves = np.stack([sign * axis > 0 for axis in NEAR.bin_directions().T for sign in (-1, 1)])  # by face
    clipped = (clipped.reshape(shape) & leaves[:, None, None]).ravel()
    has_clipped = clipped.reshape(shape).any(axis=3)
    label = np.full(shape[:3], -1, np.int64)
    count = 0
    for face in range(6):
        parts, found = ndimage.label(has_clipped[face])
        label[face] = np.where(parts > 0, parts - 1 + count, -1)
        count += found
    opening = np.where(clipped.reshape(shape), label[..., None], -1).ravel()
    if count:
        pixels = np.bincount(opening[clipped], seen[clipped], count)
        few = pixels < MIN_PIXELS * pixels.sum()
        few[np.argsort(-pixels, kind="stable")[MAX_OPENINGS:]] = True
        opening[clipped] = np.where(few[opening[clipped]], int(pixels.argmax()), opening[clipped])
    return opening


def _labelled_surfels(views: Sequence[TracedView], surfels: Surfels) -> tuple[NDArray[np.int64], NDArray]:
    """Return the index (N,) of each surfel's patch, -1 for none, and its clipped channels (N, 3), 0 or 1.

    A patch consists of neighbouring surfels of one side that are clipped in all views.
    """
    share = clipped_shares(views, surfels)
    clipped = np.flatnonzero((share >= MIN_SURFEL_SHARE).any(axis=1))
    label = np.full(len(surfels), -1, np.int64)
    cells, sides = cell_indices(np.flatnonzero(surfels.grid.surfel >= 0)[clipped], surfels.grid.shape)
    for number, patch in enumerate(adjacent_cells(cells, sides)):
        label[clipped[patch]] = number
    return _largest(label, MIN_CELLS), (share >= MIN_SURFEL_SHARE).astype(np.float64)


def _largest(label: NDArray, least: int) -> NDArray[np.int64]:
    """Renumber ``label`` (N,) by decreasing number of members, with at most :data:`MAX_SOURCES` labels.

    Further labels are merged into the last; those with fewer than ``least`` members become -1.
    """
    num = np.bincount(label[label >= 0])
    order = np.argsort(-num, kind="stable")
    new = np.full(len(num) + 1, -1, np.int64)  # the last entry is for -1
    kept = order[num[order] >= least]
    new[kept] = np.minimum(np.arange(len(kept)), MAX_SOURCES - 1)
    return new[label]


def source_of_pixels(
    view: TracedView, sources: Sources, emitters: Emitters, background: Background, surfel: NDArray
) -> NDArray[np.int64]:
    """Find the index (P,) of the source of each pixel's emitter, ``surfel`` (P,) or background bin, or -1."""
    face = view.geometry.face.ravel()
    found = np.full(len(face), -1, np.int64)
    on_mesh = np.flatnonzero(face >= 0)
    if len(sources.of_emitter):
        emitter = emitters.of_face[face[on_mesh]]
        found[on_mesh] = np.where(emitter >= 0, sources.of_emitter[np.maximum(emitter, 0)], -1)
    on_surfel = np.flatnonzero(surfel >= 0)
    found[on_surfel] = sources.of_surfel[surfel[on_surfel]]
    outside = np.flatnonzero((face < 0) & view.valid_mask.ravel())
    if len(outside):
        direction = view.camera.ray_directions().reshape(-1, 3)[outside]
        origin = np.broadcast_to(view.camera.position_m, direction.shape)
        found[outside] = sources.of_bin[NEAR.bins_of(origin, direction, background.low, background.high)]
    return found
