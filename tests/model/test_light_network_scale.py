# SPDX-License-Identifier: MIT
"""Scaling of the network's diffuse albedo to that of surfels in known light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.geometry.views import TracedView
from model.reconstruction.light import stage
from model.reconstruction.light.shading_correction import SCALE_SUPPORT, network_scale
from model.reconstruction.light.view_maps import MAX_EXCESS, TYPICAL_WHITE, White, view_materials
from tests.model.light_room import photographed_room, quads
from tests.model.test_light_room import ONE_ROUND, of_quad, predicted, room, solved


def test_scale_comes_from_confident_surfels() -> None:
    """Surfels with a tenth of the predicted albedo, half of all, have no confidence and change no scale."""
    predicted_albedo = np.full((1000, 3), 0.3)
    known = np.arange(1000) % 2 == 0
    albedo = predicted_albedo * np.where(known[:, None], [1.2, 1.5, 2.0], 0.1)
    found = network_scale(albedo, predicted_albedo, known.astype(np.float64))
    np.testing.assert_allclose(
        np.log(found), np.log([1.2, 1.5, 2.0]) * 0.5 / (0.5 + SCALE_SUPPORT), rtol=0.01
    )


def test_little_evidence_scales_little() -> None:
    predicted_albedo = np.full((1000, 3), 0.3)
    rare = (np.arange(1000) < 5).astype(np.float64)
    np.testing.assert_allclose(
        network_scale(2 * predicted_albedo, predicted_albedo, rare), 2 ** (1 / 11), rtol=0.01
    )
    np.testing.assert_array_equal(network_scale(2 * predicted_albedo, predicted_albedo, 0 * rare), 1)


def too_dark() -> list[dict[str, NDArray]]:
    """A prediction with half the diffuse albedo found from light."""
    maps = predicted(photographed_room())
    for prediction, found in zip(maps, room().maps, strict=True):
        prediction["diffuse_albedo"] = 0.5 * found["diffuse_albedo"]
    return maps


def of_face(view: TracedView, name: str) -> NDArray[np.bool_]:
    """Mask (H, W) of the pixels of a quad."""
    return view.geometry.face[..., 0] // 2 == [quad.name for quad in quads()].index(name)


def south_wall(trust: float, monkeypatch: pytest.MonkeyPatch) -> float:
    """Ratio of the south wall's median D to that of :func:`room`, if its segments have no confidence and
    ``trust`` replaces the trust in light that hidden sources reduce."""
    explained, south = stage.solve_points, of_quad(room(), "south")

    def unexplained(lit, points, shading, segmentation, *rest):  # type: ignore[no-untyped-def]
        found = explained(lit, points, shading, segmentation, *rest)
        confidence = found.confidence.copy()
        confidence[np.unique(segmentation.segment[south])] = 0
        return replace(found, confidence=confidence)

    monkeypatch.setattr(stage, "solve_points", unexplained)
    monkeypatch.setattr(stage, "trust_in_hidden", lambda hidden, _: np.full(len(hidden), trust, np.float32))
    found = solved(photographed_room(), too_dark(), options=ONE_ROUND)
    medians = []
    for result in (found, room()):
        of_views = zip(result.maps, photographed_room(), strict=True)
        pixels = [maps["diffuse_albedo"][of_face(view, "south")] for maps, view in of_views]
        medians.append(np.median(np.concatenate(pixels).astype(np.float64)))
    return medians[0] / medians[1]


@pytest.mark.usefixtures("mitsuba_variant")
def test_unexplained_surface_gets_the_scale_of_the_room(monkeypatch: pytest.MonkeyPatch) -> None:
    assert south_wall(1.0, monkeypatch) == pytest.approx(0.95, abs=0.06)


@pytest.mark.usefixtures("mitsuba_variant")
def test_light_without_weight_has_no_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    assert south_wall(0.0, monkeypatch) == pytest.approx(0.5, abs=0.01)


@pytest.mark.usefixtures("mitsuba_variant")
@pytest.mark.parametrize(
    ("diffuse", "white", "expected"),
    [
        (0.3, White(), 0.6),
        (0.6, White(), TYPICAL_WHITE),
        (0.9, White(), 0.9),
        (0.9, White(0.8, 1.0), 0.8),
        (0.9, White(0.8, 0.5), 0.85),
    ],
)
def test_scaled_prediction_is_no_whiter_than_paint(diffuse: float, white: White, expected: float) -> None:
    """The limit lowers unscaled predictions of the network only as far as the room's white is known."""
    found = unknown_albedo(diffuse, 2, lighting=0.01, white=white)[0]
    np.testing.assert_allclose(found, expected, atol=2e-3)


@pytest.mark.usefixtures("mitsuba_variant")
def test_prediction_does_not_exceed_the_recorded_light() -> None:
    found, of_light = unknown_albedo(0.8, 1)
    assert (of_light < 0.5).mean() > 0.5
    error = np.abs(found - np.minimum(0.8, MAX_EXCESS * of_light))
    assert np.quantile(error, 0.95) < 0.02  # irradiance is interpolated between surfels


def unknown_albedo(
    diffuse: float, prior_scale: float, lighting: float = 1.0, white: White = White()
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Diffuse albedo (K, 3) of a view's surfaces without trust in light, and pi times the radiance over the
    irradiance (K, 3), for a prediction of ``diffuse``; ``lighting`` multiplies the irradiance.
    """
    view, surfels, known = photographed_room()[0], room().lit.surfels, room().solved
    unknown = replace(
        known,
        diffuse=lighting * known.diffuse,
        replaced=np.zeros_like(known.replaced),
        prior_scale=np.full((len(surfels), 3), prior_scale, np.float32),
        white=white,
    )
    maps = view_materials(surfels, unknown, 0, view, predicted((view,), diffuse)[0])
    own = surfels.pixel_surfel[0].reshape(view.color.shape[:2])
    on_surface = own >= 0
    of_light = view.color[on_surface] / np.maximum(unknown.diffuse[own[on_surface]], 1e-9)
    return maps["diffuse_albedo"][on_surface].astype(float), of_light
