# SPDX-License-Identifier: MIT
"""To which light a shadow ray goes, as places have learned it.

Mitsuba chooses among emitters evenly: in a room with a lamp and a sky, half of the shadow rays go to the
light that is not there. While irradiance is gathered (:mod:`.irradiance_cache`), every cell
of surface also learns what each technique brings: the scene's own sampling of each emitter, and the guide
through openings (:mod:`.sky_guide`) where there is one. Technique k is then chosen with

    q_k ~ sqrt(E_k[f^2]),    f = radiance x cosine / density, E_k over its own samples,

which is the least variance that a choice among techniques can have. Every technique keeps a part, and
densities are exact, so that what was learned badly makes noise and no bias.

The choice is a warp of the first of two random numbers, which leaves points of a sequence well spread.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from datagen.rendering.transport.sky_guide import SkyGuide

Array = Any

SLOTS = 32
"""Of a place's table, or twice as many as there are techniques; probabilities are multiples of its inverse,
which is the least one."""
MAX_LEARNED = 16
"""With more techniques places learn nothing: tables would be large, and few rays tell them apart."""
MAX_TECHNIQUES = 512
"""With more the scene's own choice stays, and no guide is used: numbers in a table have 10 bits."""
BELOW_ONE = 1.0 - 2.0**-20
"""Keeps a warped number in its part of the unit interval when it is rounded."""


class LightChoice:
    """Probabilities of T techniques at each of P places: emitters in the scene's order, then the guide.

    ``shares`` (P, T), of any sum, say what each should get. Place 0 stands for wherever nothing is known; if
    there is no other, all places are it.
    """

    def __init__(self, scene: Any, guide: SkyGuide | None, shares: NDArray[np.float64]):
        self.scene, self.guide = scene, guide
        self.num_emitters = len(scene.emitters())
        self.num_techniques = self.num_emitters + (guide is not None)
        self.num_places, self.num_slots = len(shares), max(SLOTS, 2 * self.num_techniques)
        counts = whole_slots(shares, self.num_slots)
        starts = np.cumsum(counts, axis=1) - counts
        order = np.repeat(np.tile(np.arange(self.num_techniques), len(counts)), counts.ravel())
        order = order.reshape(-1, self.num_slots)
        rows = np.arange(len(counts))[:, None]
        packed = order | starts[rows, order] << 10 | counts[rows, order] << 20
        self.table = mi.UInt32(packed.ravel().astype(np.uint32))
        self.probabilities = mi.Float((counts / self.num_slots).ravel().astype(np.float32))
        registry = np.array(dr.reinterpret_array(mi.UInt32, scene.emitters_dr())).astype(np.int64)
        index_of = np.zeros(int(registry.max(initial=0)) + 1, np.uint32)
        index_of[registry] = np.arange(len(registry))
        self.index_of_emitter = mi.UInt32(index_of)
        self.environment_index = 0
        if guide is not None:
            sky = np.array(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(guide.environment)))
            self.environment_index = int(index_of[int(sky[0])])

    def arrays(self) -> list[Any]:
        """All that a recorded kernel reads."""
        own = [self.table, self.probabilities, self.index_of_emitter]
        return own if self.guide is None else [*own, *self.guide.arrays()]

    def index(self, emitter: Array) -> Array:
        """Number of an emitter (``EmitterPtr``) among the techniques."""
        registry: Any = dr.reinterpret_array(mi.UInt32, emitter)
        return dr.gather(mi.UInt32, self.index_of_emitter, registry)

    def _row(self, place: Array) -> Array:
        """Of the tables: that of the place, or the only one."""
        return place if self.num_places > 1 else mi.UInt32(0)

    def probability(self, place: Array, technique: Array) -> Array:
        """With which a technique is chosen."""
        return dr.gather(mi.Float, self.probabilities, self._row(place) * self.num_techniques + technique)

    def choose(self, place: Array, sample: Array) -> tuple[Any, Any]:
        """A technique by a number in [0, 1), and what is left of it: again a number in [0, 1)."""
        scaled = sample * self.num_slots
        slot = dr.minimum(mi.UInt32(scaled), self.num_slots - 1)
        packed: Any = dr.gather(mi.UInt32, self.table, self._row(place) * self.num_slots + slot)
        start, count = mi.Float((packed >> 10) & 0x3FF), mi.Float(packed >> 20)
        return packed & 0x3FF, dr.clip((scaled - start) / count, 0.0, BELOW_ONE)

    def sample_emitter(
        self, si: Any, place: Array, sample: Array, choice: Array, active: Array
    ) -> tuple[Any, Any]:
        """Direction to a light (a ``DirectionSample3f``) and its radiance over the density, whatever lies
        between. ``sample`` (two numbers) chooses technique and direction, ``choice`` the guide's opening."""
        technique, rest = self.choose(place, sample.x)
        guide = self.guide
        if guide is None:
            index, guided = technique, mi.Bool(False)
        else:
            is_last: Any = technique == self.num_emitters
            index = dr.select(is_last, self.environment_index, technique)
            guided = active & is_last & guide.contains(si.p)
        warped = mi.Point2f((mi.Float(index) + rest) / self.num_emitters, sample.y)
        ds, radiance = self.scene.sample_emitter_direction(si, warped, False, active & ~guided)
        brought, own_pdf = radiance * ds.pdf, ds.pdf
        if guide is not None:
            direction = guide.sample(si.p, choice, mi.Point2f(rest, sample.y))
            sky = dr.zeros(mi.SurfaceInteraction3f)
            sky.wi = -direction
            through: Any = dr.zeros(mi.DirectionSample3f)
            through.d, through.n, through.dist = direction, -direction, guide.distance
            through.p = si.p + direction * guide.distance
            through.emitter = mi.EmitterPtr(guide.environment)
            own_pdf = dr.select(guided, self.scene.pdf_emitter_direction(si, through, guided), own_pdf)
            brought = dr.select(guided, guide.environment.eval(sky, guided), brought)
            ds = dr.select(guided, through, ds)
        ds.pdf = self.pdf(si.p, ds.d, own_pdf, index, place)
        return ds, dr.select(ds.pdf > 0.0, brought / dr.maximum(ds.pdf, 1e-30), 0.0)

    def pdf(self, point: Array, direction: Array, own_pdf: Array, index: Array, place: Array) -> Array:
        """Density [1/sr] of :meth:`sample_emitter` towards emitter ``index``, from ``own_pdf``, that of the
        scene's own sampling with an even choice among emitters."""
        share = self.probability(place, index)
        guide = self.guide
        if guide is None:
            return own_pdf * self.num_emitters * share
        is_sky: Any = index == self.environment_index
        is_inside = guide.contains(point)
        guided = dr.select(is_sky, self.probability(place, mi.UInt32(self.num_emitters)), 0.0)
        share += dr.select(is_inside, 0.0, guided)  # outside of its box the environment has the guide's part
        through = dr.select(is_sky & is_inside, guided * guide.pdf(point, direction), 0.0)
        return own_pdf * self.num_emitters * share + through

    def technique(self, ds: Any, radiance: Array) -> Array:
        """To which technique the light of a sample is put down: that of the sky to the guide, if there is
        one, but for what is as bright as the sun. ``radiance``: luminance of what ``ds`` brought."""
        index = self.index(ds.emitter)
        if self.guide is None:
            return index
        is_sky = (index == self.environment_index) & (radiance <= self.guide.brightest)
        return dr.select(is_sky, self.num_emitters, index)


def even_choice(scene: Any, guide: SkyGuide | None) -> LightChoice | None:
    """The choice before anything is learned: the guide gets its share of the shadow rays, emitters the rest,
    evenly. None where there is nothing to choose, or too much."""
    num_emitters = len(scene.emitters())
    if not 2 <= num_emitters + (guide is not None) <= MAX_TECHNIQUES:
        return None
    shares = np.ones(num_emitters)
    if guide is not None:
        shares = np.append(shares * (1.0 - guide.share) / num_emitters, guide.share)
    return LightChoice(scene, guide, shares[None])


def whole_slots(shares: NDArray[np.float64], num_slots: int = SLOTS) -> NDArray[np.int64]:
    """Slots (P, T) of ``num_slots`` for shares (P, T): at least one each, else in proportion."""
    total = shares.sum(axis=1, keepdims=True)
    even = np.full_like(shares, 1.0 / shares.shape[1])
    parts = np.divide(shares, total, out=even, where=total > 0.0)
    wanted = 1.0 + parts * (num_slots - shares.shape[1])
    counts = np.floor(wanted).astype(np.int64)
    missing = num_slots - counts.sum(axis=1, keepdims=True)
    rank = np.argsort(np.argsort(counts - wanted, axis=1, kind="stable"), axis=1, kind="stable")
    return counts + (rank < missing)
