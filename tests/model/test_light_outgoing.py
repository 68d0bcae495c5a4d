# SPDX-License-Identifier: MIT
"""Mean outgoing radiance of surfels in uniform light, for which it is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh
from datagen.geometry.traced import mesh_scene
from datagen.light.background import NEAR, Background
from datagen.light.bake import Baker
from datagen.light.cells import surfel_cells
from datagen.light.emitters import Emitters
from datagen.light.radiance_field import RadianceField
from datagen.light.surfels import CellGrid, Observations, Surfels
from model.reconstruction.light.points import MIN_DIFFUSE, ROUGH, outgoing_radiance

pytestmark = pytest.mark.usefixtures("mitsuba_variant")
NUM = 300
DIFFUSE, SPECULAR, ROUGHNESS = 0.2, 0.04, 0.3
CAMERA = np.array([[3.0, 0.0, 0.5]], np.float32)
"""Position of a camera at a grazing angle to the surfels, which lie at the origin and face upwards."""


@dataclass(frozen=True)
class Lit:
    """The fields that :func:`outgoing_radiance` reads."""

    surfels: Surfels
    baker: Baker


@lru_cache(maxsize=1)
def lit() -> Lit:
    """Surfels in light of radiance 1 from all directions."""
    position, normal = np.zeros((NUM, 3), np.float32), np.tile(np.float32([0, 0, 1]), (NUM, 1))
    index = np.array([0, -1, -1, -1, -1, -1], np.int32)
    grid = CellGrid(np.full(3, -5.0), 10.0, np.array([1, 1, 1]), index)
    ones, zero = np.ones(NUM, np.float32), np.zeros(NUM, np.int32)
    seen = Observations(np.arange(NUM + 1), zero, position, ones, normal)
    surfels = Surfels(grid, position, normal, zero, position, ones < 0, seen, CAMERA, (), ())
    far = Mesh(np.eye(3, dtype=np.float32) * 1e-3 - 4, np.array([[0, 1, 2]], np.int32), None, None)
    none, row = np.zeros(0, np.int32), np.zeros((0, 3), np.float32)
    dark = Emitters(np.full(1, -1, np.int32), row, np.ones(1, np.float32), none, row.reshape(0, 3, 3), none)
    every, radiance = np.ones(NEAR.num_bins, dtype=bool), np.ones((NEAR.num_bins, 3), np.float32)
    sky = Background(np.full(3, -5.0), np.full(3, 5.0), radiance, every, every)
    return Lit(surfels, Baker(RadianceField(mesh_scene(far), surfel_cells(surfels), dark, sky), 1e-2))


def specular_part(cosine: NDArray, num_rays: int) -> NDArray[np.float64]:
    """Specular radiance (K,) at the ``cosine`` (K,) of the angle between direction and normal."""
    direction = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (len(cosine), 1))
    shading = lit().baker.specular(0 * up, up, direction, np.full(len(cosine), ROUGHNESS), num_rays)
    return (SPECULAR * shading.ls0 + shading.ls1).mean(axis=1).astype(np.float64)


def photographed(radiance: float) -> tuple[Lit, NDArray[np.float32]]:
    """Surfels of one observed ``radiance``, and their specular part (N, 3)."""
    surfels = lit().surfels
    color = np.full((NUM, 3), radiance, np.float32)
    observations = replace(surfels.observations, radiance=color)
    cosine = float(CAMERA[0, 2] / np.linalg.norm(CAMERA))
    specular = np.full((NUM, 3), specular_part(np.array([cosine]), 4096)[0], np.float32)
    return replace(lit(), surfels=replace(surfels, radiance=color, observations=observations)), specular


def outgoing(
    found: Lit, specular: NDArray[np.float32], is_metal: bool = False
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    s, r = np.full((NUM, 3), SPECULAR, np.float32), np.full(NUM, ROUGHNESS, np.float32)
    return outgoing_radiance(found, specular, s, r, np.full(NUM, is_metal))  # type: ignore[arg-type]


def test_outgoing_radiance_is_the_mean_over_the_hemisphere() -> None:
    """At a grazing angle the specular part is more than twice its mean over the hemisphere."""
    found, specular = photographed(DIFFUSE + float(photographed(0)[1][0, 0]))
    radiance, diffuse = outgoing(found, specular)
    np.testing.assert_allclose(diffuse, DIFFUSE, rtol=1e-5)
    cosine = np.sqrt((np.arange(64) + 0.5) / 64)  # cosine-distributed
    mean = specular_part(cosine, 1024).mean()
    assert specular.mean() > 2 * mean
    assert radiance.mean() - DIFFUSE == pytest.approx(mean, rel=0.03)


def test_metals_and_mixed_surfels_keep_their_photographed_radiance() -> None:
    found, specular = photographed(1.0)
    mixed = replace(found, surfels=replace(found.surfels, is_mixed=np.ones(NUM, dtype=bool)))
    for values in (*outgoing(found, specular, is_metal=True), *outgoing(mixed, specular)):
        np.testing.assert_array_equal(values, 1.0)


def test_diffuse_part_has_a_lower_bound() -> None:
    """Where the specular part is overestimated, black surfaces do not become light sinks."""
    found, specular = photographed(0.05)
    assert specular.min() > 0.05
    _, diffuse = outgoing(found, specular)
    np.testing.assert_allclose(diffuse, MIN_DIFFUSE * 0.05, rtol=1e-5)


def test_field_with_other_radiance_and_background() -> None:
    """Replacing the radiance of the surfels changes neither estimated cells nor the background."""
    surfels, field = lit().surfels, lit().baker.field
    unseen = np.array([[0.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    extended = field.extended(*unseen, surfels, np.full((1, 3), 7.0))
    changed = extended.with_radiance(surfels, np.full((NUM, 3), 2.0, np.float32))
    np.testing.assert_array_equal(changed.cells.radiance[:NUM], 2.0)
    np.testing.assert_array_equal(changed.cells.radiance[NUM:], 7.0)
    assert changed.background is field.background
    black = replace(field.background, radiance=np.zeros_like(field.background.radiance))
    dark = Baker(changed.with_background(black), 1e-2)
    assert dark.field.cells is changed.cells
    up = np.array([[0.0, 0.0, 1.0]])
    assert dark.irradiance(0 * up, up, 64).diffuse.max() == 0
    assert lit().baker.irradiance(0 * up, up, 64).diffuse == pytest.approx(1.0, rel=1e-5)


def test_rough_surfaces_lose_but_do_not_gain_light() -> None:
    """A specular part that photographs lack is added on smooth surfaces only; an excess is always removed."""
    found, specular = photographed(1.0)
    s = np.full((NUM, 3), SPECULAR, np.float32)
    steps = np.array([*ROUGH, 1.0], np.float32)
    none, rough = np.zeros_like(specular), np.zeros(NUM, dtype=bool)
    gains = [
        float(outgoing_radiance(found, none, s, np.full(NUM, r, np.float32), rough)[0].mean()) - 1  # type: ignore[arg-type]
        for r in (steps[0], steps[:2].mean(), steps[1], steps[2])
    ]
    assert gains[0] > 0.04
    assert 0.4 < gains[1] / gains[0] < 0.6
    assert gains[2:] == [0, 0]
    lost, _ = outgoing_radiance(found, 3 * specular, s, np.ones(NUM, np.float32), rough)  # type: ignore[arg-type]
    assert lost.mean() < 1 - 2 * specular.mean()
