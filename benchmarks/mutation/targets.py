# SPDX-License-Identifier: MIT
"""Modules to mutate, each with the smallest set of test files that covers it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """Modules to mutate, test files that should detect the mutants, and the number of mutants to try."""

    modules: tuple[str, ...]
    tests: tuple[str, ...]
    number: int = 25


TARGETS = {
    "statistics": Target(
        (
            "datagen/multiview/statistics.py",
            "datagen/multiview/view_selection.py",
            "datagen/multiview/visibility.py",
        ),
        ("tests/datagen/test_multiview_statistics.py", "tests/datagen/test_multiview_visibility.py"),
        30,
    ),
    "merge": Target(
        (
            "model/reconstruction/merge/merger.py",
            "model/reconstruction/merge/medians.py",
            "model/reconstruction/merge/lane_sort.py",
        ),
        ("tests/model/test_reconstruction_merge.py",),
    ),
    "irradiance cache": Target(
        (
            "datagen/rendering/transport/irradiance_cache.py",
            "datagen/rendering/transport/irradiance_gathering.py",
        ),
        (
            "tests/datagen/test_rendering_irradiance_cache.py",
            "tests/datagen/test_rendering_light_sampler.py::test_cells_choose_visible_lights",
        ),
        30,
    ),
    "sky guide": Target(
        ("datagen/rendering/transport/sky_guide.py", "datagen/rendering/transport/sky_observation.py"),
        ("tests/datagen/test_rendering_sky_guide.py",),
    ),
    "light sampler": Target(
        ("datagen/rendering/transport/light_sampler.py",),
        (
            "tests/datagen/test_rendering_light_sampler.py",
            "tests/datagen/test_rendering_sky_guide.py::test_points_outside_of_the_box_use_emitter_sampling",
        ),
        20,
    ),
    "albedo level": Target(("model/reconstruction/albedo_level.py",), ("tests/model/test_albedo_gains.py",)),
    "mesh mending": Target(
        ("model/reconstruction/mesh/holes.py", "model/reconstruction/mesh/smoothing.py"),
        ("tests/model/test_mesh_holes.py", "tests/model/test_mesh_smoothing.py"),
    ),
    "bilateral solver": Target(("model/bilateral_solver.py",), ("tests/model/test_bilateral_solver.py",)),
    "BSDF": Target(
        ("mitsuba_plugins/beckmann.py", "mitsuba_plugins/cook_torrance.py"),
        ("tests/mitsuba_plugins/test_beckmann.py", "tests/mitsuba_plugins/test_cook_torrance.py"),
        30,
    ),
    "farm": Target(
        (
            "datagen/farm/work_unit.py",
            "datagen/farm/folder.py",
            "datagen/farm/collect.py",
            "datagen/farm/status.py",
            "datagen/farm/slurm.py",
            "datagen/farm/pbs.py",
            "datagen/farm/submission.py",
        ),
        ("tests/datagen/test_farm_unit.py", "tests/datagen/test_farm_submit.py"),
        30,
    ),
}
