# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses for each channel of a material how it becomes a constant or a texture. Changes no data.

- constant: nothing upstream varies; the channel is evaluated once.
- image: the channel is an image file sampled through a UV map; the file is used unchanged.
- plane: the channel depends on UVs only; it is baked once per material on a plane.
- mesh: the channel depends on object coordinates, attributes or transform; it is baked per mesh or instance.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import bpy
import numpy as np

from ..cycles import pixels_of
from ..problems import APPROXIMATION, ERROR, NOTE, Problem, ProblemList
from .channels import Channels, channels_of
from .closures import TRANSMISSION_POLICIES, Closures, ClosureWalk
from .dependencies import Dependencies, DependencyWalk
from .expression import Constant, Expression, Operation, SocketValue, is_constant, sockets, unclamped
from .frames import IDENTITY, UvFrame, image_frame
from .graph import Stack, input_of, node_at, source_of

ENCODINGS = {"sRGB": "srgb", "Non-Color": "linear", "Raw": "linear", "Linear Rec.709": "linear"}
_SEPARATE = {"Red": "r", "Green": "g", "Blue": "b", "R": "r", "G": "g", "B": "b"}
SCALAR_CHANNELS = ("roughness", "opacity")
NORMAL = "normal"


@dataclass(frozen=True)
class PlainImage:
    """A material channel exported as an unchanged ``image``, sampled at the coordinates of ``frame``.

    ``channel``: rgb, r, g, b or a of the image; ``encoding``: srgb or linear; ``needs_unit_uv``: the image
    does not repeat, so it cannot be used beyond the unit square.
    """

    image: bpy.types.Image
    channel: str
    encoding: str
    frame: UvFrame
    needs_unit_uv: bool


@dataclass
class MaterialPlan:
    """Export plan of one material.

    Channels, by name: ``constants`` are evaluated once; ``images``, possibly including the normal map, are
    exported as unchanged files; ``varying`` are baked on a plane, or on the mesh if ``needs_mesh``. ``frame``
    maps the mesh's UVs to texture coordinates (None: a new layout, or no texture). ``normals``: linked Normal
    inputs, which are baked if ``bakes_normal``.
    """

    name: str
    channels: Channels
    constants: dict[str, Expression] = field(default_factory=dict)
    images: dict[str, PlainImage] = field(default_factory=dict)
    varying: dict[str, Expression] = field(default_factory=dict)
    dependencies: Dependencies = field(default_factory=Dependencies)
    frame: UvFrame | None = None
    normals: list[tuple[Stack, bpy.types.NodeSocket]] = field(default_factory=list)
    bakes_normal: bool = False
    problems: list[Problem] = field(default_factory=list)

    @property
    def needs_mesh(self) -> bool:
        """True if a channel must be baked on each mesh."""
        return (bool(self.varying) or self.bakes_normal) and self.dependencies.needs_mesh

    @property
    def is_per_instance(self) -> bool:
        return (bool(self.varying) or self.bakes_normal) and self.dependencies.is_per_instance


def plan_material(
    material: bpy.types.Material, bakes_normal: bool = False, rendering_layer: str = ""
) -> MaterialPlan:
    """Plan the export of one material; the plan lists the problems found.

    ``bakes_normal``: linked Normal inputs become a texture. ``rendering_layer``: name of the UV layer active
    in rendering if all meshes with the material share it, else "".
    """
    problems = ProblemList()
    policy = str(material.get("sm_transmission", "refuse"))
    if policy not in TRANSMISSION_POLICIES:
        remedy = f"use one of {', '.join(TRANSMISSION_POLICIES)}"
        problems.add(ERROR, f"sm_transmission = {policy!r}", remedy, material=material.name)
    if not material.use_nodes or material.node_tree is None:
        colour = Constant(tuple(material.diffuse_color[:3]))
        channels = Channels(colour, Constant((0.0,) * 3), Constant((1.0,)), None, None)
        return MaterialPlan(material.name, channels, channels.baked(), problems=list(problems))
    closures = ClosureWalk(material.name, problems, policy).walk(material.node_tree)
    _note_leftover_lobes(closures, material.name, problems)
    channels = channels_of(closures)
    plan = MaterialPlan(material.name, channels, normals=closures.normals)
    plan.bakes_normal = bakes_normal and bool(closures.normals)
    walk = DependencyWalk(material.node_tree, material.name, problems, rendering_layer)
    _classify(plan, walk, problems)
    plan.problems = list(problems)
    return plan


def _note_leftover_lobes(closures: Closures, name: str, problems: ProblemList) -> None:
    glossy = {
        lobe.roughness
        for lobe in closures.lobes
        if lobe.roughness is not None and not is_constant(lobe.specular, 0)
    }
    if len(glossy) > 1 and not any("coat" in p.message for p in problems):
        problems.add(
            NOTE,
            f"{len(glossy)} glossy lobes become one; exact where their mix is a mask of 0 and 1, else the "
            "slope width is their mean weighted by F0",
            material=name,
        )


def _classify(plan: MaterialPlan, walk: DependencyWalk, problems: ProblemList) -> None:
    tree = walk.tree
    varying: dict[str, Expression] = {}
    for name, expression in plan.channels.baked().items():
        if walk.of(expression).is_constant:
            plan.constants[name] = expression
        else:
            varying[name] = expression
    plain = {
        name: image
        for name, expression in varying.items()
        if (image := plain_image(tree, expression, name in SCALAR_CHANNELS)) is not None
    }
    for name, image in list(plain.items()):
        # for example a JPEG, which has no alpha
        if image.channel == "a" and _is_opaque(image.image):
            plan.constants[name] = Constant((1.0,))
            del plain[name], varying[name]
    normal = plain_normal(plan.normals, walk.rendering_layer) if plan.bakes_normal else None
    if normal is not None:
        plain[NORMAL] = normal
    for name, image in plain.items():
        if image.frame.layer == walk.rendering_layer:
            plain[name] = replace(image, frame=UvFrame("", image.frame.matrix))
    if not varying and not plan.bakes_normal:
        return
    plan.dependencies = walk.of(*varying.values())
    if plan.bakes_normal:
        plan.dependencies.merge(walk.of_inputs(plan.normals))
    frames = {image.frame for image in plain.values()}
    if plain and len(plain) == len(varying) + plan.bakes_normal and len(frames) == 1:
        plan.images, (plan.frame,), plan.bakes_normal = plain, frames, False
        for name in varying:
            _note_interpolation(tree, varying[name], plan.name, problems, plain[name])
        return
    read_frames = plan.dependencies.frames
    if plan.dependencies.needs_mesh or not plan.dependencies.uv_layers:
        plan.frame = None  # a new layout, or no textures
    elif len(read_frames) == 1 and None not in read_frames:
        (plan.frame,) = read_frames
    else:
        (layer,) = plan.dependencies.uv_layers
        plan.frame = UvFrame(layer, IDENTITY)
    dependencies = plan.dependencies
    if not dependencies.needs_mesh and not dependencies.is_per_instance and dependencies.is_periodic:
        plan.images = {name: image for name, image in plain.items() if image.frame == plan.frame}
        plan.bakes_normal &= NORMAL not in plan.images
    plan.varying = {name: value for name, value in varying.items() if name not in plan.images}


def _note_interpolation(
    tree: bpy.types.NodeTree, expression: Expression, name: str, problems: ProblemList, image: PlainImage
) -> None:
    for value in sockets(expression):
        node = node_at(tree, value.path, value.node)[1]
        if node.type == "TEX_IMAGE" and node.interpolation == "Closest":
            message = f"pixels of {image.image.name!r} are interpolated linearly instead of shown as squares"
            problems.add(APPROXIMATION, message, material=name, node=node.name)


def force_bake(plan: MaterialPlan) -> MaterialPlan:
    """A copy of ``plan`` that bakes its images instead of using their files, for UVs outside [0, 1]."""
    varying = {
        name: expression
        for name, expression in plan.channels.baked().items()
        if name in plan.images or name in plan.varying
    }
    dependencies = Dependencies()
    dependencies.merge(plan.dependencies)
    dependencies.repeats = False
    return MaterialPlan(
        plan.name, plan.channels, plan.constants, {}, varying, dependencies, plan.frame, plan.normals,
        plan.bakes_normal or NORMAL in plan.images, plan.problems,
    )  # fmt: skip


def plain_image(tree: bpy.types.NodeTree, expression: Expression, is_scalar: bool) -> PlainImage | None:
    """The image that equals ``expression`` (scalar or RGB) if sampled through an affine UV map, or None."""
    bare = unclamped(expression)
    is_luminance = isinstance(bare, Operation) and bare.name in ("luminance", "average")
    if is_luminance:
        bare = bare.arguments[0]  # type: ignore[union-attr]
    if not isinstance(bare, SocketValue):
        return None
    stack, node = node_at(tree, bare.path, bare.node)
    output = next(o for o in node.outputs if o.identifier == bare.socket)
    channel = "rgb"
    if node.type in ("SEPARATE_COLOR", "SEPRGB") and getattr(node, "mode", "RGB") == "RGB":
        channel = _SEPARATE.get(output.name, "")
        colour = input_of(node, "Color", "Image")
        source = source_of(stack, colour) if colour is not None else None
        if not channel or source is None or source.node is None or source.node.type != "TEX_IMAGE":
            return None
        stack, node, output = source.stack, source.node, source.socket
    if node.type != "TEX_IMAGE" or node.image is None or output is None:
        return None
    if output.name == "Alpha":
        if channel != "rgb":
            return None
        channel = "a"
    frame = image_frame(stack, node)
    image = node.image
    encoding = ENCODINGS.get(image.colorspace_settings.name)
    is_file = image.source == "FILE" and node.projection == "FLAT"
    if frame is None or encoding is None or not is_file or (encoding == "srgb" and image.is_float):
        return None
    if (channel == "rgb") == is_scalar:
        if not is_scalar or not _is_grey(image):
            return None  # one component used as a colour, or a coloured image as a value
        channel = "r"
    is_blended = channel != "a" and image.channels == 4 and image.alpha_mode in ("STRAIGHT", "PREMUL")
    if is_blended and not _is_opaque(image):
        return None
    if channel == "a":
        encoding = "linear"
    return PlainImage(image, channel, encoding, frame, node.extension != "REPEAT")


def plain_normal(
    normals: list[tuple[Stack, bpy.types.NodeSocket]], rendering_layer: str
) -> PlainImage | None:
    """The normal map that all Normal inputs sample, unrotated, through ``rendering_layer``; else None."""
    sources = [source_of(stack, socket) for stack, socket in normals]
    node = sources[0].node
    if node is None or node.type != "NORMAL_MAP" or any(source.node != node for source in sources):
        return None
    stack, strength, colour = sources[0].stack, node.inputs["Strength"], node.inputs["Color"]
    is_usual = node.space == "TANGENT" and getattr(node, "convention", "OPENGL") == "OPENGL"
    if not is_usual or source_of(stack, strength).is_linked or strength.default_value != 1:
        return None
    source = source_of(stack, colour)
    texture = source.node
    if texture is None or texture.type != "TEX_IMAGE" or source.socket is None or texture.image is None:
        return None
    image, frame = texture.image, image_frame(source.stack, texture)
    is_plain = (source.socket.name, image.source, texture.projection) == ("Color", "FILE", "FLAT")
    if frame is None or not is_plain:
        return None
    (a, b, _), (c, d, _) = frame.matrix
    is_rotated = b != 0 or c != 0 or a <= 0 or d <= 0
    reads_other = {node.uv_map, frame.layer} - {"", rendering_layer} or is_rotated
    if reads_other or ENCODINGS.get(image.colorspace_settings.name) != "linear" or not _is_opaque(image):
        return None
    return PlainImage(image, "rgb", "linear", frame, texture.extension != "REPEAT")


def _is_grey(image: bpy.types.Image) -> bool:
    if image.channels < 3:
        return True
    values = pixels_of(image)
    return bool(len(values) and np.abs(values[..., :3] - values[..., :1]).max() <= 0.5 / 255)


def _is_opaque(image: bpy.types.Image) -> bool:
    if image.channels < 4 or image.alpha_mode == "NONE":
        return True
    values = pixels_of(image)
    return bool(len(values) and values[..., 3].min() >= 1 - 0.5 / 255)
