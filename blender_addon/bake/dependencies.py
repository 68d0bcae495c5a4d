# SPDX-License-Identifier: GPL-3.0-or-later
"""Determines on which inputs the values of a shader graph depend: UV maps, mesh or instance's transform."""

from __future__ import annotations

from dataclasses import dataclass, field

import bpy

from ..problems import APPROXIMATION, ERROR, NOTE, ProblemList
from .expression import Expression, sockets
from .frames import UvFrame, image_frame
from .graph import Stack, input_of, node_at, path_of, source_of

_GENERATED_BY_DEFAULT = {
    "TEX_NOISE", "TEX_VORONOI", "TEX_WAVE", "TEX_MAGIC", "TEX_GRADIENT", "TEX_CHECKER", "TEX_BRICK",
    "TEX_WHITE_NOISE", "TEX_GABOR",
}  # fmt: skip
_REFUSED = {
    "SCRIPT": "Open Shading Language scripts are not evaluated",
    "SHADERTORGB": "Shader to RGB exists in Eevee only",
    "CAMERA": "the value changes with the camera",
    "PARTICLE_INFO": "particle values are not known outside a particle system",
    "HAIR_INFO": "hair values are not known on a mesh",
    "UVALONGSTROKE": "strokes are not exported",
    "TEX_POINTDENSITY": "point density textures are not evaluated",
    "TEX_IES": "IES textures belong to lights",
    "TEX_SKY": "a sky texture belongs to the world",
    "TEX_ENVIRONMENT": "an environment texture in a surface changes with the view",
}
_GEOMETRY_ON_INSTANCE = {"Position", "Normal", "True Normal", "Tangent"}
_ON_MESH = {"VERTEX_COLOR", "BEVEL", "AMBIENT_OCCLUSION", "WIREFRAME", "TANGENT", "NORMAL_MAP", "BUMP"}


@dataclass
class Dependencies:
    """Inputs on which the values of a shader graph depend.

    ``uv_layers``: names of the UV layers that are read, "" for the layer active in rendering, whose name is
    in ``named`` if nodes refer to it by name. ``frames``: UV mappings by which image textures are read, and
    None if UVs are used otherwise. ``repeats``: whether all images repeat. ``image_px``: largest width and
    height of the images. ``mesh``, ``world`` and ``object_info``: whether values depend on the mesh, on the
    instance's transform, and on Object Info nodes.
    """

    uv_layers: set[str] = field(default_factory=set)
    named: set[str] = field(default_factory=set)
    frames: set[UvFrame | None] = field(default_factory=set)
    repeats: bool = True
    image_px: tuple[int, int] = (0, 0)
    mesh: bool = False
    world: bool = False
    object_info: bool = False

    @property
    def is_constant(self) -> bool:
        return not (self.uv_layers or self.mesh or self.world or self.object_info)

    @property
    def is_periodic(self) -> bool:
        """True if all images repeat and UVs are used only to read images."""
        return self.repeats and None not in self.frames

    @property
    def layer_names(self) -> tuple[str, ...]:
        """Sorted names of all UV layers to which nodes refer."""
        return tuple(sorted(layer for layer in self.uv_layers | self.named if layer))

    @property
    def detail_px(self) -> tuple[int, int] | None:
        """Texels per unit of texture coordinates, along u and v, that preserve all detail of the images.

        None if values other than images vary, or if images are read by several mappings.
        """
        if self.needs_mesh or None in self.frames or len(self.frames) != 1:
            return None
        return self.image_px

    @property
    def needs_mesh(self) -> bool:
        """True if the values must be baked on the mesh rather than on a plane."""
        return self.mesh or self.world or len(self.uv_layers) > 1

    @property
    def is_per_instance(self) -> bool:
        return self.world or self.object_info

    def merge(self, other: Dependencies) -> None:
        """Add the dependencies of ``other`` to these."""
        self.uv_layers |= other.uv_layers
        self.named |= other.named
        self.frames |= other.frames
        self.repeats &= other.repeats
        self.see_image(*other.image_px)
        self.mesh |= other.mesh
        self.world |= other.world
        self.object_info |= other.object_info

    def see_image(self, width: int, height: int) -> None:
        """Enlarge ``image_px`` to at least the size of an image."""
        self.image_px = (max(self.image_px[0], width), max(self.image_px[1], height))


class DependencyWalk:
    """Collects the dependencies of expressions from the nodes upstream in a material's tree.

    ``rendering_layer``: name of the UV layer active in rendering if all meshes share it, else "". Nodes
    that name this layer and nodes that name none then read the same layer.
    """

    def __init__(
        self, tree: bpy.types.NodeTree, material: str, problems: ProblemList, rendering_layer: str = ""
    ):
        self.tree, self.material, self.problems = tree, material, problems
        self.rendering_layer = rendering_layer
        self._seen: set[tuple[tuple[str, ...], str, str]] = set()
        self._result = Dependencies()
        self._is_normal = False

    def of(self, *expressions: Expression) -> Dependencies:
        """Union of the dependencies of ``expressions``."""
        self._seen, self._result = set(), Dependencies()
        for expression in expressions:
            for value in sorted(sockets(expression), key=lambda s: (s.path, s.node, s.socket)):
                stack, node = node_at(self.tree, value.path, value.node)
                output = next(o for o in node.outputs if o.identifier == value.socket)
                self._visit(stack, node, output)
        return self._result

    def of_inputs(self, inputs: list[tuple[Stack, bpy.types.NodeSocket]]) -> Dependencies:
        """Dependencies of linked Normal inputs (stack, socket) that become a tangent-space texture."""
        self._seen, self._result, self._is_normal = set(), Dependencies(), True
        for stack, socket in inputs:
            source = source_of(stack, socket)
            if source.node is not None and source.socket is not None:
                self._visit(source.stack, source.node, source.socket)
        self._is_normal = False
        return self._result

    def _report(self, severity: str, node: bpy.types.Node, message: str, remedy: str = "") -> None:
        self.problems.add(severity, message, remedy, material=self.material, node=node.label or node.name)

    def _visit(self, stack: Stack, node: bpy.types.Node, output: bpy.types.NodeSocket) -> None:
        key = (path_of(stack), node.name, output.identifier)
        if key in self._seen:
            return
        self._seen.add(key)
        kind = node.type
        if kind in _REFUSED:
            remedy = "replace it by a node whose value depends on the surface only"
            self._report(ERROR, node, f"{node.bl_label}: {_REFUSED[kind]}", remedy)
            return
        if kind == "TEX_IMAGE":
            self._image(stack, node)
            return
        if kind == "TEX_COORD":
            self._coordinate(node, output.name)
        elif kind == "UVMAP":
            self._uv(node.uv_map)
            if node.from_instancer:
                self._report(ERROR, node, "UVs of the instancer are not exported", "turn From Instancer off")
        elif kind == "NEW_GEOMETRY":
            self._geometry(node, output.name)
        elif kind == "OBJECT_INFO":
            self._result.object_info = True
        elif kind == "ATTRIBUTE":
            if node.attribute_type == "GEOMETRY":
                self._result.mesh = True
            else:
                message = f"attributes of type {node.attribute_type} are not evaluated"
                self._report(ERROR, node, message, "store the value on the geometry")
        elif kind == "POINT_INFO":
            self._report(ERROR, node, "point clouds are not exported", "convert them to a mesh")
        elif self._is_normal and kind == "NORMAL_MAP" and node.space == "TANGENT":
            self._layer(node.uv_map)
        elif self._is_normal and kind == "BUMP":
            pass  # only the dependencies of its height matter
        elif kind in _ON_MESH:
            self._result.mesh = True
        elif kind in ("FRESNEL", "LAYER_WEIGHT"):
            self._report(
                NOTE,
                node,
                f"{node.bl_label} changes with the view: it is evaluated at normal incidence, which gives "
                "the F0 of a Fresnel mix",
            )
        elif kind == "VECT_TRANSFORM" and node.convert_from != node.convert_to:
            if "CAMERA" in (node.convert_from, node.convert_to):
                self._report(ERROR, node, "the value changes with the camera", "use World and Object only")
            self._result.world = True
        elif kind == "LIGHT_PATH":
            self._report(NOTE, node, "Light Path is evaluated as for a camera ray")
        self._upstream(stack, node)

    def _upstream(self, stack: Stack, node: bpy.types.Node) -> None:
        for socket in node.inputs:
            if socket.type == "SHADER":
                continue
            if node.type in ("FRESNEL", "LAYER_WEIGHT") and socket.name == "Normal":
                continue  # evaluated at normal incidence, so its normal has no effect
            source = source_of(stack, socket)
            if source.node is not None and source.socket is not None:
                self._visit(source.stack, source.node, source.socket)
            elif socket.name == "Vector" and node.type in _GENERATED_BY_DEFAULT:
                self._result.mesh = True

    def _layer(self, layer: str) -> str:
        """Record that a UV layer is read; returns its name in ``uv_layers``."""
        if layer and layer == self.rendering_layer:
            self._result.named.add(layer)
            layer = ""
        self._result.uv_layers.add(layer)
        return layer

    def _uv(self, layer: str) -> None:
        self._layer(layer)
        self._result.frames.add(None)  # the UVs are not (only) read by an image through an affine map

    def _image(self, stack: Stack, node: bpy.types.Node) -> None:
        if node.image is None:
            self._report(ERROR, node, "the Image Texture has no image", "choose an image or remove the node")
            return
        if node.image.source in ("FILE", "TILED") and not node.image.has_data and not node.image.packed_file:
            pixels_exist = node.image.size[0] > 0  # accessing the size loads the image
            if not pixels_exist:
                message = f"the image {node.image.name!r} cannot be read ({node.image.filepath})"
                self._report(ERROR, node, message, "find the missing file or pack it")
                return
        if node.image.source in ("SEQUENCE", "MOVIE"):
            self._report(NOTE, node, "only the current frame of the movie or image sequence is exported")
        if node.projection != "FLAT":
            self._result.mesh = True
        frame = image_frame(stack, node)
        if frame is None:
            vector = input_of(node, "Vector")
            assert vector is not None
            source = source_of(stack, vector)
            if source.node is not None and source.socket is not None:
                self._visit(source.stack, source.node, source.socket)
            else:
                self._uv("")
        else:
            self._result.frames.add(UvFrame(self._layer(frame.layer), frame.matrix))
            self._result.see_image(*node.image.size)
            if node.image.source == "TILED":
                self._result.frames.add(None)  # each tile has its own size
            if node.extension != "REPEAT" or node.image.source == "TILED":
                self._result.repeats = False

    def _coordinate(self, node: bpy.types.Node, name: str) -> None:
        if node.from_instancer:
            self._report(
                ERROR, node, "coordinates of the instancer are not exported", "turn From Instancer off"
            )
        if name == "UV":
            self._uv("")
        elif name == "Object" and node.object is not None:
            self._result.world = True
        elif name in ("Generated", "Normal", "Object"):
            self._result.mesh = True
        else:
            remedy = "use UV, Object or Generated coordinates"
            self._report(ERROR, node, f"{name} coordinates change with the view", remedy)

    def _geometry(self, node: bpy.types.Node, name: str) -> None:
        if name in _GEOMETRY_ON_INSTANCE:
            self._result.world = True
        elif name == "Incoming":
            self._report(
                ERROR, node, "Incoming changes with the view", "use a value that depends on the surface only"
            )
        elif name == "Backfacing":
            self._report(APPROXIMATION, node, "back faces get the front's material")
        else:
            self._result.mesh = True
