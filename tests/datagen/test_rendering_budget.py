# SPDX-License-Identifier: MIT
"""Rendering to an error target: recipes, the estimate from two halves, ceilings, clamp, reproducibility."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from datagen.formats.base import parse_model, read_yaml
from datagen.formats.configuration import PlacedAsset
from datagen.formats.lights import EnvironmentLight
from datagen.formats.recipe import QUALITIES, Recipe, RenderRecipe
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.color import exposure_for, luminance
from datagen.foundation.errors import InputError
from datagen.library import Library
from datagen.rendering.clamped_light import missing_error
from datagen.rendering.error import relative_mse
from datagen.rendering.renderer import SceneRenderer
from datagen.rendering.sample_budget import (
    BIAS_PER_SPREAD,
    FIRST_SAMPLES,
    MIN_ADDED,
    QUICK_BIAS_PER_SPREAD,
    TILE_PX,
    ErrorEstimate,
    PathSums,
    SampleBudget,
    estimate_error,
)
from datagen.rendering.transport.integrator import PathTracer
from datagen.rendering.view_job import QUICK_SAMPLES
from oracles.rendering_scenes import configure, renderer
from tests.datagen.test_rendering_renderer import CAMERAS, LIGHTS, OBJECTS, box_room, digest

# ---------------------------------------------------------------------- recipes


def render(**fields: Any) -> RenderRecipe:
    return parse_model(RenderRecipe, fields, "recipe.yaml")


def test_a_quality_resolves_to_numbers_that_resolve_to_themselves(tmp_path: Path) -> None:
    for name, numbers in QUALITIES.items():
        path = tmp_path / f"{name}.yaml"
        path.write_text(f"name: a\nconfigurations: 1\nviews: 2\nrender: {{quality: {name}}}\n")
        recipe = read_yaml(Recipe, path)
        assert numbers.items() <= recipe.render.model_dump().items()
        assert recipe.render.quality is None and recipe.render.path_samples is None
        assert parse_model(Recipe, recipe.model_dump(mode="json"), "saved") == recipe
    assert render(quality="draft", max_path_samples=64).max_path_samples == 64
    assert render(quality="standard", firefly_clamp=None).firefly_clamp is None
    assert render().path_samples == 8 and render().max_depth == 8
    assert render(max_rel_mse=0.01).max_path_samples == 1024 and render(max_rel_mse=0.01).path_samples is None
    assert QUALITIES["reference"]["firefly_clamp"] is None


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"quality": "draft", "path_samples": 3}, "either quality or path_samples"),
        ({"quality": "draft", "max_rel_mse": 0.01}, "either quality or max_rel_mse"),
        ({"quality": "reference", "firefly_clamp": 9}, "no firefly_clamp with quality reference"),
        ({"path_samples": 3, "max_rel_mse": 0.1}, "either path_samples, a fixed number, or max_rel_mse"),
        ({"path_samples": 3, "max_path_samples": 8}, "either path_samples, a fixed number, or max_path_sam"),
        ({"max_path_samples": 8}, "max_path_samples only with max_rel_mse or quality"),
        ({"max_depth": 3, "max_energy_left": 0.1}, "either max_depth or max_energy_left"),
        ({"quality": "best"}, "'draft', 'standard' or 'reference'"),
        ({"max_rel_mse": 0.0}, "greater than 0"),
        ({"max_rel_mse": 0.1, "max_path_samples": 1}, "greater than or equal to 2"),
        ({"denoise": None}, "valid boolean"),
    ],
)
def test_contradictory_settings_are_refused(fields: dict[str, Any], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        render(**fields)


# ---------------------------------------------------------------------- the estimate

Image = NDArray[np.float32]
SIZE = (96, 128)
NUM_TRIALS = 12


def blur(image: Image, width: int) -> Image:
    """Denoise with known bias: by the mean over ``width`` x ``width`` pixels, mirrored at the border."""
    from scipy.ndimage import uniform_filter

    return uniform_filter(image, (width, width, 0), mode="mirror").astype(np.float32)


def truth() -> Image:
    """Return an image of coloured stripes, which blurring degrades, with brightness increasing downwards."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    stripes = 1.0 + 0.3 * np.sin(columns[..., None] * np.array([0.15, 0.2, 0.3]))
    return (stripes * (0.2 + rows[..., None] / SIZE[0])).astype(np.float32)


def noisy_pair(rng: np.random.Generator, sigma: float, shared: float = 0.0) -> tuple[Image, Image]:
    """Return two images of relative noise ``sigma``; a part ``shared`` of its variance is common to both."""
    noise = rng.normal(0.0, sigma, (3, *SIZE, 3))
    own, common = math.sqrt(1 - shared), math.sqrt(shared)
    a, b = (truth() * (1 + own * n + common * noise[2]) for n in noise[:2])
    return a.astype(np.float32), b.astype(np.float32)


def estimated_and_true(width: int, sigma: float, shared: float = 0.0) -> NDArray[np.float64]:
    """Return the estimated and the true relMSE (trials, 2) of the mean of two denoised images."""
    rng = np.random.default_rng(5)
    black = np.zeros((*SIZE, 3), np.float32)
    pairs = []
    for _ in range(NUM_TRIALS):
        a, b = noisy_pair(rng, sigma, shared)
        clean = (blur(a, width), blur(b, width))
        estimate = estimate_error((a, b), clean, black)
        pairs.append((estimate.rel_mse, relative_mse(0.5 * (clean[0] + clean[1]), truth(), exposed=True)))
    return np.array(pairs)


@pytest.mark.parametrize(("width", "sigma"), [(3, 0.3), (9, 0.3), (15, 0.3), (1, 0.1)])
def test_estimate_includes_spread_and_bias_of_a_denoiser(width: int, sigma: float) -> None:
    estimated, true = estimated_and_true(width, sigma).mean(axis=0)
    assert estimated == pytest.approx(true, rel=0.1)


@pytest.mark.parametrize(("width", "sigma", "is_used"), [(25, 3.0, True), (15, 0.1, False)])
def test_prior_of_the_bias_replaces_uncertain_measurements(width: int, sigma: float, is_used: bool) -> None:
    a, b = noisy_pair(np.random.default_rng(3), sigma)
    clean, black = (blur(a, width), blur(b, width)), np.zeros_like(a)
    low, high = (estimate_error((a, b), clean, black, bias_per_spread=prior) for prior in (0.5, 1.0))
    added = high.rel_mse - low.rel_mse
    assert (added > 0.2 * low.spread) if is_used else abs(added) < 0.01 * low.rel_mse


def test_dependent_halves_bias_the_estimate() -> None:
    """Injected fault: noise common to both halves is mistaken for bias of the denoiser."""
    estimated, true = estimated_and_true(3, 0.3, shared=0.5).mean(axis=0)
    assert estimated > 2 * true


def test_without_a_denoiser_the_error_is_the_spread() -> None:
    a, b = noisy_pair(np.random.default_rng(1), 0.2)
    estimate = estimate_error((a, b), (a, b), np.zeros_like(a))
    assert estimate.rel_mse == pytest.approx(relative_mse(0.5 * (a + b), truth(), exposed=True), rel=0.1)


def test_estimate_does_not_depend_on_brightness() -> None:
    a, b = noisy_pair(np.random.default_rng(2), 0.3)
    black = np.zeros_like(a)
    dim = [np.float32(1e-4) * image for image in (a, b, blur(a, 5), blur(b, 5))]
    bright = estimate_error((a, b), (blur(a, 5), blur(b, 5)), black)
    assert estimate_error((dim[0], dim[1]), (dim[2], dim[3]), black).rel_mse == pytest.approx(
        bright.rel_mse, rel=1e-4
    )


def test_black_image_has_no_error_and_missing_light_counts() -> None:
    black = np.zeros((32, 32, 3), np.float32)
    assert estimate_error((black, black), (black.copy(), black.copy()), black).rel_mse == 0.0
    nothing = (black[..., 0], black[..., 0])
    assert estimate_error((black, black), (black.copy(), black.copy()), black, nothing).rel_mse == 0.0
    white = np.ones_like(black)
    lost = np.zeros((32, 32))
    lost[16, 16] = 100.0  # a single firefly, whose light is not restored
    for removed in ((lost, lost), (lost, 0 * lost)):
        estimate = estimate_error((white, white), (white.copy(), white.copy()), black, removed)
        expected = missing_error(luminance(white), removed, exposure_for(white))
        assert estimate.rel_mse == pytest.approx(expected)
        assert (estimate.rel_mse > 0.01) == removed[1].any()


def test_heavy_tailed_noise_does_not_meet_the_target() -> None:
    """With rare bright samples, as behind a door ajar, the budget never counts a missed target as met."""
    rng = np.random.default_rng(3)
    black = np.zeros((*SIZE, 3), np.float32)
    budget, met, fell_short = SampleBudget(0.05, 8), 0, 0
    for _ in range(20):
        a, b = ((truth() * rng.binomial(1, 0.005, (*SIZE, 1)) / 0.005).astype(np.float32) for _ in range(2))
        clean = (blur(a, 41), blur(b, 41))
        estimate = estimate_error((a, b), clean, black)
        true = relative_mse(0.5 * (clean[0] + clean[1]), truth(), exposed=True)
        met += budget.is_met(estimate)
        fell_short += budget.is_met(estimate) and true > budget.max_rel_mse
    assert fell_short == 0, (met, fell_short)


def estimate_of(error: float, spread: NDArray[np.float64] | float = 0.0) -> ErrorEstimate:
    spread_map = np.broadcast_to(np.asarray(spread, np.float32), SIZE)
    return ErrorEstimate(error, 0.0, float(spread_map.mean()), 0.0, 0.0, spread_map)


def test_passes_triple_until_target_or_ceiling() -> None:
    def totals(budget: SampleBudget, met_at: int) -> Iterator[float]:
        counts = (added := budget.first_counts(SIZE))
        while added.any():
            yield 2 * counts.mean()
            error = 10 * budget.max_rel_mse if 2 * counts.mean() < met_at else 0.9 * budget.max_rel_mse
            counts = counts + (added := budget.next_counts(counts, estimate_of(error, 0.1)))

    assert list(totals(SampleBudget(0.01, 1000), met_at=70)) == [4, 12, 36, 108]
    assert list(totals(SampleBudget(0.01, 45), met_at=70)) == [4, 12, 36, 44]
    assert list(totals(SampleBudget(0.01, 12), met_at=30)) == [4, 12]
    assert list(totals(SampleBudget(0.01, 11), met_at=30)) == [10]
    assert list(totals(SampleBudget(0.01, 2), met_at=30)) == [2]
    assert list(totals(SampleBudget(0.01, 1000), met_at=1)) == [4]


def test_samples_are_spent_where_the_halves_differ() -> None:
    """Squared errors fall as 1 / samples, so counts proportional to their square roots minimise their sum."""
    bright = (np.arange(SIZE[1]) // TILE_PX == 3) & (np.arange(SIZE[0])[:, None] // TILE_PX == 2)
    counts = np.full(SIZE, 64, np.int64)
    added = SampleBudget(0.001, 4096).next_counts(counts, estimate_of(0.01, np.where(bright, 16.0, 1.0)))
    assert np.unique(added[bright]) == 3 * 64  # the maximum of a pass
    far = ~ndimage.binary_dilation(bright, iterations=TILE_PX, structure=np.ones((3, 3)))
    assert 64 < np.unique(added[far]).item() < 128 and added.mean() <= 128
    assert (added[~far] >= added[far].max()).all() and added[~far].mean() > added[far].max()
    missed = np.where(bright, 1.0, 0.0)  # pixels that have found no light get some samples, too
    counts[bright] = 512
    assert (SampleBudget(0.001, 4096).next_counts(counts, estimate_of(0.01, missed))[~bright] > 0).all()


def test_a_near_target_needs_few_samples() -> None:
    counts = np.full(SIZE, 64, np.int64)
    near, far = (SampleBudget(0.01, 4096).next_counts(counts, estimate_of(e, 0.1)) for e in (0.011, 0.1))
    assert near.mean() == 16 and far.mean() == 128


def test_passes_are_no_shorter_than_an_error_estimate() -> None:
    """A quarter of the present two samples would suffice, but takes less time than an error estimate."""
    errors = np.random.default_rng(1).exponential(1.0, SIZE)
    added = SampleBudget(0.01, 4096).next_counts(np.full(SIZE, 2, np.int64), estimate_of(0.0101, errors))
    assert MIN_ADDED / 2 < added.mean() <= MIN_ADDED


# ---------------------------------------------------------------------- different counts in one image


def test_pixels_of_different_counts_have_the_same_expectation(budgeted: SceneRenderer) -> None:
    """Pixels of few and of many samples agree in the mean, and noise falls with the counts."""
    sensor = budgeted.sensor(CAMERAS[1])
    width, height = (int(v) for v in sensor.film().crop_size())
    counts = np.full((height, width), 8, np.int64)
    counts[:, width // 2 :] = 72
    counts[0, 0] = 0
    sums = budgeted.tracer.accumulate(sensor, counts, 3)
    assert (sums.counts == counts).all() and not sums.radiance[0, 0].any()
    uniform = [budgeted.tracer.accumulate(sensor, 40, seed).mean() for seed in (4, 5)]
    left, right = np.s_[1:, : width // 2], np.s_[:, width // 2 :]
    errors = []
    for half in (left, right):
        image = sums.radiance[half] / counts[half][..., None]
        assert image.mean() == pytest.approx(np.mean([u[half].mean() for u in uniform]), rel=0.05)
        errors.append(((image - uniform[0][half]) * (image - uniform[1][half])).mean())
    assert errors[0] > 3 * errors[1]


# ---------------------------------------------------------------------- rendering


def make(root: Path, **fields: Any) -> SceneRenderer:
    shutil.rmtree(root, ignore_errors=True)
    return renderer(
        root, box_room(), CAMERAS, render(auxiliary_samples=16, **fields), lights=LIGHTS, objects=OBJECTS
    )


@pytest.fixture(scope="module")
def budgeted(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> SceneRenderer:
    return make(
        tmp_path_factory.mktemp("budget") / "room", max_rel_mse=0.01, max_path_samples=256, firefly_clamp=30
    )


def test_target_is_met_and_recorded(budgeted: SceneRenderer) -> None:
    record = (view := budgeted.render_view(1)).render
    assert record.estimated_rel_mse is not None and 0 < record.estimated_rel_mse <= 0.01
    assert not record.at_ceiling and 4 < record.path_samples < 256
    assert record.most_path_samples is not None and record.most_path_samples >= record.path_samples
    assert set(view.seconds) == {"path", "buffers", "estimate", "denoise"}
    sensor = budgeted.sensor(CAMERAS[1])
    pair = [budgeted.tracer.render(sensor, 512, seed) for seed in (71, 72)]
    true = relative_mse(view.buffers["beauty"], *pair, exposed=True)
    assert 0.3 * record.estimated_rel_mse < true < 2 * record.estimated_rel_mse


def test_record_is_compared_with_the_target(budgeted: SceneRenderer) -> None:
    """The recorded error includes the standard error, since an estimate that stops a view tends to be low."""
    for passes in (1, 3):
        job = budgeted.view_job(1)
        for _ in range(passes):
            job.add_pass(4)
        estimate, record = job.estimate_error(), job.finish().render
        assert estimate.standard_error > 0.01 * estimate.rel_mse
        assert record.estimated_rel_mse == pytest.approx(estimate.rel_mse + estimate.standard_error, rel=1e-3)
        assert record.at_ceiling == (record.estimated_rel_mse > 0.01)


def test_ceiling_is_kept_and_recorded(tmp_path: Path) -> None:
    record = make(tmp_path / "room", max_rel_mse=1e-6, max_path_samples=11).render_view(1).render
    assert record.at_ceiling and 4 < record.path_samples <= 11
    assert record.estimated_rel_mse is not None and record.estimated_rel_mse > 1e-6


def test_budgeted_views_do_not_depend_on_order_or_other_views(budgeted: SceneRenderer) -> None:
    """A view has the same bytes and record if rendered alone, as after an interruption."""
    together = list(budgeted.render_views([2, 0, 1]))
    assert [view.index for view in together] == [2, 0, 1]
    alone = budgeted.render_view(0)
    assert digest(alone) == digest(together[1])
    assert alone.render == together[1].render


def test_a_view_with_enough_samples_stops_and_is_finished(tmp_path: Path) -> None:
    """A view that ``is_enough`` accepts stops after one pass, far above its error target."""
    asked: list[tuple[int, tuple[int, ...], float]] = []

    def is_enough(index: int, image: NDArray, estimate: ErrorEstimate) -> bool:
        asked.append((index, image.shape, estimate.rel_mse))
        return True

    whole = make(tmp_path / "room", max_rel_mse=1e-4, max_path_samples=256)
    recipe, library = whole.recipe, Library([tmp_path / "room"])
    plain = render(path_samples=FIRST_SAMPLES, auxiliary_samples=16)
    stops = SceneRenderer(whole.configuration, library, recipe, is_enough=is_enough)
    view = stops.render_view(1)
    assert [row[:2] for row in asked] == [(1, (32, 48, 3))] and asked[0][2] > 1e-4
    assert view.render.path_samples == FIRST_SAMPLES
    images = [SceneRenderer(whole.configuration, library, plain).render_view(1), whole.render_view(1)]
    errors = [relative_mse(v.buffers["beauty"], images[1].buffers["beauty"]) for v in (view, images[0])]
    assert errors[0] == pytest.approx(errors[1], rel=0.5)
    stops.close()


def test_views_of_few_samples_are_denoised_quickly(tmp_path: Path) -> None:
    first = make(tmp_path / "first", max_rel_mse=1.0, max_path_samples=64).render_view(0).render
    assert first.denoiser.endswith("balanced") and first.path_samples == FIRST_SAMPLES
    assert first.estimated_rel_mse is not None
    target = 0.8 * first.estimated_rel_mse
    second = make(tmp_path / "second", max_rel_mse=target, max_path_samples=64).render_view(0).render
    assert second.denoiser.endswith("balanced") and FIRST_SAMPLES < second.path_samples <= QUICK_SAMPLES
    assert second.estimated_rel_mse is not None and second.estimated_rel_mse <= target


@pytest.mark.parametrize("ceiling", [QUICK_SAMPLES, 2 * QUICK_SAMPLES])
def test_views_above_their_target_are_denoised_well(tmp_path: Path, ceiling: int) -> None:
    record = make(tmp_path / "room", max_rel_mse=1e-4, max_path_samples=ceiling).render_view(0).render
    assert record.denoiser.endswith("high")
    assert record.path_samples == ceiling and record.at_ceiling


def test_the_prior_of_the_bias_depends_on_the_denoiser(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    priors: list[float] = []

    def noted(*arguments: Any) -> ErrorEstimate:
        priors.append(arguments[-1])
        return estimate_error(*arguments)

    monkeypatch.setattr("datagen.rendering.view_job.estimate_error", noted)
    make(tmp_path / "room", max_rel_mse=1e-4, max_path_samples=2 * QUICK_SAMPLES).render_view(0)
    assert (priors[0], priors[-1]) == (QUICK_BIAS_PER_SPREAD, BIAS_PER_SPREAD)


def test_another_seed_equals_a_separate_renderer(tmp_path: Path) -> None:
    fields = {"max_rel_mse": 0.05, "max_path_samples": 64, "irradiance_cache": True}
    first = make(tmp_path / "room", **fields)
    before = digest(first.render_view(0))
    first.reseed(17)
    other = first.configuration.model_copy(update={"seed": 17})
    alone = SceneRenderer(other, Library([tmp_path / "room"]), first.recipe)
    assert before != digest(first.render_view(0)) == digest(alone.render_view(0))


def test_halves_of_a_view_are_independent(budgeted: SceneRenderer) -> None:
    view = budgeted.view_job(1)
    for count in (8, 24):
        view.add_pass(count)
    sensor = budgeted.sensor(CAMERAS[1])
    converged = [budgeted.tracer.accumulate(sensor, 512, seed).mean() for seed in (5, 6)]
    lit = (converged[0] > 0).all(axis=-1)  # some pixels show no surface

    def correlation(*halves: PathSums) -> float:
        """Return the rank correlation of two images' relative noise, measured against separate references.
        For independent noise its standard deviation is 1 / sqrt(pixels)."""
        noise = [
            luminance(half.mean() - image)[lit] / luminance(image)[lit]
            for half, image in zip(halves, converged, strict=True)
        ]
        return float(np.corrcoef(*(values.argsort().argsort() for values in noise))[0, 1])

    assert [half.mean_samples for half in view.halves] == [32, 32] and lit.sum() > 800
    assert abs(correlation(*view.halves)) < 4.5 / math.sqrt(lit.sum())
    shared = view.halves[0] + view.halves[1]
    assert correlation(shared, view.halves[1]) > 0.5  # injected fault: halves share samples


def test_recorded_kernels_serve_every_call(budgeted: SceneRenderer) -> None:
    """Cameras, image sizes, sample counts and clamps are inputs of the recorded kernels, not constants."""
    tracer = budgeted.tracer
    counts = np.full((CAMERAS[0].height_px, CAMERAS[0].width_px), 2, np.int64)
    counts[::3] = 6
    calls: list[dict[str, Any]] = [
        {"sensor": 0, "num_samples": 3, "seed": 1},
        {"sensor": 1, "num_samples": counts, "seed": 2},
        {"sensor": 2, "num_samples": 5, "seed": 3, "grid": (7, 5)},
        {"sensor": 0, "num_samples": 1, "seed": 4, "with_visible_emission": True},
        {"sensor": 1, "num_samples": 4, "seed": 5, "limit": 0.5},
        {"sensor": CAMERAS[0].scaled(20, 12), "num_samples": 4, "seed": 6},
    ]

    def results(is_fresh: bool) -> Iterator[PathSums]:
        for call in calls:
            if is_fresh:
                tracer.forget_recordings()
            chosen = call["sensor"]
            camera = CAMERAS[chosen] if isinstance(chosen, int) else chosen
            yield tracer.accumulate(**{**call, "sensor": budgeted.sensor(camera)})

    for played, fresh in zip(results(False), results(True), strict=True):
        assert (played.radiance == fresh.radiance).all() and played.radiance.any()
        assert (played.removed_luminance == fresh.removed_luminance).all()


def test_concurrently_open_scenes_are_independent(budgeted: SceneRenderer, tmp_path: Path) -> None:
    """Kernels of one scene neither block those of another nor use its lights."""
    recipe = render(path_samples=2, auxiliary_samples=4, denoise=False)
    sky = EnvironmentLight(name="sky", radiance=(0.5, 1.0, 2.0))
    dark = renderer(tmp_path / "dark", box_room(), CAMERAS, recipe, objects=OBJECTS, lights=())
    bright = renderer(tmp_path / "bright", box_room(), CAMERAS, recipe, lights=(sky,), objects=OBJECTS)
    first = {scene: digest(scene.render_view(0)) for scene in (bright, dark, budgeted)}
    for scene in (dark, budgeted, bright, dark):
        assert digest(scene.render_view(0)) == first[scene]
    assert not dark.render_view(0).buffers["beauty"].any()


# ---------------------------------------------------------------------- clamp


def test_clamp_removes_the_recorded_light(budgeted: SceneRenderer) -> None:
    sensor = budgeted.sensor(CAMERAS[1])
    free = budgeted.tracer.accumulate(sensor, 32, 9)
    limit = 0.05 / exposure_for(free.radiance / 32)
    clamped = budgeted.tracer.accumulate(sensor, 32, 9, limit=limit)
    assert free.removed_luminance.sum() == 0.0 and free.removed_share() == 0.0
    assert 0.02 < clamped.removed_share() < 0.9
    kept, taken = luminance(clamped.radiance), clamped.removed_luminance
    assert kept + taken == pytest.approx(luminance(free.radiance), rel=1e-4, abs=1e-4)
    removed = 1 - kept.sum() / luminance(free.radiance).sum()
    assert clamped.removed_share() == pytest.approx(removed, rel=1e-3)


def test_clamp_keeps_direct_light(budgeted: SceneRenderer) -> None:
    """With a clamp near zero, only light after a single bounce remains."""
    sensor = budgeted.sensor(CAMERAS[1])
    clamped = budgeted.tracer.accumulate(sensor, 32, 9, limit=1e-9)
    short = PathTracer(budgeted.built, budgeted.materials, 2, 5).accumulate(sensor, 32, 9)
    # Only the random numbers from the second vertex on differ.
    assert clamped.radiance == pytest.approx(short.radiance, rel=1e-4, abs=1e-4)
    assert clamped.removed_share() > 0.1


def test_clamp_is_relative_to_exposure_recorded_and_restored(tmp_path: Path) -> None:
    tight = make(tmp_path / "room", path_samples=16, firefly_clamp=0.5, denoise=False, keep_noisy=True)
    view = tight.render_view(1)
    noisy, beauty = (float(luminance(view.buffers[name]).mean()) for name in ("beauty_noisy", "beauty"))
    reflected = noisy - float(luminance(tight.view_job(1).visible_emission).mean())
    removed = view.render.clamped_energy / (1.0 - view.render.clamped_energy) * reflected
    assert beauty - noisy == pytest.approx(removed, rel=0.15)
    white = 1 / exposure_for(view.buffers["beauty"])
    assert view.render.firefly_clamp_radiance == pytest.approx(0.5 * white, rel=0.15)
    assert 0.001 < view.render.clamped_energy < 0.5
    sums = tight.view_job(1)
    sums.add_pass(16)
    assert view.render.clamped_energy == pytest.approx(sums.halves[0].removed_share(), rel=1e-3)


def test_reference_quality_clamps_nothing(tmp_path: Path) -> None:
    record = make(tmp_path / "room", quality="reference", max_path_samples=4).render_view(0).render
    assert record.firefly_clamp_radiance is None and record.clamped_energy == 0.0


# ---------------------------------------------------------------------- easy and hard light


def ajar(shared_data: Path, root: Path, recipe: RenderRecipe, size: tuple[int, int]) -> SceneRenderer:
    """Return a renderer of Veach's scene of a door ajar, through which all light enters."""
    from datagen.formats.asset import EnvironmentAsset
    from datagen.importers.common import ImportOptions
    from datagen.importers.mitsuba_xml import import_mitsuba_scene

    import_mitsuba_scene(
        shared_data / "scenes" / "veach-ajar" / "scene.xml",
        root,
        ImportOptions(dielectric="replace", missing="replace"),
    )
    library = Library([root])
    (package,) = library.select("environment", for_training=False)
    assert isinstance(package.asset, EnvironmentAsset)
    focal = 0.85 * size[0]
    pose = np.array(package.asset.cameras[0].asset_from_camera)
    camera = Camera(*size, focal, focal, size[0] / 2, size[1] / 2, pose)
    placed_room = PlacedAsset(name=package.id, asset=package.id)
    configuration = configure(library, [camera], environment=placed_room, lights=package.asset.lights)
    return SceneRenderer(configuration, library, recipe)


@pytest.mark.slow
def test_easy_and_hard_light_get_similar_errors(
    shared_data: Path, tmp_path: Path, mitsuba_variant: str
) -> None:
    size, target = (64, 40), 0.01
    recipe = render(max_rel_mse=target, max_path_samples=4096, auxiliary_samples=32)
    sky = EnvironmentLight(name="sky", radiance=(1.0, 1.0, 1.0))
    easy_camera = Camera(*size, 48, 48, 32, 20, look_at([0.0, -1.8, 1.2], [0.0, 0.3, 0.5]))
    easy = renderer(tmp_path / "easy", box_room(), [easy_camera], recipe, lights=(sky,), objects=OBJECTS)
    hard = ajar(shared_data, tmp_path / "hard", recipe, size)
    samples, errors = [], []
    for scene in (easy, hard):
        view = scene.render_view(0)
        assert not view.render.at_ceiling
        sensor = scene.sensor(scene.configuration.cameras[0].camera())
        pair = [scene.tracer.render(sensor, 2048, seed) for seed in (81, 82)]
        errors.append(relative_mse(view.buffers["beauty"], *pair, exposed=True))
        samples.append(view.render.path_samples)
    print(f"samples {samples}, true errors {errors}")
    assert samples[1] >= 8 * samples[0]
    assert max(errors) < 2 * target and max(errors) < 4 * min(errors)
