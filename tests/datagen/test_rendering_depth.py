# SPDX-License-Identifier: MIT
"""Path depth from the mean reflectance of surfaces: its formula, and a furnace in which that is exact."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.formats.lights import PointLight
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.rendering.path_depth import MAX_DEPTH, MIN_DEPTH, depth_for, rms_reflectance, truncation
from datagen.rendering.transport.integrator import PathTracer
from oracles.rendering_scenes import GREY, SmallScene, quad, renderer

CAMERA = Camera(24, 16, 20, 20, 12, 8, look_at([0.5, -1.0, 1.2], [0.0, 1.0, 0.8]))


def closed_room(emission: tuple[float, float, float] | None) -> SmallScene:
    """Return a closed room of reflectance 0.5, which is a furnace if its walls have ``emission``."""
    wall = GREY.model_copy(update={"emission": emission})
    parts = {
        "floor": quad([-2, -2, 0], [4, 0, 0], [0, 4, 0]),
        "ceiling": quad([-2, 2, 2], [4, 0, 0], [0, -4, 0]),
        "back": quad([-2, 2, 0], [4, 0, 0], [0, 0, 2]),
        "front": quad([2, -2, 0], [-4, 0, 0], [0, 0, 2]),
        "left": quad([-2, -2, 0], [0, 4, 0], [0, 0, 2]),
        "right": quad([2, 2, 0], [0, -4, 0], [0, 0, 2]),
    }
    return SmallScene({name: (mesh, "wall") for name, mesh in parts.items()}, {"wall": wall})


@pytest.mark.parametrize(
    ("reflectance", "left", "depth"),
    [
        (0.5, 0.01, 8),
        (0.5, 0.25, 3),
        (0.1, 0.01, 3),
        (0.9, 0.01, 45),
        (0.0, 0.01, MIN_DEPTH),
        (1.0, 0.5, MAX_DEPTH),
    ],
)
def test_depth_is_the_least_within_the_truncation(reflectance: float, left: float, depth: int) -> None:
    assert depth_for(reflectance, left) == depth
    if 0 < reflectance < 1:
        assert truncation(reflectance, depth) <= left * (1 + 1e-9)
        assert depth == MIN_DEPTH or truncation(reflectance, depth - 1) > left


def test_reflectance_excludes_background() -> None:
    diffuse, specular = np.full((2, 2, 3), 0.4, np.float32), np.full((2, 2, 3), 0.1, np.float32)
    diffuse[..., 0] = 0.5
    mask = np.array([[1.0, 1.0], [0.5, 0.0]], np.float32)[..., None]
    view = {"diffuse_albedo": diffuse, "specular_albedo": specular, "surface_mask": mask}
    assert rms_reflectance([view, view]) == pytest.approx(0.9 * 0.5 + 0.1)
    assert rms_reflectance([{**view, "surface_mask": 0 * mask}]) == 0.0


def test_depth_follows_from_the_room_and_is_recorded(tmp_path: Path, mitsuba_variant: str) -> None:
    recipe = RenderRecipe(path_samples=1, auxiliary_samples=4, denoise=False, max_energy_left=0.05)
    bulb = PointLight(name="bulb", position_m=(0.0, 0.0, 1.0), intensity=(1.0, 1.0, 1.0))
    record = renderer(tmp_path, closed_room(None), [CAMERA], recipe, lights=(bulb,)).render_view(0).render
    assert record.max_depth == 6 and record.max_energy_left == pytest.approx(0.5**5, rel=1e-3)


def test_truncation_in_a_furnace_matches_the_formula(tmp_path: Path, mitsuba_variant: str) -> None:
    """In a furnace of reflectance 0.5 each bounce adds half the radiance of the previous one."""
    room = renderer(tmp_path, closed_room((1.0, 1.0, 1.0)), [CAMERA])
    sensor = room.sensor(CAMERA)
    whole = PathTracer(room.built, room.materials, 40, 40).accumulate(sensor, 256, 1).radiance.sum()
    for depth in (3, 6):
        part = PathTracer(room.built, room.materials, depth, 40).accumulate(sensor, 256, 1).radiance.sum()
        assert 1 - part / whole == pytest.approx(truncation(0.5, depth), rel=0.1)
        assert 1 - part / whole != pytest.approx(truncation(0.5, depth + 1), rel=0.1)
