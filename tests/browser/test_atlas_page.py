# SPDX-License-Identifier: MIT
"""The 3D page in a real browser, opened from disk: its shader against the oracle, light, camera, channels."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from datagen.formats.asset import AssetCamera, EnvironmentAsset, Part, Provenance, SlotMaterial, Texture
from datagen.formats.base import matrix4
from datagen.formats.lights import AreaLight, EnvironmentLight, PointLight, SphereLight
from datagen.formats.package import open_package, write_package
from datagen.foundation.color import linear_from_srgb, srgb_from_linear
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.ply import encode_ply
from model.reconstruction.atlas_page.sources import MAX_SOURCES, page_sources
from model.reconstruction.atlas_page.textures import shrunk
from model.reconstruction.atlas_page.writing import PAGE_FILES, write_view
from oracles import brdf
from tests.browser.driver import SOFTWARE_GL, WAIT_S, Page, find_browser, open_browser
from tests.conftest import REPOSITORY

SIDE, PATCHES = 64, 8
MAX_OPEN_S = 3.0
CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True)
class Quad:
    """A square of 2 m in z = 0 with tilted normals, patches of random materials, and a lamp above it."""

    images: dict[str, np.ndarray]
    normals: np.ndarray
    asset: Path


def make_quad(root: Path, side: int = SIDE, seed: int = 5) -> Quad:
    rng = np.random.default_rng(seed)

    def patches(channels: int, low: int = 0) -> np.ndarray:
        colors = rng.integers(low, 256, (PATCHES, PATCHES, channels)).astype(np.uint8)
        return colors.repeat(side // PATCHES, axis=0).repeat(side // PATCHES, axis=1)

    images = {"diffuse_albedo": patches(3), "specular_albedo": patches(3), "roughness": patches(1, 40)}
    normals = np.array([[-0.3, -0.2, 1], [0.3, -0.1, 1], [0.2, 0.3, 1], [-0.1, 0.2, 1]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    floor = Mesh(CORNERS.astype("f4"), FACES.astype(np.int32), normals.astype("f4"), uv)
    lamp = Mesh((0.1 * CORNERS + [0, 0, 1.9]).astype("f4"), FACES.astype(np.int32), normals.astype("f4"), uv)
    textures = {
        name: Texture(
            texture=f"{name}.png",
            encoding="linear" if name == "roughness" else "srgb",
            channel="r" if name == "roughness" else "rgb",
        )
        for name in images
    }
    pose = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -2.0), (0.0, -1.0, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))
    camera = {"width_px": 64, "height_px": 48, "fx_px": 50.0, "fy_px": 50.0, "cx_px": 32.0, "cy_px": 24.0}
    asset = EnvironmentAsset(
        id="quad",
        title="A square & its lamp",
        provenance=Provenance(license="CC0-1.0", source="made by a test"),
        materials={"surface": SlotMaterial(**textures), "lamp-0": SlotMaterial(emission=(2.0, 3.0, 0.1))},
        parts=(
            Part(name="surface", mesh="surface.ply", material="surface"),
            Part(name="lamp-0", mesh="lamp-0.ply", material="lamp-0"),
        ),
        cameras=(AssetCamera(name="front", **camera, asset_from_camera=pose),),
    )
    content = {"surface.ply": encode_ply(floor), "lamp-0.ply": encode_ply(lamp)}
    content |= {f"{name}.png": encode_png(image) for name, image in images.items()}
    write_package(root / "asset", asset, content).close()
    mask = np.full((side, side), 255, np.uint8)
    mask[: side // 2] = 128
    (root / "atlas").mkdir()
    (root / "atlas" / "mask.png").write_bytes(encode_png(mask))
    (root / "atlas" / "confidence.png").write_bytes(encode_png(confidence_of(side)))
    return Quad(images, normals, root)


def confidence_of(side: int) -> np.ndarray:
    """Confidences (side, side, 3), 0 to 255; D's falls from left to right, those of S and R are constant."""
    steps = np.linspace(230, 20, PATCHES).astype(np.uint8).repeat(side // PATCHES)
    of_d = np.broadcast_to(steps, (side, side))
    return np.stack([of_d, np.full_like(of_d, 240), np.full_like(of_d, 250)], axis=-1)


@pytest.fixture(scope="module")
def quad(tmp_path_factory: pytest.TempPathFactory) -> Quad:
    return make_quad(tmp_path_factory.mktemp("quad"))


@pytest.fixture(scope="module")
def folder(quad: Quad, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("view") / "a page with spaces & signs"
    result = write_view(quad.asset, out)
    assert (result.num_triangles, result.num_materials, result.notes) == (4, 2, ())
    return out


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    find_browser()
    with open_browser(tmp_path_factory.mktemp("profile"), 860, 560, flags=SOFTWARE_GL) as driver:
        yield Page(driver)


@pytest.fixture
def page(browser: Page, folder: Path) -> Iterator[Page]:
    """A newly opened page; afterwards the console must be empty and all requests local."""
    browser.console()
    browser.driver.get("about:blank")
    browser.open(folder / "index.html")
    yield browser
    assert browser.console() == []
    inside = ("file:", "data:", "about:", "blob:", "chrome:", "chrome-")
    assert [url for url in browser.requested() if not url.startswith(inside)] == []


CAMERA, TARGET, FOV_DEG = np.array([0.4, -1.6, 1.5]), np.array([0.1, 0.0, 0.0]), 50.0


def pose(page: Page, light: tuple[float, float, float] = (0.3, 0.5, 1.1), **more: object) -> None:
    """Set a fixed camera and ``light`` as the only light, and hide the ball that marks it."""
    wanted = {"camera": CAMERA.tolist(), "target": TARGET.tolist(), "fov": FOV_DEG, "light": light, "fill": 0}
    page.run("VIEW.set(arguments[0])", {**wanted, "showsLight": False, **more})


def read(page: Page) -> np.ndarray:
    """Pixels of the canvas (H, W, 3)."""
    width, height = page.run("const c = document.getElementById('picture'); return [c.width, c.height]")
    script = """
        const bytes = VIEW.read(0, 0, arguments[0], arguments[1]);
        let text = "";
        for (let k = 0; k < bytes.length; k += 8192) text += String.fromCharCode(...bytes.slice(k, k + 8192));
        return btoa(text);
    """
    data = base64.b64decode(page.run(script, width, height))
    return np.frombuffer(data, np.uint8).reshape(height, width, 4)[..., :3]


def points_seen(
    height: int, width: int, shift: tuple[float, float] = (0, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """Intersections (H, W, 3) of pixel rays, shifted by ``shift`` (px), with z = 0, and the mask (H, W) of
    those inside the square."""
    forward = (TARGET - CAMERA) / np.linalg.norm(TARGET - CAMERA)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    rows, columns = np.indices((height, width))
    scale = np.tan(np.radians(FOV_DEG) / 2) / (height / 2)
    x, y = (columns + 0.5 + shift[0] - width / 2) * scale, (height / 2 - rows - 0.5 - shift[1]) * scale
    rays = forward + x[..., None] * right + y[..., None] * up
    points = CAMERA + rays * (-CAMERA[2] / rays[..., 2:])
    return points, (np.abs(points[..., :2]).max(axis=-1) < 0.999) & (rays[..., 2] < 0)


def expected_bytes(
    quad: Quad,
    points: np.ndarray,
    light: np.ndarray,
    intensity: float,
    exposure: float,
    alpha_factor: float = 1,
) -> np.ndarray:
    """8-bit screen colours (N, 3) of points (N, 3) by the oracle, in double precision."""
    u, v = (points[:, 0] + 1) / 2, (points[:, 1] + 1) / 2
    row, column = ((1 - v) * SIDE).astype(int), (u * SIDE).astype(int)
    at = {name: image[row, column].astype(np.float64) / 255 for name, image in quad.images.items()}
    is_lower = (points[:, 0] >= points[:, 1])[:, None]  # which of the two triangles
    n = quad.normals
    lower = n[0] * (1 - u)[:, None] + n[1] * (u - v)[:, None] + n[2] * v[:, None]
    upper = n[0] * (1 - v)[:, None] + n[2] * u[:, None] + n[3] * (v - u)[:, None]
    normal = np.where(is_lower, lower, upper)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = np.cross(normal, [0.0, 1.0, 0.0])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], axis=1)

    def local(target: np.ndarray) -> np.ndarray:
        away = target - points
        return np.einsum("nij,nj->ni", frame, away / np.linalg.norm(away, axis=1, keepdims=True))

    roughness = at["roughness"][:, 0] * np.sqrt(alpha_factor)
    value = brdf.eval_cos(
        local(CAMERA),
        local(light),
        linear_from_srgb(at["diffuse_albedo"]),
        linear_from_srgb(at["specular_albedo"]),
        roughness,
    )
    radiance = value * intensity / ((light - points) ** 2).sum(axis=1, keepdims=True)
    return 255 * srgb_from_linear(np.clip(radiance * exposure, 0, 1))


@pytest.mark.parametrize("light", [(0.3, 0.5, 1.1), (-0.6, 1.2, 0.5)])
def test_shader_is_the_projects_bsdf(page: Page, quad: Quad, light: tuple[float, float, float]) -> None:
    """At hundreds of pixels of diffuse and glossy patches, the canvas equals the oracle up to rounding."""
    pose(page, light, exposure=-1, power=1)
    shown = read(page)
    points, is_seen = points_seen(*shown.shape[:2])
    texel = (points[..., :2] + 1) / 2 * SIDE % (SIDE // PATCHES)
    is_seen &= (np.abs(texel - SIDE // PATCHES / 2) < 2.5).all(axis=-1)  # not filtered with other patches
    chosen = np.flatnonzero(is_seen)[::7]
    assert len(chosen) > 500
    got = shown.reshape(-1, 3)[chosen].astype(float)
    state = page.run("return VIEW.state()")
    assert state["light"] == pytest.approx(light)

    def beyond(alpha_factor: float) -> float:
        """Deviation of the screen from the oracle's bounds, in 8-bit steps. Rasterisers round vertices to
        1/16 of a pixel, so a pixel may show points up to that far from its centre."""
        shifts = [(0.0, 0.0), *((x / 16, y / 16) for x in (-1, 1) for y in (-1, 1))]
        possible = []
        for shift in shifts:
            at = points_seen(*shown.shape[:2], shift)[0].reshape(-1, 3)[chosen]
            possible.append(expected_bytes(quad, at, np.array(light), state["intensity"], 0.5, alpha_factor))
        assert np.ptp(possible[0]) > 150 and ((possible[0] > 3) & (possible[0] < 252)).mean() > 0.3
        low, high = np.min(possible, axis=0), np.max(possible, axis=0)
        return float(np.maximum(low - got, got - high).max())

    assert beyond(1.0) <= 0.75  # half a step of rounding, and single precision
    assert beyond(1.05) > 2


def test_channels_are_the_textures(page: Page, quad: Quad) -> None:
    pose(page)
    blank = read(page)
    assert np.ptp(blank.reshape(-1, 3), axis=0).min() > 50  # not empty
    points, is_seen = points_seen(*blank.shape[:2])
    texel = (points[..., :2] + 1) / 2 * SIDE % (SIDE // PATCHES)
    is_seen &= (np.abs(texel - SIDE // PATCHES / 2) < 2.5).all(axis=-1)
    at = points[is_seen]
    row, column = ((1 - (at[:, 1] + 1) / 2) * SIDE).astype(int), ((at[:, 0] + 1) / 2 * SIDE).astype(int)
    colors = np.array(
        json.loads((page_data(page) / "scene.js").read_text()[len("VIEW.scene = ") : -2])["colorMap"]
    )
    for key, expected in (
        ("2", quad.images["diffuse_albedo"][row, column]),
        ("3", quad.images["specular_albedo"][row, column]),
        ("4", colors[quad.images["roughness"][row, column, 0]]),
        ("5", colors[np.where(row < SIDE // 2, 38, 242)]),
        ("7", colors[confidence_of(SIDE)[row, column, 0]]),
    ):
        page.keys(key, to="#picture")
        difference = np.abs(read(page)[is_seen].astype(int) - expected)
        assert difference.max() <= 2, key
        if key in LEGENDS:
            assert LEGENDS[key] in page.run("return document.getElementById('legend').innerText")


LEGENDS = {"4": "R 0", "5": "filled in", "7": "light"}


def test_assets_without_confidence_do_not_offer_it(browser: Page, tmp_path: Path) -> None:
    plain = make_quad(tmp_path / "plain")
    (plain.asset / "atlas" / "confidence.png").unlink()
    write_view(plain.asset, tmp_path / "page")
    browser.driver.get("about:blank")
    browser.open(tmp_path / "page" / "index.html")
    browser.keys("7", to="#picture")
    assert browser.run("return VIEW.state().shown") == 0
    browser.keys("5", to="#picture")  # counterpart: existing channels can be chosen
    assert browser.run("return VIEW.state().shown") == 4


def page_data(page: Page) -> Path:
    from urllib.parse import unquote, urlparse

    return Path(unquote(urlparse(page.driver.current_url).path)).parent / "data"


def test_light_moves_with_keys_sliders_and_pointer(page: Page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By

    pose(page)
    before, state = read(page), page.run("return VIEW.state()")
    page.keys("l", "l", "o", to="#picture")
    moved = page.run("return VIEW.state()")
    assert moved["light"][0] > state["light"][0] and moved["light"][2] > state["light"][2]
    assert page.run("return Number(document.getElementById('light-x').value)") == pytest.approx(
        moved["light"][0], abs=0.01
    )
    after = read(page)
    assert (np.abs(after.astype(int) - before).max(axis=-1) > 5).mean() > 0.01
    page.run(
        "const s = document.getElementById('light-y'); s.value = -0.7; s.dispatchEvent(new Event('input'))"
    )
    assert page.run("return VIEW.state().light[1]") == pytest.approx(-0.7, abs=0.01)
    assert (np.abs(read(page).astype(int) - after).max(axis=-1) > 5).mean() > 0.01
    pose(page, (0.1, 0.0, 0.3), showsLight=True)  # on the line of sight: in the middle of the picture
    canvas = page.driver.find_element(By.ID, "picture")
    light = np.array(page.run("return VIEW.state().light"))
    forward = (TARGET - CAMERA) / np.linalg.norm(TARGET - CAMERA)
    on_axis = CAMERA + forward * ((light - CAMERA) @ forward)
    pose(page, tuple(on_axis.tolist()), showsLight=True)
    camera = page.run("return VIEW.state().camera")
    ActionChains(page.driver).drag_and_drop_by_offset(canvas, 90, 0).perform()
    dragged = np.array(page.run("return VIEW.state().light"))
    assert dragged[0] > on_axis[0] + 0.05
    assert (dragged - on_axis) @ forward == pytest.approx(0, abs=1e-6)  # parallel to the image plane
    assert page.run("return VIEW.state().camera") == camera
    page.keys("2", to="#picture")  # D, without the light's ball: the pointer turns the camera
    pose(page, tuple(on_axis.tolist()), showsLight=True)
    ActionChains(page.driver).drag_and_drop_by_offset(canvas, 90, 0).perform()
    state = page.run("return VIEW.state()")
    np.testing.assert_allclose(state["light"], on_axis)
    assert state["camera"] != camera or state["target"] != TARGET.tolist()


def test_camera_turns_and_moves(page: Page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By

    state = page.run("return VIEW.state()")
    np.testing.assert_allclose(state["camera"], (0, -2, 0.3), atol=1e-6)  # the asset's camera
    assert state["fov"] == pytest.approx(np.degrees(2 * np.arctan(24 / 50)))
    assert page.run("return document.getElementById('mode').value") == "fly"
    page.keys("w", to="#picture")
    np.testing.assert_allclose(page.run("return VIEW.state().camera[1]") > -2, True)
    here = page.run("return VIEW.state()")
    page.keys("\ue012", to="#picture")  # left
    turned = page.run("return VIEW.state()")
    np.testing.assert_allclose(turned["camera"], here["camera"], atol=1e-9)
    assert turned["target"][0] < here["target"][0]
    page.keys("c", to="#picture")
    outside = page.run("return VIEW.state()")
    assert page.run("return document.getElementById('mode').value") == "orbit"
    canvas = page.driver.find_element(By.ID, "picture")
    ActionChains(page.driver).move_to_element_with_offset(canvas, 100, 80).click_and_hold().move_by_offset(
        80, 0
    ).release().perform()
    orbited = page.run("return VIEW.state()")
    np.testing.assert_allclose(orbited["target"], outside["target"])
    assert np.linalg.norm(np.subtract(orbited["camera"], outside["camera"])) > 0.2
    radius = [np.linalg.norm(np.subtract(s["camera"], s["target"])) for s in (orbited, outside)]
    assert radius[0] == pytest.approx(radius[1])
    page.keys("]", to="#picture")
    assert "+0.5 EV" in page.run("return document.getElementById('exposure').getAttribute('aria-valuetext')")
    page.keys(*"]" * 20, to="#picture")
    assert page.run("return VIEW.state().stops") == 8  # the end of the slider


def test_page_starts_with_the_whole_room(browser: Page, quad: Quad, tmp_path: Path) -> None:
    """The page opens at the outermost camera, facing the cameras' centroid; key C selects further views."""
    places = [(-0.9, -0.9, 1.0), (0.5, 0.2, 1.0), (0.6, 0.4, 1.2), (0.4, 0.5, 1.0)]
    with open_package(quad.asset / "asset") as package:
        asset = package.asset
        assert isinstance(asset, EnvironmentAsset)
        (camera,) = asset.cameras
        moved = []
        for number, place in enumerate(places):
            pose = np.array(camera.asset_from_camera)
            pose[:3, 3] = place
            changes = {"name": f"camera-{number}", "asset_from_camera": matrix4(pose)}
            moved.append(camera.model_copy(update=changes))
        names = [path.name for path in (quad.asset / "asset").iterdir() if path.name != "asset.json"]
        content = {name: package.read_bytes(name) for name in names}
    changed = asset.model_copy(update={"cameras": tuple(moved)})
    write_package(tmp_path / "asset", changed, content).close()
    write_view(tmp_path / "asset", tmp_path / "page")
    browser.driver.get("about:blank")
    browser.open(tmp_path / "page" / "index.html")
    state = browser.run("return VIEW.state()")
    np.testing.assert_allclose(state["camera"], places[0], atol=1e-6)
    ahead = np.subtract(state["target"], state["camera"])
    middle = np.mean(places, axis=0) - places[0]
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), middle / np.linalg.norm(middle), atol=1e-4)
    assert state["fov"] == 75
    chosen = []
    for _ in range(6):
        browser.keys("c", to="#picture")
        chosen.append(browser.run("return document.getElementById('camera').selectedOptions[0].textContent"))
    assert chosen == ["outside", "camera-0", "camera-1", "camera-2", "camera-3", "the room"]


def test_every_control_has_a_name(page: Page) -> None:
    tree = page.driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    roles = {"combobox", "slider", "application", "button", "complementary", "heading"}
    found = [n for n in tree if not n.get("ignored") and n.get("role", {}).get("value") in roles]
    nameless = [n["role"]["value"] for n in found if not n.get("name", {}).get("value", "").strip()]
    assert len(found) >= 10 and nameless == []
    page.keys("4", to="#picture")
    assert page.run("return document.getElementById('spoken').textContent") == "shown: R, roughness"


def test_large_textures_load_after_a_small_preview(browser: Page, tmp_path: Path) -> None:
    large = make_quad(tmp_path / "large", side=1152)
    told: list[tuple[int, int]] = []
    result = write_view(large.asset, tmp_path / "page", progress=lambda *step: told.append(step))
    assert result.notes == () and told == [(1, 3), (2, 3), (3, 3)]
    assert sorted(p.name for p in (tmp_path / "page" / "data").iterdir()) == [
        "0-diffuse.js", "0-rough.js", "0-specular.js", "preview.js", "scene.js",
    ]  # fmt: skip
    browser.driver.get("about:blank")
    browser.open(tmp_path / "page" / "index.html")
    assert "1152 texels" in browser.run("return document.getElementById('sizes').textContent")
    (tmp_path / "page" / "data" / "0-rough.js").unlink()
    browser.driver.get("about:blank")
    browser.driver.get((tmp_path / "page" / "index.html").as_uri())
    browser.wait("return document.getElementById('notice').innerText.includes('0-rough.js')")
    assert read(browser).std() > 5  # the preview is still shown
    assert len(browser.console()) == 1  # the browser's message about the missing file


@pytest.mark.slow
def test_atlas_of_4096_texels_opens_quickly(tmp_path: Path) -> None:
    """Textures with noise, which PNG compresses badly, make a page larger than that of a real atlas."""
    quad = make_quad(tmp_path / "large", side=4096)
    rng = np.random.default_rng(1)
    for name, image in quad.images.items():
        noisy = image + rng.integers(0, 8, image.shape, dtype=np.uint8) * (image < 240)
        (quad.asset / "asset" / f"{name}.png").write_bytes(encode_png(noisy.astype(np.uint8)))
    result = write_view(quad.asset, tmp_path / "page")
    with open_browser(tmp_path / "profile", 860, 560, logs_requests=False, flags=SOFTWARE_GL) as driver:
        page = Page(driver)
        driver.get("about:blank")
        before = page.processor_s()
        driver.get((tmp_path / "page" / "index.html").as_uri())
        page.wait("return performance.getEntriesByName('preview').length > 0")
        first = page.processor_s() - before
        full = "return performance.getEntriesByName('full').length > 0"
        page.until(lambda: page.run(full), full, 10 * WAIT_S)  # 150 MB of noise through software GL
        spent = page.processor_s() - before
        marks = ("preview", "full")
        times = [
            page.run("return performance.getEntriesByName(arguments[0])[0].startTime", m) / 1000
            for m in marks
        ]
        print(
            f"4096 texels, {result.num_bytes / 1e6:.0f} MB: first picture after {times[0]:.2f} s "
            f"({first:.2f} s of processor time), full size after {times[1]:.2f} s ({spent:.2f} s)"
        )
        assert read(page).std() > 5 and page.console() == []
    assert first < MAX_OPEN_S


# ---------------------------------------------------------------------- shadows and the asset's lights

SHELF = 0.25 * CORNERS + [0, 0, 0.4]


def make_room(root: Path, lights: tuple[AreaLight, ...] = (), *, has_lamp: bool = True) -> Path:
    """Write the page of a package with a white floor of 2 x 2 m, a shelf 0.5 m wide 0.4 m above its centre,
    and a lamp 0.2 m wide at a height of 1.9 m that emits downwards. Return the page's path."""
    up, uv = np.tile([0.0, 0, 1], (4, 1)).astype("f4"), np.zeros((4, 2), np.float32)
    shapes = {"surface": CORNERS, "shelf": SHELF, "lamp": 0.1 * CORNERS + [0, 0, 1.9]}
    down = np.ascontiguousarray(FACES[:, ::-1]).astype(np.int32)
    meshes = {
        name: Mesh(at.astype("f4"), down if name == "lamp" else FACES.astype(np.int32), up, uv)
        for name, at in shapes.items()
        if name != "lamp" or has_lamp
    }
    white = SlotMaterial(diffuse_albedo=(0.8, 0.8, 0.8), specular_albedo=(0.0, 0.0, 0.0), roughness=1.0)
    asset = EnvironmentAsset(
        id="room",
        title="A floor under a shelf",
        provenance=Provenance(license="CC0-1.0", source="made by a test"),
        materials={
            name: SlotMaterial(emission=(30.0, 20.0, 10.0)) if name == "lamp" else white for name in meshes
        },
        parts=tuple(Part(name=name, mesh=f"{name}.ply", material=name) for name in meshes),
        lights=lights,
    )
    content = {f"{name}.ply": encode_ply(mesh) for name, mesh in meshes.items()}
    write_package(root / "asset", asset, content).close()
    write_view(root / "asset", root / "page")
    return root / "page" / "index.html"


def open_page(browser: Page, page: Path) -> None:
    browser.console()
    browser.driver.get("about:blank")
    browser.open(page)


def is_behind_shelf(points: np.ndarray, light: np.ndarray, slack: float) -> np.ndarray:
    """Mask of floor points (..., 3) whose segment to the light crosses the shelf, widened by ``slack`` m."""
    crossing = points + (light - points) * (SHELF[0, 2] / light[2])
    return np.abs(crossing[..., :2]).max(axis=-1) < 0.25 + slack


def floor_seen(shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (H, W, 3) of the floor, and the mask where neither shelf nor lamp (with a margin) covers it."""
    points, is_seen = points_seen(*shown.shape[:2])
    for height, half in ((0.4, 0.25), (1.9, 0.1)):
        at = points + (CAMERA - points) * (height / CAMERA[2])
        is_seen &= (np.abs(at[..., :2]).max(axis=-1) > half + 0.02) | (height > CAMERA[2])
    return points, is_seen & (np.abs(points[..., :2]).max(axis=-1) < 0.97)


@pytest.mark.parametrize("light", [(0.3, 0.5, 1.1), (-0.9, -0.2, 0.9), (0.02, 0.01, 3.0)])
def test_movable_light_casts_shadows(
    browser: Page, tmp_path: Path, light: tuple[float, float, float]
) -> None:
    """The floor is black in the shelf's geometric shadow and elsewhere unchanged, without shadow acne."""
    open_page(browser, make_room(tmp_path, has_lamp=False))
    pose(browser, light, exposure=-1, power=1, shadows=False)
    bare = read(browser).astype(int)
    pose(browser, light, exposure=-1, power=1, shadows=True)
    shown = read(browser).astype(int)
    points, is_floor = floor_seen(shown)
    is_dark = is_floor & is_behind_shelf(points, np.array(light), -0.02)
    is_lit = is_floor & ~is_behind_shelf(points, np.array(light), 0.02)
    assert is_dark.sum() > 500 and is_lit.sum() > 5000
    assert bare[is_dark].min() > 20
    assert shown[is_dark].max() == 0
    np.testing.assert_array_equal(shown[is_lit], bare[is_lit])
    lit_shelf = points_seen(*shown.shape[:2])[1] & ~is_floor
    assert (shown[lit_shelf] == bare[lit_shelf]).all(axis=-1).mean() > 0.9  # the shelf does not shadow itself
    moved = (-light[0], -light[1], light[2] + 0.2)
    pose(browser, moved, exposure=-1, power=1)  # the shadow follows the light
    after = read(browser)
    is_dark = is_floor & is_behind_shelf(points, np.array(moved), -0.02)
    assert after[is_dark].max() == 0
    assert browser.console() == []


def test_grazing_light_causes_no_shadow_acne(browser: Page, tmp_path: Path) -> None:
    """With the light 5 cm above the floor, shadow-map texels are stretched on it up to 20 times."""
    open_page(browser, make_room(tmp_path, has_lamp=False))
    light = (0.0, 0.0, 0.05)
    pose(browser, light, power=2, shadows=False)
    bare = read(browser).astype(int)
    pose(browser, light, power=2, shadows=True)
    shown = read(browser).astype(int)
    _, is_floor = floor_seen(shown)
    assert bare[is_floor].max() > 100
    np.testing.assert_array_equal(shown[is_floor], bare[is_floor])


def test_lights_of_the_asset_are_switched(browser: Page, tmp_path: Path) -> None:
    """A mesh lamp lights the floor like a disk of equal area, except behind the shelf and when off."""
    open_page(browser, make_room(tmp_path))
    assert "1 light," in browser.run("return document.getElementById('sources-note').textContent")
    assert browser.run("return VIEW.state().sources") is False
    pose(browser, power=-60)
    off = read(browser).astype(int)
    assert off.max() == 0
    browser.run("document.getElementById('sources').click()")
    assert browser.run("return VIEW.state().sources") is True
    shown = read(browser).astype(int)
    points, is_floor = floor_seen(shown)
    lamp = np.array([0, 0, 1.9])
    is_dark = is_floor & is_behind_shelf(points, lamp, -0.03)
    is_lit = is_floor & ~is_behind_shelf(points, lamp, 0.03)
    assert is_dark.sum() > 200 and shown[is_dark].max() == 0
    away = lamp - points[is_lit]
    distance2 = (away**2).sum(axis=1)
    cosine2 = lamp[2] ** 2 / distance2
    irradiance = 0.04 * cosine2 / (distance2 + 0.04 / np.pi)
    expected = 255 * srgb_from_linear(np.clip(0.8 / np.pi * irradiance[:, None] * [30.0, 20.0, 10.0], 0, 1))
    assert expected.max() > 60
    np.testing.assert_allclose(shown[is_lit], expected, atol=1.5)
    browser.run("document.getElementById('sources').click()")
    np.testing.assert_array_equal(read(browser), off)
    assert browser.console() == []


def test_lamps_do_not_shadow_themselves(browser: Page, tmp_path: Path) -> None:
    """A lamp of two plates, 10 cm apart, lights the floor although its centre is between the plates."""
    index = make_room(tmp_path, has_lamp=False)
    with open_package(tmp_path / "asset") as package:
        asset = package.asset
        assert isinstance(asset, EnvironmentAsset)
        content = {f"{name}.ply": package.read_bytes(f"{name}.ply") for name in ("surface", "shelf")}
    corners = np.concatenate([0.1 * CORNERS + [0, 0, 1.95], 0.1 * CORNERS + [0, 0, 1.85]]).astype("f4")
    faces = np.concatenate([FACES, FACES[:, ::-1] + 4]).astype(np.int32)
    plates = Mesh(corners, faces, np.tile([0.0, 0, 1], (8, 1)).astype("f4"), np.zeros((8, 2), np.float32))
    changes = {
        "materials": {**asset.materials, "lamp": SlotMaterial(emission=(30.0, 30.0, 30.0))},
        "parts": (*asset.parts, Part(name="lamp", mesh="lamp.ply", material="lamp")),
    }
    content["lamp.ply"] = encode_ply(plates)
    write_package(tmp_path / "lit" / "asset", asset.model_copy(update=changes), content).close()
    write_view(tmp_path / "lit" / "asset", index.parent)
    open_page(browser, index)
    pose(browser, power=-60, sources=True)
    shown = read(browser)
    points, is_floor = floor_seen(shown)
    is_lit = is_floor & ~is_behind_shelf(points, np.array([0, 0, 1.9]), 0.03)
    assert is_lit.sum() > 5000 and shown[is_lit].min() > 10


def test_assets_without_lights_have_a_notice(browser: Page, tmp_path: Path) -> None:
    open_page(browser, make_room(tmp_path, has_lamp=False))
    assert browser.run("return document.getElementById('sources').disabled") is True
    assert "There are none" in browser.run("return document.getElementById('sources-note').textContent")
    pose(browser, sources=True)  # a script cannot enable them either
    assert browser.run("return VIEW.state().sources") is False


def test_many_lights_are_merged_and_keep_their_power(tmp_path: Path) -> None:
    """Ten windows in a row, the last three 1 cm and 2 cm apart, become eight sources."""
    places = [0.0, 1, 2, 3, 4, 5, 6, 7, 7.01, 7.03]
    lights = tuple(
        AreaLight(name=f"w-{k}", origin_m=(x, 0, 1), edge_u_m=(0.5, 0, 0), edge_v_m=(0, 0, 1),
                  radiance=(1.0 + k, 2.0, 3.0))
        for k, x in enumerate(places)
    )  # fmt: skip
    make_room(tmp_path, lights, has_lamp=False)
    text = (tmp_path / "page" / "data" / "scene.js").read_text()
    scene = json.loads(text[len("VIEW.scene = ") : -2])
    sources = scene["sources"]
    assert (len(sources), scene["numLights"]) == (MAX_SOURCES, 10)
    flux = sum(np.linalg.norm(s["vector"]) * np.array(s["radiance"]) for s in sources)
    np.testing.assert_allclose(flux, 0.5 * np.sum([light.radiance for light in lights], axis=0))
    assert [s["position"][0] for s in sources[:7]] == pytest.approx([x + 0.25 for x in places[:7]])
    np.testing.assert_allclose(sources[0]["vector"], (0, -0.5, 0))  # edge_u x edge_v
    assert 7.25 < sources[7]["position"][0] < 7.28
    limit = (REPOSITORY / "model/reconstruction/atlas_page/page/shadows.js").read_text()
    assert f"VIEW.MAX_SOURCES = {MAX_SOURCES};" in limit


def test_lights_of_every_kind_become_sources(tmp_path: Path) -> None:
    """Intensity of point, sphere and disk lights towards w is radiance (max(vector . w, 0) + rest)."""
    make_room(tmp_path, has_lamp=False)
    with open_package(tmp_path / "asset") as package:
        asset = package.asset
        assert isinstance(asset, EnvironmentAsset)
        lights = (
            PointLight(name="bulb", position_m=(0, 0, 1), intensity=(5, 6, 7)),
            SphereLight(name="globe", position_m=(1, 0, 1), radius_m=0.1, radiance=(2, 2, 2)),
            AreaLight(name="disk", origin_m=(-1, -1, 2), edge_u_m=(0, 2, 0), edge_v_m=(2, 0, 0),
                      radiance=(1, 1, 1), shape="disk"),
            EnvironmentLight(name="sky"),
        )  # fmt: skip
        sources, number, notes = page_sources(asset.model_copy(update={"lights": lights}), {})
    assert number == 3 and notes == ["sky: this light (environment) is not shown"]
    intensity = [s.radiance * (max(-s.vector_m2[2], 0) + s.rest_m2) for s in sources]  # downwards
    np.testing.assert_allclose(intensity[0], (5, 6, 7))
    np.testing.assert_allclose(intensity[1], 2 * np.pi * 0.01)
    np.testing.assert_allclose(intensity[2], np.pi)
    np.testing.assert_allclose(sources[2].position_m, (0, 0, 2))


# ---------------------------------------------------------------------- without a browser


def test_page_is_self_contained(folder: Path) -> None:
    page = (folder / "index.html").read_text()
    assert "http" not in page
    assert all(f'"{name}"' in page for name in PAGE_FILES if name != "index.html")
    for name in PAGE_FILES:
        assert (folder / name).stat().st_size > 500


def test_large_textures_are_averaged_down_and_named(tmp_path: Path) -> None:
    quad = make_quad(tmp_path / "quad", side=1024)
    result = write_view(quad.asset / "asset", tmp_path / "page", max_side=256)
    assert len(result.notes) == 3 and "256 of 1024 texels" in result.notes[0]
    assert write_view(quad.asset, tmp_path / "page", max_side=256).notes == result.notes  # updated page


def test_averages_are_of_light_not_of_encoded_values() -> None:
    """A checkerboard of black and white has the albedo 0.5 and the roughness 0.5."""
    board = (np.indices((8, 8)).sum(axis=0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, axis=-1)
    assert (shrunk(board, 4, is_color=True) == round(255 * float(srgb_from_linear(np.array(0.5))))).all()
    assert (shrunk(board, 4, is_color=False) == 128).all()


def test_the_atlas_is_found_from_within_the_package(
    quad: Quad, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder, source in ((quad.asset / "asset", "."), (quad.asset, "asset/asset.json")):
        monkeypatch.chdir(folder)
        write_view(Path(source), tmp_path / "page")
        text = (tmp_path / "page" / "data" / "scene.js").read_text()
        assert '"hasConfidence":true,"hasMask":true' in text, source


def test_an_updated_page_keeps_no_images_of_the_earlier_one(quad: Quad, tmp_path: Path) -> None:
    write_view(make_quad(tmp_path / "large", side=1152).asset, tmp_path / "page")
    assert (tmp_path / "page" / "data" / "0-rough.js").is_file()
    result = write_view(quad.asset, tmp_path / "page")
    assert {path.name for path in (tmp_path / "page" / "data").iterdir()} == {"preview.js", "scene.js"}
    assert result.num_bytes == write_view(quad.asset, tmp_path / "other").num_bytes


def test_wrong_folders_and_assets_are_refused(quad: Quad, tmp_path: Path) -> None:
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("do not lose")
    with pytest.raises(InputError, match="other files"):
        write_view(quad.asset, tmp_path / "letters")
    with pytest.raises(InputError, match="no such file or folder"):
        write_view(tmp_path / "nowhere", tmp_path / "page")
    assert not (tmp_path / "page").exists()
    material = next((REPOSITORY / "scenes" / "library").glob("*/oak*"), None)
    if material is not None:
        with pytest.raises(InputError, match="environment or an object"):
            write_view(material, tmp_path / "other-page")
        assert not (tmp_path / "other-page").exists()


def test_vendored_library_is_the_pinned_one() -> None:
    """Package, lock file and script of three.js have the same version, and its licence is included."""
    pinned = json.loads((REPOSITORY / ".ci" / "three" / "package.json").read_text())
    version = pinned["devDependencies"]["three"]
    locked = json.loads((REPOSITORY / ".ci" / "three" / "package-lock.json").read_text())
    assert locked["packages"]["node_modules/three"]["version"] == version
    script = (REPOSITORY / "model/reconstruction/atlas_page/page/three.js").read_text()
    assert f"three.js {version}," in script[:200] and f"three.js {version}," in pinned["scripts"]["build"]
    revision = re.match(r"0\.(\d+)\.", version)
    assert revision is not None and f'"{revision[1]}"' in script  # the version in the library
    notice = (REPOSITORY / "LICENSES" / "three.js.txt").read_text()
    assert "three.js authors" in notice and "MIT License" in notice
