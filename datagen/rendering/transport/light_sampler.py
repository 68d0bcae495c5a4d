# SPDX-License-Identifier: MIT
"""Learned light sampling: emitters are chosen with probabilities estimated by cell.

Mitsuba chooses among emitters with equal probability, so in a room with a lamp and an occluded sky, half of
the shadow rays are wasted. While irradiance is gathered (:mod:`.irradiance_gathering`), the second moment of
each technique is estimated in every cell. The techniques are the sampling of each emitter and, if there is a
sky guide (:mod:`.sky_guide`), of each opening. Technique k is then chosen with probability

    q_k ~ sqrt(E_k[f^2]),    f = radiance x cosine / density, E_k: mean over its samples,

which minimises the variance of a choice among techniques. Since every technique has a minimum probability and
densities are exact, bad estimates increase the variance but add no bias.

The choice uses the first of the two random numbers of a direction, rescaled for reuse, which preserves the
distribution of low-discrepancy points.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsuba_plugins.cells import cell_of

if TYPE_CHECKING:
    from datagen.rendering.transport.sky_guide import SkyGuide

Array = Any

SLOTS = 64
"""Minimum number of slots in a row of the table; a row has at least twice as many slots as techniques.
Probabilities are multiples of 1 / slots, and at least 1 / slots."""
MAX_LEARNED = 24
"""Maximum number of techniques for learned sampling; with more, tables are large and estimates poor."""
MAX_TECHNIQUES = 512
"""Maximum number of techniques, since table entries have 10 bits for them; with more, Mitsuba chooses
uniformly, without a sky guide."""
BELOW_ONE = 1.0 - 2.0**-20
"""Upper bound of rescaled random numbers, which rounding could raise to 1."""


class LightSampler:
    """Probabilities of T techniques in each of P records of the irradiance cache.

    Techniques are the emitters in the scene's order, then the guide's openings. Probabilities are
    proportional to ``weights`` (P, T). All cells without a record share record 0; if P is 1, all cells do.
    """

    def __init__(self, scene: Any, guide: SkyGuide | None, weights: NDArray[np.float64]):
        self.scene, self.guide = scene, guide
        self.num_emitters = len(scene.emitters())
        self.num_techniques = self.num_emitters + (0 if guide is None else len(guide.shares))
        self.num_records, self.num_slots = len(weights), max(SLOTS, 2 * self.num_techniques)
        counts = whole_slots(weights, self.num_slots)
        starts = np.cumsum(counts, axis=1) - counts
        order = np.repeat(np.tile(np.arange(self.num_techniques), len(counts)), counts.ravel())
        order = order.reshape(-1, self.num_slots)
        rows = np.arange(len(counts))[:, None]
        packed = order | starts[rows, order] << 10 | counts[rows, order] << 20
        self.table = mi.UInt32(packed.ravel().astype(np.uint32))
        self.probabilities = mi.Float((counts / self.num_slots).ravel().astype(np.float32))
        guided = counts[:, self.num_emitters :].sum(axis=1) / self.num_slots
        self.guided_probability = mi.Float(guided.astype(np.float32))  # of all openings together
        registry = np.array(dr.reinterpret_array(mi.UInt32, scene.emitters_dr())).astype(np.int64)
        index_of = np.zeros(int(registry.max(initial=0)) + 1, np.uint32)
        index_of[registry] = np.arange(len(registry))
        self.index_of_emitter = mi.UInt32(index_of)
        self.environment_index = 0
        if guide is not None:
            sky = np.array(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(guide.environment)))
            self.environment_index = int(index_of[int(sky[0])])

    def arrays(self) -> list[Any]:
        """Arrays that a recorded kernel reads."""
        own = [self.table, self.probabilities, self.guided_probability, self.index_of_emitter]
        return own if self.guide is None else [*own, *self.guide.arrays()]

    def index(self, emitter: Array) -> Array:
        """Technique index of an emitter (``EmitterPtr``)."""
        registry: Any = dr.reinterpret_array(mi.UInt32, emitter)
        return dr.gather(mi.UInt32, self.index_of_emitter, registry)

    def _row(self, record: Array) -> Array:
        """Row of a record in the tables."""
        return record if self.num_records > 1 else mi.UInt32(0)

    def probability(self, record: Array, technique: Array) -> Array:
        """Probability with which ``technique`` is chosen at a record."""
        return dr.gather(mi.Float, self.probabilities, self._row(record) * self.num_techniques + technique)

    def choose(self, record: Array, sample: Array) -> tuple[Any, Any]:
        """Choose a technique by ``sample`` in [0, 1); also return ``sample`` rescaled for reuse."""
        scaled = sample * self.num_slots
        slot = cell_of(scaled, self.num_slots)
        packed: Any = dr.gather(mi.UInt32, self.table, self._row(record) * self.num_slots + slot)
        start, count = mi.Float((packed >> 10) & 0x3FF), mi.Float(packed >> 20)
        return packed & 0x3FF, dr.clip((scaled - start) / count, 0.0, BELOW_ONE)

    def sample_emitter(
        self, si: Any, record: Array, sample: Array, choice: Array, active: Array
    ) -> tuple[Any, Any]:
        """Sample a direction to an emitter; return ``DirectionSample3f`` and unoccluded radiance / density.

        ``sample`` in [0, 1)^2 selects technique and direction, ``choice`` in [0, 1) the opening's cell.
        """
        technique, rest = self.choose(record, sample.x)
        guide = self.guide
        if guide is None:
            index, guided = technique, mi.Bool(False)
        else:
            is_opening: Any = technique >= self.num_emitters
            index = dr.select(is_opening, self.environment_index, technique)
            guided = active & is_opening & guide.contains(si.p)
        warped = mi.Point2f((mi.Float(index) + rest) / self.num_emitters, sample.y)
        ds, radiance = self.scene.sample_emitter_direction(si, warped, False, active & ~guided)
        emitted, own_pdf = radiance * ds.pdf, ds.pdf
        if guide is not None:
            opening: Any = dr.select(is_opening, technique - self.num_emitters, mi.UInt32(0))
            direction = guide.sample(si.p, opening, choice, mi.Point2f(rest, sample.y))
            sky = dr.zeros(mi.SurfaceInteraction3f)
            sky.wi = -direction
            through: Any = dr.zeros(mi.DirectionSample3f)
            through.d, through.n, through.dist = direction, -direction, guide.distance
            through.p = si.p + direction * guide.distance
            # A pointer, since Dr.Jit 1.5 on CUDA aborts recordings that call guide.environment directly.
            index_of_sky: Any = mi.UInt32(self.environment_index)
            environment: Any = dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), index_of_sky)
            through.emitter = environment
            own_pdf = dr.select(guided, self.scene.pdf_emitter_direction(si, through, guided), own_pdf)
            emitted = dr.select(guided, environment.eval(sky, guided), emitted)
            ds = dr.select(guided, through, ds)
        ds.pdf = self.pdf(si.p, ds.d, own_pdf, index, record)
        return ds, dr.select(ds.pdf > 0.0, emitted / dr.maximum(ds.pdf, 1e-30), 0.0)

    def pdf(self, point: Array, direction: Array, own_pdf: Array, index: Array, record: Array) -> Array:
        """Density [1/sr] of :meth:`sample_emitter` towards emitter ``index``.

        ``own_pdf`` is the density of the scene's own sampling, with a uniform choice among emitters.
        """
        probability = self.probability(record, index)
        guide = self.guide
        if guide is None:
            return own_pdf * self.num_emitters * probability
        is_sky: Any = index == self.environment_index
        is_inside = guide.contains(point)
        # Outside the box, the environment itself is sampled instead of the openings.
        guided = dr.gather(mi.Float, self.guided_probability, self._row(record))
        probability += dr.select(is_sky & ~is_inside, guided, 0.0)
        opening, density = guide.pdf(point, direction)
        chosen = self.probability(record, self.num_emitters + opening)
        through = dr.select(is_sky & is_inside, chosen * density, 0.0)
        return own_pdf * self.num_emitters * probability + through

    def technique(self, point: Array, ds: Any, radiance: Array) -> Array:
        """Technique to which the light of an emitter sample at ``point`` is attributed.

        Light of the sky is attributed to its opening, if there is a guide, unless its luminance ``radiance``
        in the direction of ``ds`` exceeds the maximum luminance of the sky without its sun.
        """
        index = self.index(ds.emitter)
        if self.guide is None:
            return index
        is_sky = (index == self.environment_index) & (radiance <= self.guide.brightest)
        opening, _ = self.guide.pdf(point, ds.d)
        return dr.select(is_sky & self.guide.contains(point), self.num_emitters + opening, index)


def uniform_sampler(scene: Any, guide: SkyGuide | None) -> LightSampler | None:
    """Return a sampler whose probabilities, multiples of 1 / slots, are the same in all cells.

    Openings have the probabilities ``guide.shares``, and emitters equal parts of the rest. Returns None for
    fewer than two techniques or more than :data:`MAX_TECHNIQUES`.
    """
    num_emitters = len(scene.emitters())
    shares = np.zeros(0) if guide is None else guide.shares
    if not 2 <= num_emitters + len(shares) <= MAX_TECHNIQUES:
        return None
    weights = np.append(np.full(num_emitters, (1.0 - shares.sum()) / max(num_emitters, 1)), shares)
    return LightSampler(scene, guide, weights[None])


def whole_slots(weights: NDArray[np.float64], num_slots: int = SLOTS) -> NDArray[np.int64]:
    """Divide each row's ``num_slots`` slots in proportion to ``weights`` (P, T), at least 1 each."""
    total = weights.sum(axis=1, keepdims=True)
    uniform = np.full_like(weights, 1.0 / weights.shape[1])
    parts = np.divide(weights, total, out=uniform, where=total > 0.0)
    wanted = 1.0 + parts * (num_slots - weights.shape[1])
    counts = np.floor(wanted).astype(np.int64)
    missing = num_slots - counts.sum(axis=1, keepdims=True)
    rank = np.argsort(np.argsort(counts - wanted, axis=1, kind="stable"), axis=1, kind="stable")
    return counts + (rank < missing)
