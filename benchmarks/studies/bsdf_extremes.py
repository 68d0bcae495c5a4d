# SPDX-License-Identifier: MIT
"""Accuracy of the BSDF for extreme inputs: the figures of docs/measurements.md.

    python -m benchmarks.studies.bsdf_extremes density      Beckmann's distribution in float32: errors in eps
    python -m benchmarks.studies.bsdf_extremes slopes       Newton steps of the sampler: error and time
    python -m benchmarks.studies.bsdf_extremes energy       directional albedo, and energy over bounces
    python -m benchmarks.studies.bsdf_extremes evaluations  10^9 values, densities and samples: NaN, Inf, sign

Each prints a Markdown table. Inputs of ``evaluations``: roughness in [0, 1] and NaN, -0.5, 1.5; albedos 0, 1
and between, and NaN, -1, 2, also with D + S > 1; wi and wo at any angle down to 1e-6 rad above the
horizon, on it, at the pole, and below.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.special import erf

from benchmarks.timing import markdown
from datagen.foundation.progress import Bars
from mitsuba_plugins import register, select_variant
from oracles import brdf as oracle

BATCH = 4_000_000
ANGLES_DEG = (0, 30, 45, 60, 75, 85, 89)
EPS = float(np.finfo(np.float32).eps)


# ---- density ----


def print_density(num: int = 200_000) -> None:
    """Print the relative error of Beckmann's distribution in float32, in eps, for three formulas."""
    import drjit as dr

    from mitsuba_plugins import beckmann
    from oracles import bsdf_probe as probe

    def log_domain(h: Any, alpha: Any) -> Any:
        tan2 = (dr.square(h.x) + dr.square(h.y)) / dr.square(h.z)
        return dr.exp(-tan2 / dr.square(alpha) + 2.0 * dr.log(1.0 + tan2) - dr.log(dr.pi * dr.square(alpha)))

    def from_cosine(h: Any, alpha: Any) -> Any:
        cos2 = dr.square(dr.normalize(h).z)
        return dr.exp((1.0 - 1.0 / cos2) / dr.square(alpha)) / (dr.pi * dr.square(alpha * cos2))

    rng = np.random.default_rng(1)
    forms = {"used": beckmann.beckmann_d, "log domain": log_domain, "from n.h": from_cosine}
    rows = []
    for alpha in (1e-3, 1e-2, 0.1, 0.3, 1.0):
        slope = rng.normal(size=(num, 2)) * alpha * rng.choice([0.1, 0.7], num)[:, None]
        h = probe.unit_float32(np.stack([-slope[:, 0], -slope[:, 1], np.ones(num)], -1) * 1.7)
        alpha32 = np.float32(alpha)
        expected = oracle.beckmann_d(h, np.float64(alpha32))
        row: list[Any] = [alpha]
        for form in forms.values():
            got = probe.array(form(probe.vector(h), probe.mi.Float(alpha32)))
            error = np.abs(got - expected) / expected / EPS
            row.append(f"{np.median(error):.2g} / {np.quantile(error, 0.999):.2g}")
        rows.append(row)
    print(markdown(["alpha", *(f"{name}: median / 99.9 %" for name in forms)], rows))


def print_slopes() -> None:
    """Print error of the CDF at sampled slopes and seconds for 4e6 samples, by number of Newton steps."""
    import drjit as dr
    import mitsuba as mi

    from mitsuba_plugins import beckmann

    u = ((np.arange(20_000) + 0.5) / 20_000).astype(np.float32)
    angles = np.concatenate([np.linspace(0, 1.57, 60), np.pi / 2 - np.array([1e-4, 1e-6])])
    rng = mi.PCG32(4_000_000)  # type: ignore[operator]  # Mitsuba's stubs
    rows = []
    for num_steps in (2, 3, 4, 5):
        worst = 0.0
        for angle in angles:
            cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
            pair = mi.Point2f(mi.Float(u), mi.Float(0.5))
            slope, _ = beckmann.sample_visible_slopes(mi.Float(cos), mi.Float(sin), pair, num_steps)
            tan = float(sin) / float(cos)
            top = min(1.0 / max(tan, 1e-12), 10.0)
            s = np.append(np.array(slope, np.float64), top)
            value = (1 + erf(s) + tan * np.exp(-(s**2)) / np.sqrt(np.pi)) / max(1.0, tan)
            worst = max(worst, float(np.abs(value[:-1] / value[-1] - u).max()))
        seconds = []
        for _ in range(9):
            pair = mi.Point2f(rng.next_float32(), rng.next_float32())
            cos_array = 0.5 + 0.4 * rng.next_float32()
            sin_array = dr.sqrt(1 - dr.square(cos_array))
            dr.eval(pair, cos_array, sin_array)
            dr.sync_thread()
            start = time.perf_counter()
            dr.eval(beckmann.sample_visible_slopes(cos_array, sin_array, pair, num_steps))
            dr.sync_thread()
            seconds.append(time.perf_counter() - start)
        rows.append([num_steps, f"{worst:.1e}", f"{np.median(seconds):.3f}"])
    print(markdown(["steps", "largest error of the variate", "s for 4e6"], rows))


# ---- energy ----


def _angle_transport(specular: float, roughness: float, num_bins: int, num_slopes: int) -> np.ndarray:
    """Matrix [o, i] of the shares of energy from angle bin i that the specular lobe reflects into bin o.

    Bins have equal projected solid angle, so the diffuse term adds the same number to all elements.
    """
    edges = np.sqrt(np.linspace(0, 1, num_bins + 1))
    alpha = float(oracle.alpha_from_roughness(np.float64(roughness)))
    h, weight = oracle.slopes_grid(alpha, num_slopes)
    transport = np.zeros((num_bins, num_bins))
    for i, cos in enumerate(np.sqrt((np.arange(num_bins) + 0.5) / num_bins)):
        wi = np.array([np.sqrt(1 - cos**2), 0, cos])
        cos_h = np.maximum(h @ wi, 0.0)
        wo = 2 * cos_h[:, None] * h - wi
        value = oracle.beckmann_d(h, alpha) * oracle.smith_g1(wi[None], alpha)[0] * cos_h / cos
        value *= oracle.schlick(specular, 1.0 - cos_h) * oracle.smith_g1(wo, alpha)
        seen = (cos_h > 0) & (wo[:, 2] > 0)
        transport[:, i] = np.histogram(wo[seen, 2], edges, weights=(value * weight)[seen])[0]
    return transport


def _sum_of_bounces(transport: np.ndarray, num_bounces: int) -> float:
    """Sum of the energy left after each bounce between two plates, of diffuse light of initial energy 1."""
    energy = np.full(len(transport), 1.0 / len(transport))
    total = 0.0
    for _ in range(num_bounces):
        energy = transport @ energy
        total += float(energy.sum())
    return total


def print_energy() -> None:
    """Print directional albedo by angle, roughness and (D, S), mean albedo, and growth per bounce."""
    pairs = ((0.0, 0.04), (0.5, 0.04), (0.8, 0.04), (1.0, 0.04), (0.5, 0.5), (0.0, 1.0))
    rows = []
    for diffuse, specular in pairs:
        for roughness in (0.0, 0.1, 0.3, 0.5, 0.7, 1.0):
            row: list[Any] = [f"{diffuse}, {specular}", roughness]
            for angle in ANGLES_DEG:
                wi = oracle.direction(np.array(np.radians(angle)), np.array(0.0))
                albedo = oracle.directional_albedo(wi, diffuse, specular, roughness)
                row.append(f"**{albedo:.2f}**" if albedo > 1.005 else f"{albedo:.2f}")
            rows.append(row)
    print(markdown(["D, S", "R", *(f"{a} deg" for a in ANGLES_DEG)], rows))
    print()
    rows = []
    for roughness in (0.0, 0.1, 0.3, 0.5, 1.0):
        specular_part = _angle_transport(0.04, roughness, 60, 300)
        for diffuse in (0.5, 0.8, 0.9, 0.95, 1.0):
            transport = specular_part + (1 - 0.04) * diffuse / len(specular_part)
            radius = float(np.abs(np.linalg.eigvals(transport)).max())
            # conserves energy for every direction: columns with a sum above 1 are scaled to 1
            bounded = transport / np.maximum(transport.sum(0), 1.0)
            sums = {
                name: _sum_of_bounces(t, n)
                for name, t, n in (("8", transport, 8), ("8 bounded", bounded, 8), ("64", transport, 64))
            }
            rows.append(
                [
                    roughness,
                    diffuse,
                    f"{transport.sum(0).mean():.3f}",
                    f"{transport.sum(0).max():.2f}",
                    f"{radius:.3f}",
                    f"{sums['8']:.2f}",
                    f"{sums['8 bounded']:.2f}",
                    f"{sums['64']:.1f}",
                ]
            )
    head = ["R", "D (S = 0.04)", "mean albedo", "largest", "growth a bounce"]
    print(markdown([*head, "8 bounces", "8 bounces, bounded", "64 bounces"], rows))


# ---- 10^9 evaluations ----


def _random_channel(rng: Any, wild: tuple[float, ...]) -> Any:
    """Random values, a float per lane: half uniform in [0, 1], a quarter 0 or 1, a quarter from ``wild``."""
    import drjit as dr
    import mitsuba as mi

    kind, u = rng.next_float32(), rng.next_float32()
    ends = dr.select(u < 0.5, mi.Float(0.0), mi.Float(1.0))
    table = mi.Float(list(wild))
    outside = dr.gather(mi.Float, table, dr.minimum(mi.UInt32(u * len(wild)), len(wild) - 1))
    return dr.select(kind < 0.5, u, dr.select(kind < 0.75, ends, outside))


def _random_direction(rng: Any) -> Any:
    """Random unit vectors: at uniform elevation, log-uniformly near the horizon, on it, and at the pole."""
    import drjit as dr
    import mitsuba as mi

    kind, u = rng.next_float32(), rng.next_float32()
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * rng.next_float32())
    near = dr.exp(dr.lerp(np.log(1e-6), 0.0, u)) * dr.select(kind < 0.7, mi.Float(1.0), mi.Float(-1.0))
    elevation = dr.select(kind < 0.4, (u - 0.25) * (dr.pi / 1.5), near)
    elevation = dr.select(kind > 0.95, dr.select(u < 0.5, mi.Float(0.0), mi.Float(dr.pi / 2)), elevation)
    z, radius = dr.sincos(elevation)
    radius = dr.select((kind > 0.95) & (u >= 0.5), 0.0, radius)
    return mi.Vector3f(radius * cos_phi, radius * sin_phi, z)


class _LaneTexture:
    """Substitute for a texture, with one value per lane."""

    def __init__(self, make: Callable[[], Any]):
        self.value = make()

    def eval(self, si: Any, active: Any = True) -> Any:
        return self.value

    eval_1 = eval


def _random_case(seed: int, num: int) -> tuple[Any, Any, Any, Any, Any]:
    """Random inputs of ``num`` lanes: BSDF, surface interaction, wo, and 1D and 2D random samples."""
    import drjit as dr
    import mitsuba as mi

    rng = mi.PCG32(num, initstate=seed)  # type: ignore[operator]  # Mitsuba's stubs
    bsdf = mi.load_dict({"type": "cook_torrance"})
    wild_albedo, wild_roughness = (float("nan"), -1.0, 2.0), (float("nan"), -0.5, 1.5)

    def color() -> Any:
        return mi.Color3f(*(_random_channel(rng, wild_albedo) for _ in range(3)))

    bsdf.diffuse_albedo, bsdf.specular_albedo = _LaneTexture(color), _LaneTexture(color)
    bsdf.roughness = _LaneTexture(lambda: _random_channel(rng, wild_roughness))
    si = dr.zeros(mi.SurfaceInteraction3f, num)
    si.wi = _random_direction(rng)
    wo = _random_direction(rng)
    # a third of the light directions are near the mirror direction, at distances of 10^-4 ... 1
    size = dr.exp(dr.lerp(np.log(1e-4), 0.0, rng.next_float32()))
    jitter = mi.Vector3f(*(size * (rng.next_float32() - 0.5) for _ in range(3)))
    mirrored = dr.normalize(mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z) + jitter)
    wo = dr.select(rng.next_float32() < 0.33, mirrored, wo)
    sample1, sample2 = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    return bsdf, si, wo, sample1, sample2


def _batches(count: int) -> Iterator[int]:
    """Yield the numbers of ``count`` batches, with a progress bar."""
    with Bars("batches") as bars:
        for batch in range(count):
            bars.tell("cases", batch, count)
            yield batch
        bars.tell("cases", count, count)


def print_evaluations(total: float) -> bool:
    """Print the counts of NaN, infinite and negative values in ``total`` cases; returns True if all are 0."""
    import drjit as dr
    import mitsuba as mi

    names = ("value", "pdf", "weight", "pdf of the sample")
    bad = {name: [0, 0, 0, 0.0] for name in names}
    num_batches = int(np.ceil(total / BATCH))
    start = time.perf_counter()
    for batch in _batches(num_batches):
        bsdf, si, wo, sample1, sample2 = _random_case(batch, BATCH)
        value, pdf, bs, weight = bsdf.eval_pdf_sample(mi.BSDFContext(), si, wo, sample1, sample2)
        faults: dict[str, tuple[Any, ...]] = {}
        for name, got in zip(names, (value, pdf, weight, bs.pdf), strict=True):
            planes = [got] if dr.depth_v(got) == 1 else list(got)
            tests = (dr.isnan, dr.isinf, lambda plane: plane < 0.0)
            counts: list[Any] = [sum(dr.select(test(p), mi.UInt32(1), 0) for p in planes) for test in tests]
            largest = (
                planes[0] if len(planes) == 1 else dr.maximum(dr.maximum(planes[0], planes[1]), planes[2])
            )
            faults[name] = (*counts, largest)
        dr.eval(faults)  # one kernel for all, then sums of its output
        for name, (*counts, largest) in faults.items():
            for i, count in enumerate(counts):
                bad[name][i] += int(dr.sum(count)[0])
            bad[name][3] = max(bad[name][3], float(dr.max(largest)[0]))
    seconds = time.perf_counter() - start
    rows = [[name, *counts[:3], f"{counts[3]:.4g}"] for name, counts in bad.items()]
    print(f"{num_batches * BATCH:.3g} cases in {seconds:.0f} s\n")
    print(markdown(["quantity", "NaN", "Inf", "negative", "largest"], rows))
    return all(not any(counts[:3]) for counts in bad.values())


TABLES = {"density": print_density, "slopes": print_slopes}


def main() -> int:
    """Run the command; the exit code is 1 if a value is NaN, infinite or negative."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", choices=(*TABLES, "energy", "evaluations"))
    parser.add_argument("--total", type=float, default=1e9, help="number of cases")
    arguments = parser.parse_args()
    if arguments.table == "energy":
        print_energy()
        return 0
    select_variant()
    register()
    if arguments.table in TABLES:
        TABLES[arguments.table]()
        return 0
    return 0 if print_evaluations(arguments.total) else 1


if __name__ == "__main__":
    sys.exit(main())
