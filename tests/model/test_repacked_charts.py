# SPDX-License-Identifier: MIT
"""Charts scaled to the density of the pixels that show them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.meshes.mesh import Mesh
from model.reconstruction.unwrap.charts import PACK_SIZE, uv_areas
from model.reconstruction.unwrap.repacked import MAX_REDUCTION, PixelDensity, repacked
from model.reconstruction.unwrap.uv import UvReport, own_uv_fault

DENSITY = 100.0
WHOLE_TEXELS = 5e-3
"""Relative tolerance of lengths: charts are stretched to whole texels of the packing."""


def quads(second: tuple[float, float] = (4.0, 4.0)) -> Mesh:
    """Return two walls and a lawn whose UVs have the same scale, 50 m to the side of the atlas."""
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    flat = [np.array(sides, np.float32) * unit for sides in ((4, 4), second, (40, 40))]
    corners = np.array([[1, 41], [6, 41], [1, 0.5]], np.float32)
    positions = np.concatenate([np.column_stack([p, np.full(4, k)]) for k, p in enumerate(flat)])
    uv = np.concatenate([p + corner for p, corner in zip(flat, corners, strict=True)]) / 50
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(3)])
    return Mesh(positions.astype(np.float32), faces.astype(np.int32), None, uv.astype(np.float32))


def seen(per_m: list[float]) -> PixelDensity:
    """Return ten pixels on each triangle, with ``per_m`` pixels per metre by quad; none where it is 0."""
    face = np.repeat(np.arange(6, dtype=np.int32), 10)
    values = np.repeat(np.array(per_m), 20)
    return PixelDensity(face[values > 0], values[values > 0])


def texels_per_m(mesh: Mesh, side: float) -> NDArray[np.float64]:
    return side * np.sqrt(uv_areas(mesh) / mesh.areas())


def report_of(mesh: Mesh) -> UvReport:
    return UvReport("mesh", "", float(uv_areas(mesh).sum()), 50.0, 1.0)


def test_charts_have_as_many_texels_as_pixels() -> None:
    mesh = quads()
    made, report = repacked(mesh, report_of(mesh), seen([DENSITY, DENSITY / 2, 0.0]))
    assert report.is_repacked
    assert not own_uv_fault(made)
    assert report.metres_per_side < 0.2 * 50
    got = texels_per_m(made, DENSITY * report.metres_per_side)
    expected = DENSITY * np.repeat([1, 1 / 2, 1 / MAX_REDUCTION], 2)
    np.testing.assert_allclose(got, expected, rtol=WHOLE_TEXELS)
    np.testing.assert_allclose(report.coverage, uv_areas(made).sum(), rtol=1e-6)
    assert report.padding_texels is not None
    assert report.padding_texels >= 1


def test_small_charts_keep_fine_texels() -> None:
    """A chart of 0.5 m has the finest texels even if unseen; coarse ones would mostly show its neighbours."""
    mesh = quads((0.5, 0.5))
    made, report = repacked(mesh, report_of(mesh), seen([DENSITY, 0.0, 0.0]))
    np.testing.assert_allclose(
        texels_per_m(made, DENSITY * report.metres_per_side)[2:4], DENSITY, rtol=WHOLE_TEXELS
    )


def test_narrow_charts_are_a_texel_wide() -> None:
    """Narrower charts would show their neighbours; lengthwise, a chart has the density of the others."""
    mesh = quads((4.0, 0.001))
    made, report = repacked(mesh, report_of(mesh), seen([DENSITY, DENSITY, 0.0]))
    assert made.uv is not None
    sides = np.sort(np.ptp(made.uv[made.faces[2:4]].reshape(-1, 2), axis=0))
    assert 0.8 < sides[0] * PACK_SIZE < 1.5
    np.testing.assert_allclose(sides[1] * report.metres_per_side, 4.0, rtol=WHOLE_TEXELS)


def test_charts_keep_their_shape() -> None:
    mesh = quads()
    made, _ = repacked(mesh, report_of(mesh), seen([DENSITY, DENSITY / 2, 0.0]))
    assert made.positions is mesh.positions
    assert made.faces is mesh.faces
    assert made.uv is not None
    assert mesh.uv is not None
    before, after = mesh.uv[mesh.faces], made.uv[made.faces]
    lengths = [np.linalg.norm(values - np.roll(values, 1, axis=1), axis=2) for values in (before, after)]
    scale = lengths[1] / lengths[0]
    np.testing.assert_allclose(scale, np.repeat(scale[:, :1], 3, axis=1), rtol=WHOLE_TEXELS)


def test_layouts_that_save_little_are_kept() -> None:
    """Nothing is saved if the lawn needs fine texels itself, or if no photograph shows the mesh."""
    mesh = quads()
    for density in (seen([DENSITY, DENSITY, DENSITY]), seen([0.0, 0.0, 0.0])):
        made, report = repacked(mesh, report_of(mesh), density)
        assert made is mesh
        assert not report.is_repacked


def test_fine_pixels_count_but_not_the_finest() -> None:
    """A chart has the second-highest density of ten pixels, not that of a single pixel of a near view."""
    mesh = quads()
    density = seen([DENSITY, DENSITY / 4, 0.0])
    per_m = density.per_m.copy()
    per_m[20] = DENSITY
    made, report = repacked(mesh, report_of(mesh), PixelDensity(density.face, per_m))
    got = texels_per_m(made, DENSITY * report.metres_per_side)
    np.testing.assert_allclose(got[2:4], DENSITY / 4, rtol=WHOLE_TEXELS)
