# SPDX-License-Identifier: MIT
"""Time of the bilateral solver on a 640 x 384 view with the 4 channels that it filters (S and R).

    python -m benchmarks.bench_solver [--threads 2] [--repeats 15] [--device cpu] [--out results.json]

Two guides: ``room`` has 60 flat regions with shading, texture and weak noise, like a predicted albedo;
``noise`` has ten times the noise, which spreads the pixels over many more cells. Prints medians and writes
JSON.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path

import torch

from benchmarks.timing import Stopwatch, machine, write_report
from model.bilateral_solver import SolverConfig, bilateral_solve, build_grid, solve

WIDTH, HEIGHT = 640, 384


def make_guide(kind: str) -> torch.Tensor:
    """Synthetic albedo (1, 3, 384, 640) of the ``kind`` ``room`` or ``noise``."""
    generator = torch.Generator().manual_seed(0)
    regions = torch.rand(1, 3, 6, 10, generator=generator)
    guide = 0.1 + 0.7 * torch.nn.functional.interpolate(regions, size=(HEIGHT, WIDTH))
    texture = torch.rand(1, 1, HEIGHT // 4, WIDTH // 4, generator=generator)
    texture = torch.nn.functional.interpolate(texture, size=(HEIGHT, WIDTH), mode="bilinear")
    noise = torch.randn(1, 3, HEIGHT, WIDTH, generator=generator)
    strength = 0.02 if kind == "noise" else 0.002
    return (guide * (0.9 + 0.2 * texture) + strength * noise).clamp(0.0, 1.0)


def measure(kind: str, device: torch.device, repeats: int) -> dict[str, float]:
    """Median seconds, number of grid cells, and errors of the solver after 10 and 25 iterations, by name."""
    generator = torch.Generator().manual_seed(1)
    guide = make_guide(kind).to(device)
    target = torch.rand(1, 4, HEIGHT, WIDTH, generator=generator).to(device)
    confidence = torch.rand(1, 4, HEIGHT, WIDTH, generator=generator).to(device).requires_grad_()

    def synchronize() -> None:
        if device.type == "cuda":
            torch.cuda.synchronize()

    for warm_up in (2, 0):  # the first measurement is discarded
        watch = Stopwatch()
        for _ in range(warm_up or repeats):
            with watch.stage("grid_s"):
                grid = build_grid(guide)
                synchronize()
            with watch.stage("solve_s"):
                filtered = bilateral_solve(target, confidence, grid)
                synchronize()
            with watch.stage("adjoint_s"):
                filtered.sum().backward()
                synchronize()
    result = {name: statistics.median(values) for name, values in watch.wall.items()}
    result["total_s"] = result["grid_s"] + result["solve_s"]
    result["num_vertices"] = grid.num_vertices
    columns = [i.detach().double().permute(0, 2, 3, 1).reshape(-1, 4) for i in (target, confidence)]
    weights, rhs = grid.splat(columns[1]), grid.splat(columns[0] * columns[1])
    exact, _ = solve(grid, SolverConfig(tolerance=1e-12, max_iterations=3000), weights, rhs, rhs / weights)
    for iterations in (10, 25):
        y, _ = solve(grid, SolverConfig(max_iterations=iterations), weights, rhs, rhs / weights)
        error = grid.slice(y - exact).abs()
        result[f"mean_error_{iterations}_iterations"] = float(error.mean())
        result[f"max_error_{iterations}_iterations"] = float(error.max())
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    results = {kind: measure(kind, torch.device(args.device), args.repeats) for kind in ("room", "noise")}
    report = {
        "benchmark": "solver",
        "threads": args.threads,
        "device": args.device,
        "torch": torch.__version__,
        "machine": machine(),
        "results": results,
    }
    for kind, values in results.items():
        print(kind, "  ".join(f"{name} {value:.4g}" for name, value in values.items()))
    write_report(report, args.out, is_printed=False)


if __name__ == "__main__":
    main()
