# SPDX-License-Identifier: MIT
"""The renderer: buffers, reproducible bytes, agreement with Mitsuba's path tracer, and the denoiser."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.formats.asset import SlotMaterial
from datagen.formats.configuration import PlacedAsset
from datagen.formats.lights import AreaLight, EnvironmentLight, PointLight
from datagen.formats.recipe import RenderRecipe
from datagen.foundation.buffers import BUFFERS, RENDERED_BUFFERS
from datagen.foundation.cameras import Camera, look_at
from datagen.foundation.errors import InputError
from datagen.foundation.exr import to_storage
from datagen.library import Library
from datagen.rendering import denoiser
from datagen.rendering.denoiser import OidnDenoiser, auxiliary_albedo, make_denoiser
from datagen.rendering.prepared_scene import view_seed
from datagen.rendering.renderer import SceneRenderer
from datagen.rendering.view_job import RenderedView
from oracles.rendering_scenes import GREY, SmallScene, box, placed, quad, renderer
from tests.conftest import REPOSITORY

pytestmark = pytest.mark.usefixtures("mitsuba_variant")

LIGHTS = (
    AreaLight(
        name="ceiling", origin_m=(-0.5, -0.5, 1.9), edge_u_m=(0, 1, 0), edge_v_m=(1, 0, 0), radiance=(9, 8, 7)
    ),
    PointLight(name="bulb", position_m=(0.8, -0.8, 1.0), intensity=(0.5, 0.4, 0.3)),
)
CAMERAS = [Camera(48, 32, 40, 40, 24, 16, look_at([x, -1.8, 1.2], [0.0, 0.3, 0.5])) for x in (-0.6, 0.0, 0.6)]
RECIPE = RenderRecipe(path_samples=6, auxiliary_samples=16, keep_noisy=True)


def box_room() -> SmallScene:
    """Return a room that is open towards -y, with one coloured wall and a glossy box as an object."""
    grey = GREY.model_copy(update={"specular_albedo": (0.04, 0.04, 0.04), "roughness": 0.5})
    parts = {
        "floor": (quad([-2, -2, 0], [4, 0, 0], [0, 4, 0]), "grey"),
        "ceiling": (quad([-2, 2, 2], [4, 0, 0], [0, -4, 0]), "grey"),
        "back": (quad([-2, 2, 0], [4, 0, 0], [0, 0, 2]), "grey"),
        "left": (quad([-2, -2, 0], [0, 4, 0], [0, 0, 2]), "red"),
        "right": (quad([2, 2, 0], [0, -4, 0], [0, 0, 2]), "grey"),
    }
    slots = {"grey": grey, "red": grey.model_copy(update={"diffuse_albedo": (0.6, 0.1, 0.1)})}
    glossy = SlotMaterial(diffuse_albedo=(0.05, 0.05, 0.1), specular_albedo=(0.7, 0.6, 0.4), roughness=0.35)
    return SmallScene(parts, slots, objects={"box": (box(0.5), glossy)})


OBJECTS = (
    PlacedAsset(name="box-1", asset="box", world_from_asset=placed(-0.5, 0.5, 0.3)),
    PlacedAsset(name="box-2", asset="box", world_from_asset=placed(0.6, 0.2, 0.8, 1.5)),
)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> SceneRenderer:
    return renderer(
        tmp_path_factory.mktemp("room"), box_room(), CAMERAS, RECIPE, lights=LIGHTS, objects=OBJECTS
    )


def digest(view: RenderedView) -> str:
    """Return the SHA-256 hash of a view's buffers as stored."""
    parts = [name.encode() + to_storage(BUFFERS[name], view.buffers[name]).tobytes() for name in view.buffers]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def test_view_holds_the_registered_buffers(room: SceneRenderer) -> None:
    view = room.render_view(1)
    assert set(view.buffers) == {*RENDERED_BUFFERS, "beauty_noisy"}
    for name, array in view.buffers.items():
        buffer = BUFFERS[name]
        assert array.shape == (32, 48, buffer.num_channels), name
        assert array.min() >= buffer.minimum and array.max() <= buffer.maximum, name
    normal = view.buffers["normal_world"][view.buffers["surface_mask"][..., 0] == 1]
    assert np.linalg.norm(normal, axis=-1) == pytest.approx(1.0, abs=1e-5)
    assert view.render.path_samples == 6 and view.render.denoiser.startswith("oidn")
    assert view.render.seed == view_seed(3, 1, "path")
    assert set(view.seconds) == {"path", "buffers", "denoise"}


def test_order_and_overlap_do_not_change_a_view(room: SceneRenderer) -> None:
    alone = digest(room.render_view(2))
    overlapped = {view.index: digest(view) for view in room.render_views([1, 2, 0])}
    assert list(overlapped) == [1, 2, 0]
    assert overlapped[2] == alone
    assert len(set(overlapped.values())) == 3


_OTHER_PROCESS = """
import json, sys
import drjit as dr
from pathlib import Path
from mitsuba_plugins.variant import select_variant
folder, configuration, recipe, variant = sys.argv[1:]
select_variant(variant)
dr.set_thread_count(1)
from datagen.formats.base import parse_model
from datagen.formats.configuration import Configuration
from datagen.formats.recipe import RenderRecipe
from datagen.library import Library
from datagen.rendering.denoiser import OidnDenoiser
from datagen.rendering.renderer import SceneRenderer
from tests.datagen.test_rendering_renderer import digest
renderer = SceneRenderer(
    parse_model(Configuration, json.loads(configuration), "argument"),
    Library([Path(folder)]),
    parse_model(RenderRecipe, json.loads(recipe), "argument"),
    denoiser=OidnDenoiser(num_threads=1),
)
views = renderer.render_views([2, 0])
print(json.dumps({view.index: [digest(view), view.render.model_dump_json()] for view in views}))
"""


@pytest.mark.parametrize("budget", ["samples", "error"])
def test_another_process_with_one_thread_makes_the_same_bytes(tmp_path: Path, budget: str) -> None:
    error = RenderRecipe(max_rel_mse=0.01, max_path_samples=64, firefly_clamp=30, auxiliary_samples=16)
    recipe = RECIPE if budget == "samples" else error
    made = renderer(tmp_path, box_room(), CAMERAS, recipe, lights=LIGHTS, objects=OBJECTS)
    rendered = SceneRenderer(made.configuration, Library([tmp_path]), recipe, denoiser=OidnDenoiser())
    models = (rendered.configuration, recipe)
    arguments = [str(tmp_path), *(model.model_dump_json() for model in models), rendered.variant]
    result = subprocess.run(
        [sys.executable, "-c", _OTHER_PROCESS, *arguments],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-2000:]
    other = json.loads(result.stdout.splitlines()[-1])
    here = [rendered.render_view(k) for k in (2, 0)]
    assert other == {str(v.index): [digest(v), v.render.model_dump_json()] for v in here}


@pytest.fixture(scope="module")
def both_estimators(room: SceneRenderer) -> tuple[np.ndarray, np.ndarray]:
    """Return means (N, 3) of independent images by the project's path tracer and by Mitsuba's ``path``."""
    import mitsuba as mi

    sensor = room.sensor(CAMERAS[1])
    integrator: Any = mi.load_dict({"type": "path", "max_depth": 8, "rr_depth": 5})
    own = [room.tracer.render(sensor, 96, 1000 + seed) for seed in range(12)]
    other = [
        np.array(mi.render(room.built.scene, sensor=sensor, integrator=integrator, spp=96, seed=seed))
        for seed in range(12)
    ]
    return (
        np.array([image.astype(np.float64).mean(axis=(0, 1)) for image in own]),
        np.array([image[..., :3].astype(np.float64).mean(axis=(0, 1)) for image in other]),
    )


def z_scores(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the difference of the means, divided by its standard error, per channel."""
    variance = own.var(axis=0, ddof=1) / len(own) + other.var(axis=0, ddof=1) / len(other)
    return (own.mean(axis=0) - other.mean(axis=0)) / np.sqrt(variance)


def test_estimator_agrees_with_mitsubas_path(both_estimators: tuple[np.ndarray, np.ndarray]) -> None:
    # 4.5 sigma in 3 channels, by Student's t with 22 degrees of freedom: false alarms in 0.05 % of runs
    assert np.abs(z_scores(*both_estimators)).max() < 4.5


def test_five_percent_more_light_is_detected(both_estimators: tuple[np.ndarray, np.ndarray]) -> None:
    own, other = both_estimators
    assert np.abs(z_scores(own, 1.05 * other)).min() > 4.5


def test_launches_of_many_samples_continue_the_sequence(
    room: SceneRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    from datagen.rendering.transport import integrator

    sensor = room.sensor(CAMERAS[1])
    whole = room.tracer.render(sensor, 64, 9)
    monkeypatch.setattr(integrator, "MAX_LANES", 48 * 32 * 16)
    split = room.tracer.render(sensor, 64, 9)
    # Embree rounds a ray's hit depending on the other rays of its packet
    assert split == pytest.approx(whole, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("segments", [1, 1000])
def test_paths_continue_in_later_launches(
    room: SceneRenderer, monkeypatch: pytest.MonkeyPatch, segments: int
) -> None:
    from datagen.rendering.transport import integrator

    sensor = room.sensor(CAMERAS[1])
    whole = room.tracer.render(sensor, 16, 9)
    monkeypatch.setattr(integrator, "FIRST_SEGMENTS", segments)
    # Embree rounds a ray's hit depending on the other rays of its packet
    assert room.tracer.render(sensor, 16, 9) == pytest.approx(whole, rel=1e-5, abs=1e-6)


def test_later_samples_continue_the_sequence(room: SceneRenderer) -> None:
    sensor = room.sensor(CAMERAS[1])
    whole = room.tracer.accumulate(sensor, 64, 9)
    first = room.tracer.accumulate(sensor, 24, 9)
    counts = np.full((32, 48), 40)
    counts[::3] = 20  # some pixels get later samples
    middle = room.tracer.accumulate(sensor, counts, 9, before=first.counts)
    rest = 64 - first.counts - middle.counts
    last = room.tracer.accumulate(sensor, rest, 9, before=(first + middle).counts)
    total = first + middle + last
    assert np.array_equal(total.counts, whole.counts)
    assert total.radiance == pytest.approx(whole.radiance, rel=1e-5, abs=1e-5)


def test_the_denoiser_does_not_import_torch() -> None:
    """Importing torch takes longer than rendering a small configuration, and 200 MB in each worker."""
    code = (
        "import sys\n"
        "import numpy as np\n"
        "from datagen.rendering.denoiser import OidnDenoiser\n"
        "image = np.full((16, 16, 3), 0.5, np.float32)\n"
        "assert np.isfinite(OidnDenoiser().denoise(image, image, image)).all()\n"
        "assert 'pyoidn' in sys.modules and 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, check=True)


def test_denoiser_keeps_the_energy_and_removes_the_noise(room: SceneRenderer) -> None:
    view = room.render_view(1)
    sensor = room.sensor(CAMERAS[1])
    assert room.denoiser is not None
    albedo = auxiliary_albedo(
        view.buffers["diffuse_albedo"], view.buffers["specular_albedo"], view.buffers["surface_mask"]
    )
    normal = view.buffers["normal_world"]
    reference = room.tracer.render(sensor, 2048, 77, with_visible_emission=False)
    noisy = room.tracer.render(sensor, 32, 78, with_visible_emission=False)
    clean = room.denoiser.denoise(noisy, albedo, normal)
    assert clean.mean() == pytest.approx(noisy.mean(), rel=0.01)
    assert ((clean - reference) ** 2).mean() < 0.3 * ((noisy - reference) ** 2).mean()


def test_emitter_does_not_bleed_into_dark_surroundings(tmp_path: Path) -> None:
    scene = SmallScene()
    scene.slots["black"] = GREY.model_copy(update={"diffuse_albedo": (0.0, 0.0, 0.0)})
    scene.parts = {"wall": (quad([-3, 1, -3], [6, 0, 0], [0, 0, 6]), "black")}
    lamp = AreaLight(
        name="lamp",
        origin_m=(-0.25, 0.99, -0.25),
        edge_u_m=(0.5, 0, 0),
        edge_v_m=(0, 0, 0.5),
        radiance=(500, 500, 500),
    )
    dim = EnvironmentLight(name="dim", radiance=(0.1, 0.1, 0.1))
    camera = Camera(96, 96, 96, 96, 48, 48, look_at([0, -1, 0], [0, 1, 0]))
    recipe = RenderRecipe(path_samples=8, auxiliary_samples=64)
    beauty = renderer(tmp_path, scene, [camera], recipe, lights=(lamp, dim)).render_view(0).buffers["beauty"]
    x = np.abs(camera.pixel_centers() - 48).max(axis=-1) * (2 / 96)  # maximum norm in metres
    pixel = 2 / 96
    assert beauty[x < 0.25 - 2 * pixel] == pytest.approx(500, rel=0.01)
    assert beauty[x > 0.25 + 3 * pixel].max() < 0.5  # a thousandth of the lamp


def test_light_through_a_gap_thinner_than_a_pixel_is_complete(tmp_path: Path) -> None:
    """A gap of 0.1 pixels in a black wall shows a tenth of the sky's radiance in every view, although the
    ground-truth samples of a fifth of its pixels miss it."""
    scene = SmallScene()
    scene.slots["black"] = GREY.model_copy(update={"diffuse_albedo": (0.0, 0.0, 0.0)})
    pixel, gap = 2 / 48, 0.1
    low = 0.37 * pixel  # within the pixels of row 23
    scene.parts = {
        "lower": (quad([-3, 1, -3], [6, 0, 0], [0, 0, 3 + low]), "black"),
        "upper": (quad([-3, 1, low + gap * pixel], [6, 0, 0], [0, 0, 3]), "black"),
    }
    sky = EnvironmentLight(name="sky", radiance=(40, 40, 40))
    camera = Camera(48, 48, 48, 48, 24, 24, look_at([0, -1, 0], [0, 1, 0]))
    recipe = RenderRecipe(path_samples=1, auxiliary_samples=16, denoise=False)
    found = [
        view.buffers["beauty"][23].mean()
        for view in renderer(tmp_path, scene, [camera] * 4, recipe, lights=(sky,)).render_views([0, 1, 2, 3])
    ]
    assert found == pytest.approx([40 * gap] * 4, rel=0.05)


def test_auxiliary_albedo_is_zero_where_nothing_reflects() -> None:
    mask = np.array([[[1.0], [0.5], [0.0]]], np.float32)
    diffuse, specular = np.full((1, 3, 3), 0.4, np.float32), np.full((1, 3, 3), 0.1, np.float32)
    assert auxiliary_albedo(diffuse, specular, mask)[0, :, 0] == pytest.approx([0.46, 0.23, 0.0])


def test_optix_denoises_where_its_weights_are_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OptiX is not used without its weights, because it would abort the process."""
    weights = tmp_path / "nvoptix.bin"
    monkeypatch.setattr(denoiser, "OPTIX_WEIGHTS", weights)
    monkeypatch.setattr(sys, "platform", "linux")
    assert make_denoiser("cuda_ad_rgb").name.startswith("oidn")
    weights.touch()
    assert make_denoiser("cuda_ad_rgb").name == "optix"
    assert make_denoiser("llvm_ad_rgb").name.startswith("oidn")


def test_denoiser_accepts_images_of_several_sizes() -> None:
    denoiser = OidnDenoiser(num_threads=1)
    for size in ((40, 56), (24, 32), (40, 56)):
        flat = np.full((*size, 3), 2.0, np.float32)
        result = denoiser.denoise(flat, np.full_like(flat, 0.5), np.zeros_like(flat))
        assert result.mean() == pytest.approx(2.0, rel=0.01)
        assert result[12:-12, 12:-12] == pytest.approx(2.0, rel=0.01)  # at borders the error is up to 8 %
    denoiser.close()


def test_radiance_beyond_half_floats_is_clipped_and_counted(tmp_path: Path) -> None:
    bright = EnvironmentLight(name="sky", radiance=(1e5, 1.0, 1.0))
    camera = Camera(8, 8, 8, 8, 4, 4, look_at([0, 0, 1], [0, 0, 2], up=(0, 1, 0)))
    recipe = RenderRecipe(path_samples=1, auxiliary_samples=1, denoise=False)
    view = renderer(tmp_path, None, [camera], recipe, lights=(bright,)).render_view(0)
    assert view.buffers["beauty"].max() == 65504.0
    assert view.render.clipped_pixels == 64


def test_an_unknown_view_is_refused(room: SceneRenderer) -> None:
    with pytest.raises(InputError, match="view = 7"):
        room.render_view(7)


def test_seeds_differ_by_view_purpose_and_configuration() -> None:
    seeds = {view_seed(c, v, p) for c in (0, 1, 2**62) for v in range(50) for p in ("path", "buffers")}
    assert len(seeds) == 300 and max(seeds) < 2**31
