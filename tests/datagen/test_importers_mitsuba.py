# SPDX-License-Identifier: MIT
"""Mitsuba scenes as packages: parsing, materials compared with Mitsuba, policies, lights, camera regions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from datagen.formats.asset import EnvironmentAsset, Texture
from datagen.formats.lights import AreaLight, EnvironmentLight
from datagen.formats.mitsuba.scene import SceneNode, parse_scene, snake_case
from datagen.formats.package import open_package
from datagen.foundation.budget import Budget
from datagen.foundation.errors import InputError
from datagen.foundation.images import encode_png, read_image
from datagen.foundation.meshes.mesh import Mesh
from datagen.foundation.meshes.obj import read_obj
from datagen.foundation.meshes.ply import encode_ply
from datagen.foundation.rectangles import largest_rectangle
from datagen.importers import fresnel
from datagen.importers.annotate import find_places
from datagen.importers.channels import BakedSource, ImageCache, ImageSource
from datagen.importers.common import ImportedAsset, ImportJob, ImportOptions, detect_origin
from datagen.importers.mitsuba_lights import emitter_shape_light
from datagen.importers.mitsuba_materials import Draft, MaterialConverter
from datagen.importers.mitsuba_shapes import shape_mesh, transformed_uv
from datagen.importers.mitsuba_values import checkerboard, normal_from_height
from datagen.importers.mitsuba_xml import import_mitsuba_scene
from oracles.imported_renders import agreement, native_configuration

LICENSED = ImportOptions(license="CC0-1.0")
SENSOR = """
<sensor type="perspective"><float name="fov" value="60"/>
  <transform name="to_world"><lookat origin="0, 1, 4" target="0, 1, 0" up="0, 1, 0"/></transform>
  <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="48"/></film>
</sensor>"""


def write_scene(folder: Path, body: str, name: str = "scene.xml", version: str = "3.0.0") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(f'<scene version="{version}">{body}</scene>')
    return path


def colorful(path: Path, side: int = 32) -> Path:
    """Write an asymmetric image, which reveals rotated or mirrored textures; return ``path``."""
    v, u = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side), indexing="ij")
    pixels = np.stack([u, v, (u * v > 0.3) * 0.8 + 0.1], axis=-1)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(np.round(pixels * 255).astype(np.uint8)))
    return path


def imported(
    folder: Path, body: str, options: ImportOptions = LICENSED
) -> tuple[ImportedAsset, EnvironmentAsset]:
    record = import_mitsuba_scene(write_scene(folder / "scene", body), folder / "library", options)
    asset = open_package(record.path).asset
    assert isinstance(asset, EnvironmentAsset)
    return record, asset


# ---- parsing -------------------------------------------------------------------------------------


def test_variables_includes_and_old_names_are_resolved(tmp_path: Path) -> None:
    write_scene(
        tmp_path, '<bsdf type="diffuse" id="grey"><rgb name="reflectance" value="#808080"/></bsdf>', "b.xml"
    )
    path = write_scene(
        tmp_path,
        '<default name="a" value="0.3"/><include filename="b.xml"/>'
        '<bsdf type="roughplastic" id="p"><float name="intIOR" value="1.6"/>'
        '<float name="alpha" value="$a"/></bsdf>'
        '<shape type="rectangle"><transform name="toWorld"><translate x="1"/><scale value="2"/></transform>'
        '<ref id="grey"/></shape>',
        version="0.5.0",
    )
    scene = parse_scene(path)
    assert scene.by_id["p"].values == {"int_ior": 1.6, "alpha": 0.3}
    assert parse_scene(path, {"a": "0.7"}).by_id["p"].get("alpha") == 0.7
    shape = scene.all_of("shape")[0]
    assert shape.children_of("bsdf")[0].id == "grey"
    assert shape.get("to_world")[0, 3] == 2.0  # translated first, then scaled
    np.testing.assert_allclose(scene.by_id["grey"].get("reflectance"), 0.21586, rtol=1e-4)
    assert [snake_case(n) for n in ("extIOR", "specularReflectance", "to_uv")] == [
        "ext_ior",
        "specular_reflectance",
        "to_uv",
    ]


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<include filename="../x.xml"/>', "inside the scene's folder"),
        ('<include filename="scene.xml"/>', "includes without cycles"),
        ('<shape type="cube"><ref id="nothing"/></shape>', "'nothing'; expected the id"),
        ('<bsdf type="twosided" id="a"><ref id="a"/></bsdf>', "a reference to itself"),
        ('<bsdf type="diffuse"><float name="x" value="nan"/></bsdf>', "1 finite numbers"),
        ('<bsdf type="diffuse"><float name="x" value="$y"/></bsdf>', r"\$y = undefined"),
        ('<bsdf type="diffuse"><spectrum name="r" value="400:1, 700:2"/></bsdf>', "replace it by an <rgb>"),
        ('<thing name="x"/>', "expected a tag of Mitsuba 3"),
        ("<shape", "well-formed XML"),
    ],
)
def test_bad_scenes_are_refused_by_name(tmp_path: Path, body: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_scene(write_scene(tmp_path, body))


def test_entities_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text('<!DOCTYPE s [<!ENTITY a SYSTEM "/etc/passwd">]><scene version="3.0.0">&a;</scene>')
    with pytest.raises(InputError, match="DOCTYPE or ENTITY"):
        parse_scene(path)


def test_transforms_agree_with_mitsuba(tmp_path: Path, mitsuba_variant: str) -> None:
    import mitsuba as mi

    body = (
        '<shape type="rectangle"><transform name="to_world"><rotate y="0.8" x="0.6" angle="33"/>'
        '<scale x="2" y="3" z="-1"/><translate x="1" y="2" z="3"/></transform></shape>'
    )
    ours = parse_scene(write_scene(tmp_path, body + SENSOR))
    loaded = mi.load_file(str(tmp_path / "scene.xml"), optimize=False)
    params = mi.traverse(loaded)
    theirs = np.array(params[next(k for k in params.keys() if k.endswith(".to_world"))].matrix)  # noqa: SIM118
    np.testing.assert_allclose(
        theirs.reshape(4, 4), ours.all_of("shape")[0].get("to_world"), rtol=1e-5, atol=1e-6
    )
    sensor = np.array(loaded.sensors()[0].world_transform().matrix).reshape(4, 4)
    np.testing.assert_allclose(sensor, ours.all_of("sensor")[0].get("to_world"), rtol=1e-5, atol=1e-6)


def test_obj_polygons_negative_indices_and_missing_parts(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf -4/1 -3/2 -2/3 -1/4\n"
    )
    mesh = read_obj(path)
    assert len(mesh.faces) == 2
    assert mesh.normals is None
    assert mesh.uv is not None
    corner = mesh.positions[mesh.faces[0]]
    np.testing.assert_array_equal(corner, [[0, 0, 0], [1, 0, 0], [1, 1, 0]])
    np.testing.assert_array_equal(mesh.uv[mesh.faces[0]], corner[:, :2])
    path.write_text("v 0 0 0\nv 1 0 0\nf 1 2 9\n")
    with pytest.raises(InputError, match="entry 9 of 2"):
        read_obj(path)
    path.write_text("v 0 0 0\nv 1 0 0\nf 1 2 -3\n")
    with pytest.raises(InputError, match="entry -3 of 2"):
        read_obj(path)


def test_obj_lines_may_be_indented_and_continue_on_windows(tmp_path: Path) -> None:
    path = tmp_path / "mesh.obj"
    path.write_bytes(b" v 0 0 0\r\n v 1 0 0\r\n\tv 0 1 0\r\nv 1 1 0\r\n  f 1 2 \\\r\n 4 3\r\n")
    assert len(read_obj(path).faces) == 2


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("v 0 0\nv 1 0\nv 1 1\nf 1 2 3\n", "'v 0 0'"),
        ("v 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0.5\nvt 1\nvt 1\nf 1/1 2/2 3/3\n", "'vt 0.5'"),
    ],
)
def test_an_obj_of_short_lines_is_refused(tmp_path: Path, text: str, found: str) -> None:
    path = tmp_path / "a.obj"
    path.write_text(text)
    with pytest.raises(InputError, match=f"a.obj: {found} has too few numbers"):
        read_obj(path)


# ---- materials against Mitsuba -------------------------------------------------------------------


def converter(tmp_path: Path, options: ImportOptions = LICENSED) -> MaterialConverter:
    return MaterialConverter(ImportJob(tmp_path / "scene.xml", options))


def draft_of(tmp_path: Path, xml: str) -> Draft:
    scene = parse_scene(write_scene(tmp_path, xml))
    tool = converter(tmp_path)
    draft = tool.draft(scene.all_of("bsdf")[-1])
    assert tool.problems == []
    return draft


def test_conductor_f0_agrees_with_mitsuba(tmp_path: Path, mitsuba_variant: str) -> None:
    import mitsuba as mi

    eta, k = [1.65746, 0.880369, 0.521229], [9.22387, 6.26952, 4.837]
    bsdf = mi.load_dict(
        {"type": "conductor", "eta": {"type": "rgb", "value": eta}, "k": {"type": "rgb", "value": k}}
    )
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(0, 0, 1)
    _, weight = bsdf.sample(mi.BSDFContext(), si, 0.5, mi.Point2f(0.5, 0.5), True)
    expected = np.array(weight).ravel()
    f0 = fresnel.conductor_fresnel(np.ones(1), np.array(eta), np.array(k))[0]
    np.testing.assert_allclose(f0, expected, atol=5e-3)
    draft = draft_of(
        tmp_path,
        '<bsdf type="roughconductor" id="m"><float name="alpha" value="0.09"/>'
        '<rgb name="eta" value="1.65746, 0.880369, 0.521229"/>'
        '<rgb name="k" value="9.22387, 6.26952, 4.837"/></bsdf>',
    )
    np.testing.assert_allclose(draft.specular, expected, atol=0.03)  # means agree, F0 only roughly
    mean = fresnel.conductor_mean(np.array(eta), np.array(k))
    np.testing.assert_allclose(np.array(draft.specular) * 20 / 21 + 1 / 21, mean, atol=1e-6)
    assert draft.diffuse == (0.0, 0.0, 0.0)
    assert draft.roughness == pytest.approx(0.3)  # Beckmann width is unchanged
    gold = fresnel.conductor_preset_mean("Au")
    np.testing.assert_allclose(
        gold,
        fresnel.conductor_mean(np.array([0.143, 0.375, 1.442]), np.array([3.983, 2.386, 1.603])),
        atol=0.03,
    )
    assert fresnel.conductor_preset_mean("none") == (1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="nonsense"):
        fresnel.conductor_preset_mean("nonsense")


def test_sheen_of_diffuse_surfaces_is_removed(mitsuba_variant: str) -> None:
    import drjit as dr
    import mitsuba as mi

    from mitsuba_plugins import register

    register()
    black = {"type": "rgb", "value": [0.0, 0.0, 0.0]}
    bsdf = mi.load_dict(
        {"type": "cook_torrance", "diffuse_albedo": black, "specular_albedo": black, "roughness": 1.0}
    )
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, 1 << 18)
    si = dr.zeros(mi.SurfaceInteraction3f, 1 << 18)
    si.wi = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    value = np.array(bsdf.eval(mi.BSDFContext(), si, wo) / mi.warp.square_to_cosine_hemisphere_pdf(wo))
    assert value.mean() == pytest.approx(fresnel.DIFFUSE_SHEEN, abs=1e-4)


def mitsuba_diffuse_albedo(plugin: dict, num_samples: int = 1 << 18) -> np.ndarray:
    """Estimate the albedo (3,) of a BSDF's diffuse lobe under uniform light by Monte Carlo integration."""
    import drjit as dr
    import mitsuba as mi

    bsdf = mi.load_dict(plugin)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, num_samples)
    si = dr.zeros(mi.SurfaceInteraction3f, num_samples)
    si.wi = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    ctx = mi.BSDFContext()
    ctx.type_mask = mi.BSDFFlags.DiffuseReflection
    value = bsdf.eval(ctx, si, wo) / mi.warp.square_to_cosine_hemisphere_pdf(wo)
    return np.array(value).mean(axis=1)


@pytest.mark.parametrize("nonlinear", [True, False])
def test_plastic_keeps_the_hemispherical_albedo(
    tmp_path: Path, mitsuba_variant: str, nonlinear: bool
) -> None:
    reflectance = [0.9, 0.5, 0.1]
    theirs = mitsuba_diffuse_albedo(
        {
            "type": "plastic",
            "int_ior": 1.5,
            "ext_ior": 1.0,
            "nonlinear": nonlinear,
            "diffuse_reflectance": {"type": "rgb", "value": reflectance},
        }
    )
    draft = draft_of(
        tmp_path,
        '<bsdf type="plastic" id="p"><float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/>'
        f'<boolean name="nonlinear" value="{str(nonlinear).lower()}"/>'
        '<rgb name="diffuse_reflectance" value="0.9, 0.5, 0.1"/></bsdf>',
    )
    ours = (1 - np.array(draft.specular)) * np.array(draft.diffuse)
    np.testing.assert_allclose(draft.specular, 0.04, rtol=1e-6)
    np.testing.assert_allclose(ours, theirs, rtol=0.01)
    other = fresnel.plastic_diffuse_albedo(np.array(reflectance), 1.5, not nonlinear)
    assert np.abs(other / theirs - 1).max() > 0.05  # the test distinguishes the two formulas


def test_beckmann_width_is_the_closest_to_ggx() -> None:
    x = np.concatenate([[0], np.logspace(-5, 5, 200_000)])

    def distance(factor: float) -> float:
        s = factor**2
        difference = np.abs(1 / (1 + x) ** 2 - np.exp(-x / s) / s)
        return float(0.25 * ((difference[1:] + difference[:-1]) * np.diff(x)).sum())

    best = fresnel.ALPHA_BECKMANN_PER_GGX
    assert distance(best) == pytest.approx(0.1798, abs=2e-4)
    assert distance(best) < min(distance(best * 1.05), distance(best / 1.05), distance(1.0), distance(1.2011))
    assert fresnel.perceptual_roughness(0.1, "ggx") == pytest.approx(np.sqrt(0.1 * best))


def test_textures_are_copied_and_only_products_are_baked(tmp_path: Path) -> None:
    colorful(tmp_path / "t.png")
    bitmap = '<texture name="{0}" type="bitmap"><string name="filename" value="t.png"/></texture>'
    plain = draft_of(tmp_path, '<bsdf type="diffuse" id="d">' + bitmap.format("reflectance") + "</bsdf>")
    assert plain.diffuse == ImageSource(tmp_path / "t.png", "srgb", offset=-fresnel.DIFFUSE_SHEEN)
    assert plain.specular == (0.0, 0.0, 0.0)
    assert plain.roughness == 1.0
    glossy = draft_of(
        tmp_path,
        '<bsdf type="roughplastic" id="r"><boolean name="nonlinear" value="true"/>'
        + bitmap.format("diffuse_reflectance")
        + "</bsdf>",
    )
    assert isinstance(glossy.diffuse, BakedSource)
    assert glossy.diffuse.values.shape == (32, 32, 3)
    cache = ImageCache(Budget("scene.xml"))
    linear = cache.values(ImageSource(tmp_path / "t.png", "srgb"), is_scalar=False)
    ior = 1.5046 / 1.000277
    expected = fresnel.plastic_diffuse_albedo(linear, ior, True) / (1 - fresnel.dielectric_f0(ior))
    np.testing.assert_allclose(glossy.diffuse.values, expected, atol=1e-6)


def test_checkerboard_and_uv_transforms_agree_with_mitsuba(mitsuba_variant: str) -> None:
    import drjit as dr
    import mitsuba as mi

    matrix = mi.ScalarTransform4f().rotate([0, 0, 1], 20).scale([3, 5, 1]).translate([0.1, 0.2, 0])
    texture = mi.load_dict(
        {
            "type": "checkerboard",
            "color0": {"type": "rgb", "value": [0.8, 0.1, 0.2]},
            "color1": {"type": "rgb", "value": [0.1, 0.6, 0.9]},
            "to_uv": matrix,
        }
    )
    rng = np.random.default_rng(5)
    down = rng.uniform(-1, 2, (4000, 2))
    si = dr.zeros(mi.SurfaceInteraction3f, len(down))
    si.uv = mi.Point2f(down.T.astype(np.float32))
    theirs = np.array(texture.eval(si)).T
    tile = checkerboard((0.8, 0.1, 0.2), (0.1, 0.6, 0.9)).values
    flat = np.eye(3)
    array = np.array(matrix.matrix).reshape(4, 4)
    flat[:2, :2], flat[:2, 2] = array[:2, :2], array[:2, 3]
    up = transformed_uv(np.stack([down[:, 0], 1 - down[:, 1]], axis=1).astype(np.float32), flat)
    side = len(tile)
    column = np.floor((up[:, 0] % 1) * side).astype(int) % side
    row = np.floor(((1 - up[:, 1]) % 1) * side).astype(int) % side
    agree = np.isclose(tile[row, column], theirs, atol=1e-5).all(axis=1)
    assert agree.mean() > 0.999


def test_bump_maps_tilt_normals_in_the_right_direction() -> None:
    v, u = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64, indexing="ij")
    height = (0.01 * np.sin(2 * np.pi * u) + 0.02 * np.sin(2 * np.pi * (1 - v))).astype(np.float32)
    normal = normal_from_height(height, uv_per_m=0.5)  # the period is two metres
    slope_u = 0.01 * 2 * np.pi * np.cos(2 * np.pi * u) * 0.5
    slope_v = 0.02 * 2 * np.pi * np.cos(2 * np.pi * (1 - v)) * 0.5
    np.testing.assert_allclose(-normal[..., 0] / normal[..., 2], slope_u, atol=2e-4)
    np.testing.assert_allclose(-normal[..., 1] / normal[..., 2], slope_v, atol=4e-4)


def test_bump_maps_of_unnamed_bsdfs_stay_apart(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    body = ""
    for name in ("a", "b"):
        path = tmp_path / "scene" / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(encode_png(rng.integers(0, 255, (8, 8)).astype(np.uint8)))
        body += (
            f'<shape type="rectangle"><bsdf type="bumpmap"><texture type="bitmap">'
            f'<string name="filename" value="{name}.png"/><boolean name="raw" value="true"/></texture>'
            '<bsdf type="diffuse"/></bsdf></shape>'
        )
    record, asset = imported(tmp_path, body)
    first, second = (asset.materials[part.material].normal for part in asset.parts)
    assert first is not None and second is not None
    assert first.texture == "textures/bumpmap_normal.png"
    pixels = [read_image(record.path / normal.texture) for normal in (first, second)]
    assert (pixels[0] != pixels[1]).any()


def test_unknown_bsdfs_and_textures_are_refused_by_name(tmp_path: Path) -> None:
    scene = parse_scene(
        write_scene(
            tmp_path,
            '<bsdf type="hair" id="h"/><bsdf type="diffuse" id="d">'
            '<texture name="reflectance" type="volume"/></bsdf>',
        )
    )
    tool = converter(tmp_path)
    for node in scene.all_of("bsdf"):
        tool.draft(node)
    text = "\n".join(map(str, tool.problems))
    assert "'hair'" in text
    assert "'volume'" in text


# ---- whole scenes --------------------------------------------------------------------------------

ROOM = """
<bsdf type="diffuse" id="Walls"><rgb name="reflectance" value="0.5, 0.6, 0.7"/></bsdf>
<bsdf type="diffuse" id="WoodTable"><rgb name="reflectance" value="0.4, 0.3, 0.2"/></bsdf>
<shape type="cube" id="room"><ref id="Walls"/>
  <transform name="to_world"><scale x="2.5" y="1.4" z="2"/><translate y="1.4"/></transform></shape>
<shape type="cube" id="table">
  <transform name="to_world"><scale x="0.6" y="0.02" z="0.4"/><translate y="0.7" z="-1"/></transform>
  <ref id="WoodTable"/></shape>
<shape type="rectangle" id="window">
  <transform name="to_world"><scale value="0.5"/><rotate y="1" angle="90"/>
    <translate x="-2.4" y="1.5"/></transform>
  <emitter type="area"><rgb name="radiance" value="5"/></emitter></shape>
"""


def test_a_room_gets_its_markers(tmp_path: Path) -> None:
    record, asset = imported(tmp_path, ROOM + SENSOR.replace("0, 1, 4", "0, 1, 1.5"))
    assert {p.name for p in asset.parts} == {"room", "table"}
    (light,) = asset.lights
    assert isinstance(light, AreaLight)
    np.testing.assert_allclose(np.cross(light.edge_u_m, light.edge_v_m), [1, 0, 0], atol=1e-6)
    kinds = {s.kind for s in asset.support_surfaces}
    assert kinds >= {"floor", "table"}
    table = next(s for s in asset.support_surfaces if s.kind == "table")
    assert table.origin_m[2] == pytest.approx(0.72, abs=0.005)
    assert table.edge_u_m[0] == pytest.approx(1.2, abs=0.08)
    assert table.edge_v_m[1] == pytest.approx(0.8, abs=0.08)
    assert asset.camera_regions
    for region in asset.camera_regions:
        assert region.minimum_m[2] == pytest.approx(0.0, abs=0.02)
        assert max(np.abs(region.minimum_m[:2] + region.maximum_m[:2])) < 2.4
    assert [o.name for o in asset.openings] == ["window"]
    assert asset.materials["WoodTable"].classes == ("wood",)
    assert asset.materials["Walls"].classes == ("plaster",)
    camera = asset.cameras[0]
    np.testing.assert_allclose(np.array(camera.asset_from_camera)[:3, 2], [0, 1, 0], atol=1e-6)
    assert (record.path / "import.json").is_file()


@pytest.mark.parametrize(
    ("kind", "scale", "expected"),
    [
        ("sky", "sky_scale", (2, 0)),
        ("sky", "scale", (2, 0)),
        ("sun", "sun_scale", (0, 2)),
        ("sun", "scale", (0, 2)),
        ("sunsky", "sky_scale", (2, 1)),
        ("sunsky", "sun_scale", (1, 2)),
    ],
)
def test_daylight_keeps_its_scales(
    tmp_path: Path, kind: str, scale: str, expected: tuple[float, float]
) -> None:
    emitter = (
        f'<emitter type="{kind}"><vector name="sun_direction" x="0" y="1" z="0"/>'
        f'<float name="{scale}" value="2"/></emitter>'
    )
    _, asset = imported(tmp_path, ROOM + SENSOR + emitter)
    (light,) = (light for light in asset.lights if light.type == "sky")
    assert (light.sky_scale, light.sun_scale) == expected
    np.testing.assert_allclose(light.sun_direction, [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize("name", ["measured", "convert", "nested", "lobe_width"])
def test_unknown_bsdfs_are_refused_by_name(tmp_path: Path, name: str) -> None:
    """Types that equal names of the importer's functions are refused like any unknown type."""
    scene = f'<shape type="cube"><bsdf type="{name}"/></shape>'
    with pytest.raises(InputError, match=f"type '{name}'.*a supported BSDF: diffuse, plastic"):
        imported(tmp_path, scene)


def test_annotations_override_the_scene(tmp_path: Path) -> None:
    sidecar = tmp_path / "places.yaml"
    sidecar.write_text(
        "support_surfaces: []\ncamera_regions:\n- {minimum_m: [-1, -1, 0], maximum_m: [1, 1, 2]}\n"
        "classes: {Walls: [painted]}\nreplaceable_by: {Walls: [painted, plaster]}\n"
    )
    options = ImportOptions(license="CC0-1.0", annotations=sidecar, unit_scale=2.0, as_zip=True)
    record, asset = imported(tmp_path, ROOM + SENSOR, options)
    assert record.path.suffix == ".zip"
    assert asset.support_surfaces == ()
    assert asset.camera_regions[0].maximum_m == (1.0, 1.0, 2.0)
    assert asset.materials["Walls"].classes == ("painted",)
    assert isinstance(asset.lights[0], AreaLight)
    np.testing.assert_allclose(np.linalg.norm(asset.lights[0].edge_u_m), 2.0, rtol=1e-6)
    sidecar.write_text("supports: []\n")
    with pytest.raises(InputError, match="supports"):
        imported(tmp_path / "again", ROOM, options)
    sidecar.write_text("classes: {Walls: []}\n")
    with pytest.raises(InputError, match=r"classes.Walls.*at least 1 item"):
        imported(tmp_path / "again", ROOM, options)


GLASS = """
<bsdf type="dielectric" id="Clear"/><bsdf type="thindielectric" id="Pane"/>
<shape type="cube"><bsdf type="diffuse"/></shape>
<shape type="sphere"><ref id="Clear"/></shape>
<shape type="rectangle"><transform name="to_world"><translate z="3"/></transform><ref id="Clear"/></shape>
<shape type="rectangle"><ref id="Pane"/></shape>
"""


def test_glass_is_refused_or_replaced_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        imported(tmp_path, GLASS)
    assert "material 'Clear'" in str(caught.value)
    assert "material 'Pane'" in str(caught.value)
    assert not (tmp_path / "library").exists() or not any((tmp_path / "library").rglob("asset.json"))
    record, asset = imported(tmp_path / "b", GLASS, ImportOptions(license="CC0-1.0", dielectric="replace"))
    assert len(asset.parts) == 2  # the cube and the ball; panes are left out
    assert asset.materials["Clear"].classes == ("glass",)
    text = "\n".join(record.approximations)
    assert "Clear: transparent, left out" in text
    assert "Pane: transparent, left out" in text
    assert "opal glass" in text
    options = ImportOptions(license="CC0-1.0", dielectric_as={"Clear": "remove", "Pane": "opaque"})
    _, asset = imported(tmp_path / "c", GLASS, options)
    assert {p.material for p in asset.parts} == {"diffuse", "Pane"}


def test_all_invisible_shapes_are_counted(tmp_path: Path) -> None:
    body = '<bsdf type="null" id="Air"/>' + '<shape type="sphere"><ref id="Air"/></shape>' * 2
    record, _ = imported(tmp_path, ROOM + body)
    assert "Air: null BSDF, surface left out; 2 shapes" in record.approximations


def test_missing_files_are_all_listed_or_replaced_by_name(tmp_path: Path) -> None:
    body = (
        '<shape type="cube"><bsdf type="diffuse"><texture name="reflectance" type="bitmap">'
        '<string name="filename" value="rug.png"/></texture></bsdf></shape>'
        '<shape type="obj"><string name="filename" value="mesh.obj"/></shape>'
        '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    )
    with pytest.raises(InputError) as caught:
        imported(tmp_path, body)
    for name in ("rug.png", "mesh.obj", "sky.exr"):
        assert name in str(caught.value)
    record, asset = imported(tmp_path / "b", body, ImportOptions(license="CC0-1.0", missing="replace"))
    assert len(asset.parts) == 1
    for name in ("rug.png", "mesh.obj", "sky.exr"):
        assert name in "\n".join(record.approximations)


def test_files_outside_the_scene_are_refused(tmp_path: Path) -> None:
    colorful(tmp_path / "secret.png")
    body = (
        '<shape type="cube"><bsdf type="diffuse"><texture name="reflectance" type="bitmap">'
        '<string name="filename" value="../secret.png"/></texture></bsdf></shape>'
    )
    with pytest.raises(InputError, match="inside the scene's folder"):
        imported(tmp_path, body, ImportOptions(license="CC0-1.0", missing="replace"))


def test_a_licence_is_given_or_found_but_never_invented(tmp_path: Path, shared_data: Path) -> None:
    with pytest.raises(InputError, match="--license"):
        imported(tmp_path, "<shape type='cube'/>", ImportOptions())
    origin = detect_origin(shared_data / "scenes" / "staircase")
    assert (origin.license, origin.author, origin.title) == ("CC-BY-3.0", "Wig42", "The Wooden Staircase")
    assert detect_origin(shared_data / "scenes" / "veach-ajar").license == "CC0-1.0"
    assert detect_origin(shared_data / "textures" / "ambientcg" / "gold").author == "ambientCG"


def test_test_scenes_of_the_paper_are_for_evaluation_only(tmp_path: Path) -> None:
    body = "<shape type='cube'/>"
    path = write_scene(tmp_path / "veach-ajar", body)
    record = import_mitsuba_scene(path, tmp_path / "library", LICENSED)
    assert open_package(record.path).asset.provenance.usage == "evaluation_only"
    assert any("evaluation_only" in note for note in record.notes)
    other = import_mitsuba_scene(write_scene(tmp_path / "loft", body), tmp_path / "library", LICENSED)
    assert open_package(other.path).asset.provenance.usage == "any"


def test_meshes_used_twice_are_stored_once(tmp_path: Path) -> None:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    folder = tmp_path / "scene"
    folder.mkdir()
    mesh = Mesh(positions, np.array([[0, 1, 2]], np.int32), None, positions[:, :2])
    (folder / "m.ply").write_bytes(encode_ply(mesh))
    shape = '<shape type="ply"><string name="filename" value="m.ply"/>{}</shape>'
    moved = '<transform name="to_world"><scale x="-2" y="1" z="1"/><translate x="5"/></transform>'
    _, asset = imported(tmp_path, shape.format("") + shape.format(moved) + '<shape type="cube"/>')
    assert len({part.mesh for part in asset.parts}) == 2
    second = np.array(asset.parts[1].asset_from_part)
    np.testing.assert_allclose(second @ [1, 0, 0, 1], [3, 0, 0, 1])
    np.testing.assert_allclose(second @ [0, 1, 0, 1], [5, 0, 1, 1])


def test_the_same_scene_gives_the_same_bytes(tmp_path: Path) -> None:
    options = ImportOptions(license="CC0-1.0", as_zip=True, asset_id="room")
    first, _ = imported(tmp_path / "a", ROOM + SENSOR, options)
    second, _ = imported(tmp_path / "b", ROOM + SENSOR, options)
    assert first.path.read_bytes() == second.path.read_bytes()


def test_mirrored_emitters_keep_their_side() -> None:
    for mirror, flip in ((1.0, False), (-1.0, False), (1.0, True)):
        node = SceneNode("shape", "rectangle", values={"flip_normals": flip})
        matrix = np.diag([mirror, 2.0, 1.0, 1.0])
        light = emitter_shape_light(node, "l", matrix, (1.0, 1.0, 1.0))
        assert isinstance(light, AreaLight)
        # Mitsuba transforms normals by the inverse transpose: a mirrored rectangle still faces +z
        normal = np.cross(light.edge_u_m, light.edge_v_m)
        assert np.sign(normal[2]) == (-1 if flip else 1)
    sheared = np.eye(4)
    sheared[0, 1] = 0.5
    assert emitter_shape_light(SceneNode("shape", "rectangle"), "l", sheared, (1.0, 1.0, 1.0)) is None


SHAPES = """
<shape type="rectangle">{bsdf}
  <transform name="to_world"><scale value="0.8"/><translate x="-1.6" y="1.9"/></transform></shape>
<shape type="cube">{bsdf}
  <transform name="to_world"><scale value="0.45"/>
  <rotate y="1" angle="30"/>
  <rotate x="1" angle="25"/><translate x="0" y="1.9"/></transform></shape>
<shape type="sphere"><point name="center" x="1.6" y="1.9" z="0"/><float name="radius" value="0.7"/>
  {bsdf}</shape>
<shape type="obj"><string name="filename" value="q.obj"/>{bsdf}
  <transform name="to_world"><translate x="-1.6"/></transform></shape>
<shape type="ply"><string name="filename" value="q.ply"/>{bsdf}
  <boolean name="face_normals" value="true"/></shape>
<shape type="cylinder"><point name="p0" x="1.3" y="-0.5" z="0"/><point name="p1" x="1.9" y="0.6" z="0.3"/>
  <float name="radius" value="0.4"/>{bsdf}</shape>
"""


def test_every_shape_looks_as_in_mitsuba(tmp_path: Path, mitsuba_variant: str) -> None:
    """Renderings of the original and the imported scene agree in shapes, textures, camera and sky."""
    import OpenEXR

    from datagen.library import Library
    from oracles.imported_renders import render_converted, render_original

    folder = tmp_path / "scene"
    colorful(folder / "t.png", 64)
    quad = np.array([[-0.7, -0.7, 0], [0.7, -0.7, 0], [0.7, 0.7, 0.2], [-0.7, 0.7, 0]], np.float32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    (folder / "q.ply").write_bytes(
        encode_ply(Mesh(quad, np.array([[0, 1, 2], [0, 2, 3]], np.int32), None, uv))
    )
    rows = (
        [f"v {p[0]} {p[1]} {p[2]}" for p in quad] + [f"vt {t[0]} {t[1]}" for t in uv] + ["f 1/1 2/2 3/3 4/4"]
    )
    (folder / "q.obj").write_text("\n".join(rows))
    v, u = np.meshgrid(np.linspace(0, 1, 32), np.linspace(0, 1, 64), indexing="ij")
    sky = np.stack([0.2 + (u > 0.7) * 2.0, 0.3 + 0 * u, 0.2 + (v < 0.4) * 1.0], axis=-1).astype(np.float32)
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"RGB": sky}).write(
        str(folder / "sky.exr")
    )
    bsdf = (
        '<bsdf type="twosided"><bsdf type="diffuse"><texture name="reflectance" type="bitmap">'
        '<string name="filename" value="t.png"/></texture></bsdf></bsdf>'
    )
    body = SHAPES.format(bsdf=bsdf) + (
        '<emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="1.5"/>'
        '<transform name="to_world"><rotate y="1" angle="70"/>'
        '<rotate x="1" angle="20"/></transform></emitter>'
    )
    record, asset = imported(tmp_path, body + SENSOR.replace('fov" value="60"', 'fov" value="75"'))
    assert isinstance(asset.lights[0], EnvironmentLight)
    theirs = render_original(tmp_path / "scene", 64, 256, 3)
    with Library([record.path]) as library:
        ours = render_converted(library, record.asset_id, 64, 256, 3)
    difference = np.abs(ours - theirs)
    # noise and edges differ; a rotated texture or sky would give 0.2 or more
    assert difference.mean() < 0.06 * theirs.mean()
    assert agreement(ours, theirs).correlation > 0.998
    flipped = np.flip(theirs, axis=1)
    assert np.abs(ours - flipped).mean() > 0.1 * theirs.mean()


# ---- markers -------------------------------------------------------------------------------------


def test_largest_rectangle_against_brute_force() -> None:
    rng = np.random.default_rng(11)
    for _ in range(60):
        mask = rng.random((7, 9)) < rng.uniform(0.5, 0.95)
        min_side = int(rng.integers(1, 4))
        best = 0
        for x0 in range(7):
            for x1 in range(x0 + min_side, 8):
                for y0 in range(9):
                    for y1 in range(y0 + min_side, 10):
                        if mask[x0:x1, y0:y1].all():
                            best = max(best, (x1 - x0) * (y1 - y0))
        x0, x1, y0, y1 = largest_rectangle(mask, min_side)
        assert (x1 - x0) * (y1 - y0) == best
        assert mask[x0:x1, y0:y1].all()


def test_open_space_has_no_markers() -> None:
    plate = shape_mesh(SceneNode("shape", "rectangle"), None, Budget("x"))[0].triangles()
    places = find_places(plate, np.zeros(len(plate), np.int64), set(), np.zeros((0, 3)))
    assert places.floor_m is None
    assert places.camera_regions == ()


# ---- real scenes ---------------------------------------------------------------------------------


def test_a_real_scene_is_imported(tmp_path: Path, shared_data: Path) -> None:
    source = shared_data / "scenes" / "staircase2"
    with pytest.raises(InputError, match="material 'Glass'"):
        import_mitsuba_scene(source, tmp_path)
    record = import_mitsuba_scene(source, tmp_path, ImportOptions(dielectric="replace"))
    package = open_package(record.path)
    asset = package.asset
    assert isinstance(asset, EnvironmentAsset)
    assert asset.provenance.license == "CC-BY-3.0"
    assert len(asset.parts) == 18
    assert len(asset.lights) == 13
    assert sum(s.kind == "floor" for s in asset.support_surfaces) >= 3
    wall = asset.materials["Wallpaper"].diffuse_albedo
    assert isinstance(wall, Texture)
    assert package.read_bytes(wall.texture) == (source / "textures" / "Wallpaper.jpg").read_bytes()
    wood = asset.materials["Wood"]
    assert isinstance(wood.diffuse_albedo, Texture)
    assert (
        read_image(package.local_file(wood.diffuse_albedo.texture)).shape
        == read_image(source / "textures" / "wood5.jpg").shape
    )
    assert wood.specular_albedo == (0.04, 0.04, 0.04)
    assert native_configuration(package, 64).cameras[0].width_px == 64
    assert json.loads((record.path / "import.json").read_text())["license"] == "CC-BY-3.0"
