# SPDX-License-Identifier: GPL-3.0-or-later
"""Node graphs of many kinds, each with the closed form of its expected channels.

``python -m tests.blender_addon.graphs OUT`` builds all of them in one file, exports them with the add-on and
saves the .blend. Each graph shades a unit square from (0, 0) to (1, 1) in the XY plane with uv = (x, y),
unless the case defines other geometry; expected values are functions of the position (N, 3) in metres.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from datagen.foundation.color import linear_from_srgb

Expected = Callable[[np.ndarray], np.ndarray]
F0 = 0.04  # F0 of the default refractive index, 1.5


@dataclass
class Case:
    """A graph created by ``build``; ``expected`` channels are constants or functions of position (N, 3)."""

    name: str
    build: Callable[[Stage], None]
    expected: dict[str, Any]
    kinds: dict[str, str] = field(default_factory=dict)


CASES: list[Case] = []


def case(kinds: dict[str, str] | None = None, **expected: Any) -> Callable[[Callable[[Stage], None]], Any]:
    """Decorator that registers a graph; ``kinds``: channels exported as "constant", "image" or "texture"."""

    def register(build: Callable[[Stage], None]) -> Callable[[Stage], None]:
        CASES.append(Case(build.__name__, build, expected, kinds or {}))
        return build

    return register


class Stage:
    """A square with a material, and shorthand for creating nodes."""

    def __init__(self, bpy: Any, name: str):
        self.bpy, self.name = bpy, name
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.material["sm_class"] = "other"
        self.tree = self.material.node_tree
        self.shader = self.tree.nodes["Principled BSDF"]
        self.output = self.tree.nodes["Material Output"]
        self.collection = bpy.data.collections.new(name)
        bpy.context.scene.collection.children.link(self.collection)
        self.collection["sm_role"] = "object"
        self.collection["sm_category"] = "sample"
        self.collection["sm_keep_origin"] = True
        self.mesh = self.square()
        self.thing = self.add(self.mesh)

    def square(self, uv_of: Callable[[np.ndarray], np.ndarray] = lambda xy: xy, num: int = 4) -> Any:
        mesh = self.bpy.data.meshes.new(self.name)
        ticks = np.linspace(0, 1, num + 1)
        points = [(x, y, 0.0) for y in ticks for x in ticks]
        faces = [
            (i + j * (num + 1), i + 1 + j * (num + 1), i + 1 + (j + 1) * (num + 1), i + (j + 1) * (num + 1))
            for j in range(num)
            for i in range(num)
        ]
        mesh.from_pydata(points, [], faces)
        layer = mesh.uv_layers.new(name="UVMap")
        xy = np.array([points[v][:2] for face in faces for v in face])
        layer.uv.foreach_set("vector", np.asarray(uv_of(xy), np.float32).ravel())
        mesh.materials.append(self.material)
        return mesh

    def add(self, mesh: Any, location: tuple[float, float, float] = (0, 0, 0)) -> Any:
        thing = self.bpy.data.objects.new(self.name, mesh)
        thing.location = location
        self.collection.objects.link(thing)
        return thing

    def node(self, kind: str, tree: Any = None, **properties: Any) -> Any:
        node = (tree or self.tree).nodes.new(f"ShaderNode{kind}")
        for name, value in properties.items():
            setattr(node, name, value)
        return node

    def link(self, source: Any, target: Any, tree: Any = None) -> None:
        (tree or self.tree).links.new(source, target)

    def surface(self, node: Any) -> None:
        self.link(node.outputs[0], self.output.inputs["Surface"])

    def uv(self) -> Any:
        return self.node("TexCoord").outputs["UV"]

    def split(self, socket: Any) -> Any:
        node = self.node("SeparateXYZ")
        self.link(socket, node.inputs[0])
        return node.outputs

    def math(self, operation: str, a: Any, b: Any = None) -> Any:
        node = self.node("Math", operation=operation)
        for socket, value in zip(node.inputs, (a, b), strict=False):
            if isinstance(value, (int, float)):
                socket.default_value = value
            elif value is not None:
                self.link(value, socket)
        return node.outputs[0]

    def image(self, pixels: np.ndarray, space: str = "sRGB", name: str = "", packed: bool = True) -> Any:
        """Create an 8-bit image with the given stored values (H, W, 3 or 4), row 0 at the top."""
        height, width, channels = pixels.shape
        image = self.bpy.data.images.new(name or self.name, width, height, alpha=channels == 4)
        full = np.ones((height, width, 4), np.float32)
        full[..., :channels] = pixels[::-1]
        image.pixels.foreach_set(full.ravel())
        image.file_format = "PNG"
        image.filepath_raw = str(FOLDER / f"{self.name}_{image.name}.png")
        image.save()
        path = image.filepath_raw
        self.bpy.data.images.remove(image)
        image = self.bpy.data.images.load(path)
        image.colorspace_settings.name = space
        if packed:
            image.pack()
        return image

    def texture(self, image: Any, vector: Any = None, **properties: Any) -> Any:
        node = self.node("TexImage", image=image, **properties)
        if vector is not None:
            self.link(vector, node.inputs["Vector"])
        return node

    def group(self, name: str = "") -> Any:
        """Create an empty node group."""
        return self.bpy.data.node_groups.new(name or self.name, "ShaderNodeTree")


FOLDER = Path()


def smooth_image(size: int = 64, channels: int = 3) -> np.ndarray:
    """Stored values (size, size, channels) in [0, 1] that vary slowly and tile."""
    t = (np.arange(size) + 0.5) / size * 2 * np.pi
    y, x = np.meshgrid(t, t, indexing="ij")
    stack = [0.5 + 0.35 * np.sin(x), 0.5 + 0.35 * np.cos(y), 0.5 + 0.3 * np.sin(x + y), 0.6 + 0.3 * np.cos(x)]
    return np.round(np.stack(stack[:channels], axis=-1) * 255) / 255


def lookup(pixels: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear lookup (N, C), at ``uv`` (N, 2), in tiled ``pixels`` (H, W, C) whose row 0 is at v = 1."""
    height, width = pixels.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    at = lambda i, j: pixels[j % height, i % width]  # noqa: E731
    top = at(x0, y0) * (1 - fx) + at(x0 + 1, y0) * fx
    bottom = at(x0, y0 + 1) * (1 - fx) + at(x0 + 1, y0 + 1) * fx
    return top * (1 - fy) + bottom * fy


def grey(values: np.ndarray) -> np.ndarray:
    return np.repeat(np.asarray(values)[:, None], 3, axis=1)


# ---- constants


@case(diffuse_albedo=(0.2, 0.4, 0.6), specular_albedo=F0, roughness=0.3, kinds={"diffuse_albedo": "constant"})
def principled_constant(s: Stage) -> None:
    s.shader.inputs["Base Color"].default_value = (0.2, 0.4, 0.6, 1)
    s.shader.inputs["Roughness"].default_value = 0.3


@case(diffuse_albedo=0.0, specular_albedo=(0.9, 0.6, 0.3), roughness=0.5)
def principled_metal(s: Stage) -> None:
    s.shader.inputs["Base Color"].default_value = (0.9, 0.6, 0.3, 1)
    s.shader.inputs["Metallic"].default_value = 1


@case(diffuse_albedo=0.25, specular_albedo=0.5 * F0 + 0.25, roughness=0.5)
def principled_half_metal(s: Stage) -> None:
    s.shader.inputs["Base Color"].default_value = (0.5, 0.5, 0.5, 1)
    s.shader.inputs["Metallic"].default_value = 0.5


@case(specular_albedo=tuple((0.8 / 2.8) ** 2 * 2 * 0.7 * t for t in (1.0, 0.5, 0.25)), diffuse_albedo=0.8)
def principled_ior_level_tint(s: Stage) -> None:
    s.shader.inputs["IOR"].default_value = 1.8
    s.shader.inputs["Specular IOR Level"].default_value = 0.7
    s.shader.inputs["Specular Tint"].default_value = (1, 0.5, 0.25, 1)


@case(diffuse_albedo=(0.1, 0.2, 0.3), roughness=0.7, kinds={"roughness": "constant"})
def value_and_rgb_nodes(s: Stage) -> None:
    colour, value = s.node("RGB"), s.node("Value")
    colour.outputs[0].default_value = (0.1, 0.2, 0.3, 1)
    value.outputs[0].default_value = 0.7
    s.link(colour.outputs[0], s.shader.inputs["Base Color"])
    s.link(value.outputs[0], s.shader.inputs["Roughness"])


@case(roughness=0.25**0.5 * 0.8, kinds={"roughness": "constant"})
def constant_through_math(s: Stage) -> None:
    s.link(s.math("MULTIPLY", s.math("SQRT", 0.25), 0.8), s.shader.inputs["Roughness"])


@case(roughness=0.2126729 * 0.9 + 0.7151522 * 0.3 + 0.072175 * 0.1)
def colour_into_value_is_luminance(s: Stage) -> None:
    colour = s.node("RGB")
    colour.outputs[0].default_value = (0.9, 0.3, 0.1, 1)
    s.link(colour.outputs[0], s.shader.inputs["Roughness"])


@case(diffuse_albedo=(0.7, 0.2, 0.1), specular_albedo=0.0, roughness=1.0)
def diffuse_bsdf(s: Stage) -> None:
    node = s.node("BsdfDiffuse")
    node.inputs["Color"].default_value = (0.7, 0.2, 0.1, 1)
    s.surface(node)


@case(diffuse_albedo=0.0, specular_albedo=(0.3, 0.5, 0.7), roughness=0.25)
def glossy_bsdf(s: Stage) -> None:
    node = s.node("BsdfAnisotropic")
    node.inputs["Color"].default_value = (0.3, 0.5, 0.7, 1)
    node.inputs["Roughness"].default_value = 0.25
    s.surface(node)


@case(diffuse_albedo=0.0, specular_albedo=(0.6, 0.55, 0.5), roughness=0.4)
def metallic_bsdf_f82(s: Stage) -> None:
    node = s.node("BsdfMetallic", fresnel_type="F82")
    node.inputs["Base Color"].default_value = (0.6, 0.55, 0.5, 1)
    node.inputs["Edge Tint"].default_value = (1, 1, 1, 1)
    node.inputs["Roughness"].default_value = 0.4
    s.surface(node)


_N, _K = np.array([0.2, 0.92, 1.1]), np.array([3.9, 2.45, 2.1])


@case(
    diffuse_albedo=0.0,
    specular_albedo=tuple(((_N - 1) ** 2 + _K**2) / ((_N + 1) ** 2 + _K**2)),
    roughness=0.2,
)
def metallic_bsdf_conductor(s: Stage) -> None:
    node = s.node("BsdfMetallic", fresnel_type="PHYSICAL_CONDUCTOR")
    node.inputs["IOR"].default_value = tuple(_N)
    node.inputs["Extinction"].default_value = tuple(_K)
    node.inputs["Roughness"].default_value = 0.2
    s.surface(node)


def _mix(s: Stage, first: Any, second: Any, factor: Any) -> Any:
    node = s.node("MixShader")
    if isinstance(factor, float):
        node.inputs[0].default_value = factor
    else:
        s.link(factor, node.inputs[0])
    s.link(first.outputs[0], node.inputs[1])
    s.link(second.outputs[0], node.inputs[2])
    return node


def _diffuse(s: Stage, colour: tuple[float, float, float]) -> Any:
    node = s.node("BsdfDiffuse")
    node.inputs["Color"].default_value = (*colour, 1)
    return node


def _glossy(s: Stage, colour: tuple[float, float, float], roughness: float) -> Any:
    node = s.node("BsdfAnisotropic")
    node.inputs["Color"].default_value = (*colour, 1)
    node.inputs["Roughness"].default_value = roughness
    return node


# The diffuse reflectance of the mix, 0.7 * 0.4, is (1 - S) D.
@case(diffuse_albedo=0.7 * 0.4 / (1 - 0.3 * 0.8), specular_albedo=0.3 * 0.8, roughness=0.35)
def mix_of_diffuse_and_glossy(s: Stage) -> None:
    s.surface(_mix(s, _diffuse(s, (0.4,) * 3), _glossy(s, (0.8,) * 3, 0.35), 0.3))


@case(diffuse_albedo=0.5, specular_albedo=((1.45 - 1) / 2.45) ** 2, roughness=0.2)
def mix_by_fresnel_is_a_dielectric(s: Stage) -> None:
    fresnel = s.node("Fresnel")
    fresnel.inputs["IOR"].default_value = 1.45
    s.surface(_mix(s, _diffuse(s, (0.5,) * 3), _glossy(s, (1.0,) * 3, 0.2), fresnel.outputs[0]))


@case(diffuse_albedo=0.3 / 0.9, specular_albedo=0.1, roughness=0.15)
def sum_of_diffuse_and_glossy(s: Stage) -> None:
    node = s.node("AddShader")
    s.link(_diffuse(s, (0.3,) * 3).outputs[0], node.inputs[0])
    s.link(_glossy(s, (0.1,) * 3, 0.15).outputs[0], node.inputs[1])
    s.surface(node)


_WIDTH = (0.5 * 0.2 * 0.2**2 + 0.5 * 0.6 * 0.8**2) / (0.5 * 0.2 + 0.5 * 0.6)


@case(diffuse_albedo=0.0, specular_albedo=0.4, roughness=_WIDTH**0.5)
def mix_of_two_glossies(s: Stage) -> None:
    s.surface(_mix(s, _glossy(s, (0.2,) * 3, 0.2), _glossy(s, (0.6,) * 3, 0.8), 0.5))


@case(diffuse_albedo=(0.6, 0.3, 0.2), specular_albedo=0.0)
def subsurface_bsdf(s: Stage) -> None:
    node = s.node("SubsurfaceScattering")
    node.inputs["Color"].default_value = (0.6, 0.3, 0.2, 1)
    s.surface(node)


@case(diffuse_albedo=(0.5 * 0.3 + 0.5 * 0.6,) * 3, specular_albedo=0.0)
def diffuse_and_translucent(s: Stage) -> None:
    node = s.node("BsdfTranslucent")
    node.inputs["Color"].default_value = (0.6, 0.6, 0.6, 1)
    s.surface(_mix(s, _diffuse(s, (0.3,) * 3), node, 0.5))


_COAT = 0.5 * F0


@case(
    diffuse_albedo=0.8 * (1 - F0) * (1 - _COAT) / (1 - (F0 * (1 - _COAT) ** 2 + _COAT)),
    specular_albedo=F0 * (1 - _COAT) ** 2 + _COAT,
)
def coat(s: Stage) -> None:
    s.shader.inputs["Coat Weight"].default_value = 0.5


@case(diffuse_albedo=0.8 * 0.5, specular_albedo=F0)
def transmission_as_opaque(s: Stage) -> None:
    s.material["sm_transmission"] = "opaque"
    s.shader.inputs["Transmission Weight"].default_value = 0.5


@case(opacity=0.25, diffuse_albedo=0.5)
def transmission_as_mask(s: Stage) -> None:
    s.material["sm_transmission"] = "mask"
    glass = s.node("BsdfGlass")
    s.surface(_mix(s, _diffuse(s, (0.5,) * 3), glass, 0.75))


@case(emission=(2.0, 1.0, 0.5), diffuse_albedo=0.8)
def emission_of_principled(s: Stage) -> None:
    s.shader.inputs["Emission Color"].default_value = (1, 0.5, 0.25, 1)
    s.shader.inputs["Emission Strength"].default_value = 2


@case(diffuse_albedo=0.3, specular_albedo=0.0)
def light_path_is_a_camera_ray(s: Stage) -> None:
    path = s.node("LightPath")
    s.surface(_mix(s, _glossy(s, (1.0,) * 3, 0.1), _diffuse(s, (0.3,) * 3), path.outputs["Is Camera Ray"]))


@case(diffuse_albedo=0.37, specular_albedo=0.0)
def material_without_nodes(s: Stage) -> None:
    s.material.use_nodes = False
    s.material.diffuse_color = (0.37, 0.37, 0.37, 1)
    if s.material.use_nodes:  # since Blender 5.0 every material has nodes
        s.surface(_diffuse(s, (0.37,) * 3))


# ---- groups, reroutes, muted nodes


@case(roughness=0.6, diffuse_albedo=0.8, kinds={"roughness": "constant"})
def group_with_inputs(s: Stage) -> None:
    tree = s.group()
    tree.interface.new_socket("Value", in_out="INPUT", socket_type="NodeSocketFloat")
    tree.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    inner = s.node("BsdfPrincipled", tree)
    s.link(start.outputs[0], inner.inputs["Roughness"], tree)
    s.link(inner.outputs[0], end.inputs[0], tree)
    node = s.node("Group", node_tree=tree)
    node.inputs[0].default_value = 0.6
    s.surface(node)


@case(diffuse_albedo=lambda p: grey(p[:, 0] * 0.5), roughness=lambda p: p[:, 1])
def nested_groups_with_coordinates(s: Stage) -> None:
    inner = s.bpy.data.node_groups.new("inner", "ShaderNodeTree")
    inner.interface.new_socket("Scale", in_out="INPUT", socket_type="NodeSocketFloat")
    inner.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    start, end = inner.nodes.new("NodeGroupInput"), inner.nodes.new("NodeGroupOutput")
    split, scale, shader = (
        s.node("SeparateXYZ", inner),
        s.node("Math", inner),
        s.node("BsdfPrincipled", inner),
    )
    scale.operation = "MULTIPLY"
    s.link(s.node("TexCoord", inner).outputs["UV"], split.inputs[0], inner)
    s.link(split.outputs[0], scale.inputs[0], inner)
    s.link(start.outputs[0], scale.inputs[1], inner)
    s.link(scale.outputs[0], shader.inputs["Base Color"], inner)
    s.link(split.outputs[1], shader.inputs["Roughness"], inner)
    s.link(shader.outputs[0], end.inputs[0], inner)
    outer = s.group()
    outer.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    end = outer.nodes.new("NodeGroupOutput")
    use = s.node("Group", outer, node_tree=inner)
    use.inputs[0].default_value = 0.5
    s.link(use.outputs[0], end.inputs[0], outer)
    s.surface(s.node("Group", node_tree=outer))


@case(diffuse_albedo=(0.2, 0.3, 0.4))
def reroute_and_muted_node(s: Stage) -> None:
    colour, invert = s.node("RGB"), s.node("Invert")
    colour.outputs[0].default_value = (0.2, 0.3, 0.4, 1)
    invert.mute = True
    reroute = s.tree.nodes.new("NodeReroute")
    s.link(colour.outputs[0], reroute.inputs[0])
    s.link(reroute.outputs[0], invert.inputs["Color"])
    s.link(invert.outputs[0], s.shader.inputs["Base Color"])


# ---- UV only


@case(diffuse_albedo=lambda p: np.stack([p[:, 0], p[:, 1], 0 * p[:, 0]], axis=1), roughness=0.5)
def uv_as_colour(s: Stage) -> None:
    s.link(s.uv(), s.shader.inputs["Base Color"])


@case(roughness=lambda p: np.clip(p[:, 0] * 1.5 - 0.2, 0, 1), specular_albedo=F0)
def roughness_gradient_beyond_range(s: Stage) -> None:
    x = s.split(s.uv())[0]
    s.link(s.math("SUBTRACT", s.math("MULTIPLY", x, 1.5), 0.2), s.shader.inputs["Roughness"])


@case(
    diffuse_albedo=lambda p: grey(0.8 * (1 - p[:, 0])),
    specular_albedo=lambda p: grey(F0 * (1 - p[:, 0]) + 0.8 * p[:, 0]),
)
def metallic_gradient(s: Stage) -> None:
    s.link(s.split(s.uv())[0], s.shader.inputs["Metallic"])


_BLEND = lambda p: p[:, 0]  # noqa: E731


@case(
    diffuse_albedo=lambda p: grey((1 - _BLEND(p)) * 0.4 / (1 - 0.8 * _BLEND(p))),
    specular_albedo=lambda p: grey(0.8 * _BLEND(p)),
    roughness=0.35,
)
def mix_by_gradient(s: Stage) -> None:
    x = s.split(s.uv())[0]
    s.surface(_mix(s, _diffuse(s, (0.4,) * 3), _glossy(s, (0.8,) * 3, 0.35), x))


@case(diffuse_albedo=lambda p: grey(0.25 + p[:, 0] * 0.5))
def colour_ramp(s: Stage) -> None:
    ramp = s.node("ValToRGB")
    ramp.color_ramp.elements[0].color = (0.25, 0.25, 0.25, 1)
    ramp.color_ramp.elements[1].color = (0.75, 0.75, 0.75, 1)
    s.link(s.split(s.uv())[0], ramp.inputs[0])
    s.link(ramp.outputs[0], s.shader.inputs["Base Color"])


@case(roughness=lambda p: 0.5 + 0.4 * np.sin(2 * np.pi * (p[:, 0] * 3 - 1)))
def uv_beyond_the_unit_square(s: Stage) -> None:
    s.thing.data = s.square(lambda xy: xy * 3 - 1)
    x = s.split(s.uv())[0]
    wave = s.math("SINE", s.math("MULTIPLY", x, 2 * np.pi))
    s.link(s.math("ADD", s.math("MULTIPLY", wave, 0.4), 0.5), s.shader.inputs["Roughness"])


@case(diffuse_albedo=lambda p: np.stack([1 - p[:, 0], p[:, 1], 0 * p[:, 0]], axis=1))
def second_uv_map(s: Stage) -> None:
    layer = s.mesh.uv_layers.new(name="Second")
    values = np.empty((len(s.mesh.loops), 2), np.float32)
    s.mesh.uv_layers["UVMap"].uv.foreach_get("vector", values.ravel())
    values[:, 0] = 1 - values[:, 0]
    layer.uv.foreach_set("vector", values.ravel())
    s.link(s.node("UVMap", uv_map="Second").outputs[0], s.shader.inputs["Base Color"])


@case(
    diffuse_albedo=lambda p: np.stack([p[:, 0], p[:, 1] * 0, 0 * p[:, 0]], axis=1),
    roughness=lambda p: 1 - p[:, 1],
)
def two_uv_maps_at_once(s: Stage) -> None:
    layer = s.mesh.uv_layers.new(name="Second")
    values = np.empty((len(s.mesh.loops), 2), np.float32)
    s.mesh.uv_layers["UVMap"].uv.foreach_get("vector", values.ravel())
    layer.uv.foreach_set("vector", np.ascontiguousarray(1 - values).ravel())
    combine = s.node("CombineXYZ")
    s.link(s.split(s.uv())[0], combine.inputs[0])
    s.link(combine.outputs[0], s.shader.inputs["Base Color"])
    s.link(s.split(s.node("UVMap", uv_map="Second").outputs[0])[1], s.shader.inputs["Roughness"])


# ---- images


@case(diffuse_albedo=lambda p: lookup(linear_from_srgb(smooth_image()), p), kinds={"diffuse_albedo": "image"})
def srgb_image(s: Stage) -> None:
    s.link(s.texture(s.image(smooth_image())).outputs[0], s.shader.inputs["Base Color"])


@case(
    roughness=lambda p: lookup(smooth_image(), p)[:, 1],
    diffuse_albedo=lambda p: grey(0.8 * (1 - lookup(smooth_image(), p)[:, 2])),
    specular_albedo=lambda p: grey(
        F0 * (1 - lookup(smooth_image(), p)[:, 2]) + 0.8 * lookup(smooth_image(), p)[:, 2]
    ),
    kinds={"roughness": "image"},
)
def arm_image(s: Stage) -> None:
    separate = s.node("SeparateColor")
    image = s.texture(s.image(smooth_image(), "Non-Color", packed=False))
    s.link(image.outputs[0], separate.inputs[0])
    s.link(separate.outputs[1], s.shader.inputs["Roughness"])
    s.link(separate.outputs[2], s.shader.inputs["Metallic"])


def _turned(p: np.ndarray) -> np.ndarray:
    c, n = np.cos(0.5), np.sin(0.5)
    return np.stack(
        [2 * c * p[:, 0] - 3 * n * p[:, 1] + 0.1, 2 * n * p[:, 0] + 3 * c * p[:, 1] + 0.2], axis=1
    )


@case(
    diffuse_albedo=lambda p: lookup(linear_from_srgb(smooth_image()), _turned(p)),
    kinds={"diffuse_albedo": "image"},
)
def mapped_image_passes_through(s: Stage) -> None:
    mapping = s.node("Mapping")
    mapping.inputs["Location"].default_value = (0.1, 0.2, 0)
    mapping.inputs["Rotation"].default_value = (0, 0, 0.5)
    mapping.inputs["Scale"].default_value = (2, 3, 1)
    s.link(s.uv(), mapping.inputs[0])
    s.link(s.texture(s.image(smooth_image()), mapping.outputs[0]).outputs[0], s.shader.inputs["Base Color"])


@case(
    diffuse_albedo=lambda p: lookup(linear_from_srgb(smooth_image()), p[:, :2] * 2),
    roughness=lambda p: lookup(smooth_image(), p)[:, 0],
)
def images_with_different_mappings(s: Stage) -> None:
    mapping = s.node("Mapping")
    mapping.inputs["Scale"].default_value = (2, 2, 1)
    s.link(s.uv(), mapping.inputs[0])
    s.link(s.texture(s.image(smooth_image()), mapping.outputs[0]).outputs[0], s.shader.inputs["Base Color"])
    separate = s.node("SeparateColor")
    s.link(s.texture(s.image(smooth_image(), "Non-Color", "other")).outputs[0], separate.inputs[0])
    s.link(separate.outputs[0], s.shader.inputs["Roughness"])


@case(diffuse_albedo=lambda p: 1 - lookup(linear_from_srgb(smooth_image()), p))
def inverted_image(s: Stage) -> None:
    invert = s.node("Invert")
    s.link(s.texture(s.image(smooth_image())).outputs[0], invert.inputs["Color"])
    s.link(invert.outputs[0], s.shader.inputs["Base Color"])


@case(
    diffuse_albedo=lambda p: lookup(linear_from_srgb(smooth_image()), p),
    specular_albedo=F0,
    kinds={"diffuse_albedo": "image", "specular_albedo": "constant"},
)
def metalness_switched_off(s: Stage) -> None:
    """A texture times a metallic factor of 0, as glTF importers write it."""
    image = s.texture(s.image(smooth_image()))
    s.link(image.outputs["Color"], s.shader.inputs["Base Color"])
    separate = s.node("SeparateColor")
    s.link(image.outputs["Color"], separate.inputs[0])
    s.link(s.math("MULTIPLY", separate.outputs[2], 0.0), s.shader.inputs["Metallic"])


@case(diffuse_albedo=lambda p: lookup(linear_from_srgb(smooth_image()), p), opacity=1.0)
def alpha_of_an_image_without(s: Stage) -> None:
    image = s.texture(s.image(smooth_image()))
    s.link(image.outputs["Color"], s.shader.inputs["Base Color"])
    s.link(image.outputs["Alpha"], s.shader.inputs["Alpha"])


@case(
    diffuse_albedo=lambda p: 1 - lookup(linear_from_srgb(smooth_image()), p),
    roughness=lambda p: 0.5 * lookup(smooth_image(), p)[:, 0],
)
def one_map_by_name_and_without(s: Stage) -> None:
    """Two textures on two meshes; one names the UV map that is active for rendering, the other no map."""
    s.add(s.square(), (2, 0, 0))
    invert = s.node("Invert")
    named = s.node("UVMap", uv_map="UVMap").outputs[0]
    s.link(s.texture(s.image(smooth_image()), named).outputs[0], invert.inputs["Color"])
    s.link(invert.outputs[0], s.shader.inputs["Base Color"])
    separate = s.node("SeparateColor")
    s.link(s.texture(s.image(smooth_image(), "Non-Color", "other")).outputs[0], separate.inputs[0])
    s.link(s.math("MULTIPLY", separate.outputs[0], 0.5), s.shader.inputs["Roughness"])


_REC709_FROM_REC2020 = np.array(
    [
        [1.660491, -0.587641, -0.072850],
        [-0.124551, 1.132900, -0.008349],
        [-0.018151, -0.100579, 1.118730],
    ]
)


@case(diffuse_albedo=lambda p: np.clip(lookup(smooth_image(), p) @ _REC709_FROM_REC2020.T, 0, 1))
def image_in_another_colour_space(s: Stage) -> None:
    image = s.image(smooth_image(), "Linear Rec.2020")
    s.link(s.texture(image).outputs[0], s.shader.inputs["Base Color"])


@case(roughness=lambda p: lookup(smooth_image(64, 1), p)[:, 0], kinds={"roughness": "image"})
def grey_image_as_value(s: Stage) -> None:
    image = s.image(np.repeat(smooth_image(64, 1), 3, axis=2), "Non-Color")
    s.link(s.texture(image).outputs[0], s.shader.inputs["Roughness"])


@case(roughness=lambda p: lookup(smooth_image(), p) @ np.array([0.2126729, 0.7151522, 0.072175]))
def coloured_image_as_value(s: Stage) -> None:
    s.link(s.texture(s.image(smooth_image(), "Non-Color")).outputs[0], s.shader.inputs["Roughness"])


@case(
    opacity=lambda p: lookup(smooth_image(64, 4), p)[:, 3],
    diffuse_albedo=0.8,
    kinds={"opacity": "image", "diffuse_albedo": "constant"},
)
def alpha_of_an_image(s: Stage) -> None:
    image = s.image(smooth_image(64, 4), "sRGB")
    s.link(s.texture(image).outputs["Alpha"], s.shader.inputs["Alpha"])


@case(
    opacity=lambda p: np.where(p[:, 0] < 0.5, 1.0, 0.0),
    diffuse_albedo=lambda p: np.where(p[:, :1] < 0.5, 0.3, np.nan) * np.ones(3),
    specular_albedo=0.0,
)
def mix_with_transparent_by_mask(s: Stage) -> None:
    mask = s.math("GREATER_THAN", s.split(s.uv())[0], 0.5)
    s.surface(_mix(s, _diffuse(s, (0.3,) * 3), s.node("BsdfTransparent"), mask))


def _clipped(p: np.ndarray) -> np.ndarray:
    uv = p[:, :2] * 2 - 0.5
    inside = ((uv > 0) & (uv < 1)).all(axis=1)[:, None]
    border = (np.minimum(np.abs(uv), np.abs(uv - 1)).min(axis=1) < 1 / 64)[:, None]
    value = np.where(inside, lookup(linear_from_srgb(smooth_image()), uv), 0)
    return np.where(border, np.nan, value)


@case(diffuse_albedo=_clipped)
def clipped_image_beyond_its_border(s: Stage) -> None:
    s.thing.data = s.square(lambda xy: xy * 2 - 0.5)
    node = s.texture(s.image(smooth_image()), extension="CLIP")
    s.link(node.outputs[0], s.shader.inputs["Base Color"])


# ---- the mesh, the object, the instance


@case(diffuse_albedo=lambda p: np.clip(np.abs(p), 0, 1))
def object_coordinates(s: Stage) -> None:
    absolute = s.node("VectorMath", operation="ABSOLUTE")
    s.link(s.node("TexCoord").outputs["Object"], absolute.inputs[0])
    s.link(absolute.outputs[0], s.shader.inputs["Base Color"])


@case(diffuse_albedo=lambda p: p)
def generated_coordinates_of_a_box(s: Stage) -> None:
    bpy = s.bpy
    mesh = bpy.data.meshes.new(s.name)
    c = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    mesh.from_pydata(c, [], faces)
    mesh.materials.append(s.material)
    s.thing.data = mesh
    s.link(s.node("TexCoord").outputs["Generated"], s.shader.inputs["Base Color"])


@case(diffuse_albedo=lambda p: np.stack([p[:, 0], 1 - p[:, 0], 0.5 + 0 * p[:, 0]], axis=1))
def vertex_colours(s: Stage) -> None:
    layer = s.mesh.color_attributes.new("Paint", "FLOAT_COLOR", "POINT")
    x = np.array([v.co.x for v in s.mesh.vertices])
    values = np.stack([x, 1 - x, 0.5 + 0 * x, 1 + 0 * x], axis=1).astype(np.float32)
    layer.data.foreach_set("color", values.ravel())
    s.link(s.node("VertexColor", layer_name="Paint").outputs[0], s.shader.inputs["Base Color"])


@case(roughness=lambda p: p[:, 1])
def named_attribute(s: Stage) -> None:
    layer = s.mesh.attributes.new("wear", "FLOAT", "POINT")
    layer.data.foreach_set("value", np.array([v.co.y for v in s.mesh.vertices], np.float32))
    s.link(s.node("Attribute", attribute_name="wear").outputs["Fac"], s.shader.inputs["Roughness"])


@case(roughness=lambda p: np.where(p[:, 0] < 1.5, p[:, 0] * 0.2, p[:, 0] * 0.2))
def world_position_of_two_instances(s: Stage) -> None:
    s.add(s.mesh, (2, 0, 0))
    x = s.split(s.node("NewGeometry").outputs["Position"])[0]
    s.link(s.math("MULTIPLY", x, 0.2), s.shader.inputs["Roughness"])


@case(diffuse_albedo=lambda p: np.where(p[:, :1] < 1.5, [[0.8, 0.1, 0.1]], [[0.1, 0.1, 0.8]]))
def object_colour_of_two_instances(s: Stage) -> None:
    s.thing.color = (0.8, 0.1, 0.1, 1)
    s.add(s.mesh, (2, 0, 0)).color = (0.1, 0.1, 0.8, 1)
    s.link(s.node("ObjectInfo").outputs["Color"], s.shader.inputs["Base Color"])


@case(diffuse_albedo=lambda p: np.clip(np.abs(p), 0, 1) * 0.9)
def two_slots_of_one_mesh(s: Stage) -> None:
    other = s.material.copy()
    s.mesh.materials.append(other)
    s.mesh.polygons.foreach_set("material_index", [i % 2 for i in range(len(s.mesh.polygons))])
    for tree in (s.tree, other.node_tree):
        absolute, scale = s.node("VectorMath", tree), s.node("VectorMath", tree)
        absolute.operation, scale.operation = "ABSOLUTE", "SCALE"
        scale.inputs["Scale"].default_value = 0.9
        s.link(s.node("TexCoord", tree).outputs["Object"], absolute.inputs[0], tree)
        s.link(absolute.outputs[0], scale.inputs[0], tree)
        s.link(scale.outputs[0], tree.nodes["Principled BSDF"].inputs["Base Color"], tree)


@case(diffuse_albedo=lambda p: np.clip(np.stack([p[:, 0], p[:, 1], np.abs(p[:, 2])], axis=1), 0, 1))
def object_coordinates_under_modifiers(s: Stage) -> None:
    modifier = s.thing.modifiers.new("Thick", "SOLIDIFY")
    modifier.thickness, modifier.offset = 0.5, 1
    absolute = s.node("VectorMath", operation="ABSOLUTE")
    s.link(s.node("TexCoord").outputs["Object"], absolute.inputs[0])
    s.link(absolute.outputs[0], s.shader.inputs["Base Color"])


@case(roughness=lambda p: np.where((np.floor(p[:, 0] * 8) + np.floor(p[:, 1] * 8)) % 2 == 1, 0.9, 0.2))
def checker(s: Stage) -> None:
    node = s.node("TexChecker")
    node.inputs["Scale"].default_value = 8
    node.inputs["Color1"].default_value = (0.9, 0.9, 0.9, 1)
    node.inputs["Color2"].default_value = (0.2, 0.2, 0.2, 1)
    offset = s.node("VectorMath", operation="ADD")  # moves z away from the boundary between checker cells
    offset.inputs[1].default_value = (0, 0, 0.03)
    s.link(s.uv(), offset.inputs[0])
    s.link(offset.outputs[0], node.inputs["Vector"])
    s.link(node.outputs["Color"], s.shader.inputs["Roughness"])


def main(out: Path) -> None:
    """Build, save and export everything into ``out``."""
    global FOLDER
    import bpy

    from blender_addon.export import export
    from blender_addon.settings import ExportSettings

    FOLDER = out / "images"
    FOLDER.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    for entry in CASES:
        entry.build(Stage(bpy, entry.name))
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "graphs.blend"))
    settings = ExportSettings(kind="object", license="CC0-1.0", max_texture_px=1024, tolerance=0.5 / 255)
    result = export(out / "packages", settings)
    (out / "problems.txt").write_text("\n".join(str(problem) for problem in result.problems))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
