# SPDX-License-Identifier: MIT
"""Parser of Mitsuba XML scenes (versions 0.5 to 3.x) into plain nodes: variables, includes, aliases and
references are resolved, camelCase names of old files become snake_case, and transforms become matrices.

The modules that use the nodes interpret the plugins. DOCTYPE, entities, circular includes and includes
outside the scene's folder are refused. Since references turn the tree into a graph, the size of its
expansion is checked in advance.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.foundation.axes import affine, unit_vector
from datagen.foundation.budget import Budget
from datagen.foundation.documents import parse_xml
from datagen.foundation.errors import Problem, input_error, raise_problems
from datagen.foundation.paths import fault_of

PLUGIN_TAGS = (
    "bsdf", "emitter", "shape", "texture", "sensor", "film", "sampler", "rfilter", "integrator", "medium",
    "phase", "volume", "spectrum_plugin",
)  # fmt: skip
_DEFINITIONS = ("bsdf", "texture", "medium", "ref")
MAX_XML_BYTES = 256 << 20


@dataclass
class SceneNode:
    """A plugin instance. ``values``: plain properties by name; ``children``: (name, nested plugin).

    Colours are float triples, transforms (4, 4) float64 arrays, points and vectors float triples. ``where``
    names the node in messages (``bsdf "Glass"``).
    """

    tag: str
    type: str
    id: str = ""
    values: dict[str, Any] = field(default_factory=dict)
    children: list[tuple[str, SceneNode]] = field(default_factory=list)
    where: str = ""

    def child(self, *names: str) -> SceneNode | None:
        """Return the first nested plugin with one of ``names``, or None."""
        return next((node for name, node in self.children if name in names), None)

    def children_of(self, tag: str) -> list[SceneNode]:
        """Return the nested plugins with the XML tag ``tag``, in the order of the file."""
        return [node for _, node in self.children if node.tag == tag]

    def get(self, name: str, default: Any = None) -> Any:
        return self.values.get(name, default)

    def to_world(self) -> NDArray[np.float64]:
        """Return the node's transform ``to_world``, (4, 4); the identity if absent."""
        return np.asarray(self.get("to_world", np.eye(4)), dtype=np.float64)


@dataclass(frozen=True)
class MitsubaScene:
    """A parsed scene: its file, version, top-level nodes in order, and every node with an id."""

    path: Path
    version: tuple[int, ...]
    nodes: list[SceneNode]
    by_id: dict[str, SceneNode]

    def all_of(self, tag: str) -> list[SceneNode]:
        return [node for node in self.nodes if node.tag == tag]


def parse_scene(
    path: Path,
    defines: dict[str, str] | None = None,
    budget: Budget | None = None,
    allowed: Sequence[Path] = (),
) -> MitsubaScene:
    """Parse a scene file; includes may come from its folder and from the ``allowed`` folders.

    ``defines``: values of variables (``$name``), which override the file's defaults. Raises
    :class:`InputError` with every problem.
    """
    return _Parser(path, dict(defines or {}), budget or Budget(path), allowed).parse()


def snake_case(name: str) -> str:
    """Convert ``intIOR`` to ``int_ior``, ``toWorld`` to ``to_world``; current names stay unchanged."""
    return re.sub(r"(?<=[a-z0-9])([A-Z]+)", lambda m: "_" + m.group(1), name).lower()


class _Parser:
    def __init__(self, path: Path, defines: dict[str, str], budget: Budget, allowed: Sequence[Path]):
        self.path = path
        self.budget, self.allowed = budget, allowed
        self.loaded: dict[Path, ElementTree.Element] = {}
        self.depth = 0
        self.variables = defines
        self.given = frozenset(defines)
        self.problems: list[Problem] = []
        self.by_id: dict[str, SceneNode] = {}
        self.references: list[tuple[SceneNode, int, str]] = []
        self.counts: dict[str, int] = {}
        self.version: tuple[int, ...] = (3, 0, 0)

    def parse(self) -> MitsubaScene:
        root = self.load(self.path)
        text = root.get("version", "")
        try:
            self.version = tuple(int(part) for part in text.split("."))
        except ValueError:
            raise input_error(self.path, "scene version", repr(text), "numbers such as 3.0.0") from None
        holder = SceneNode("scene", "scene", where="scene")
        self.fill(holder, root, (self.path.resolve(),))
        for node, index, identity in self.references:
            target = self.by_id.get(identity)
            if target is None:
                self.problem(f"{node.where}: ref", repr(identity), "the id of a node in the scene")
            else:
                node.children[index] = (node.children[index][0], target)
        self.check_graph(holder)
        raise_problems(self.problems)
        return MitsubaScene(self.path, self.version, [node for _, node in holder.children], self.by_id)

    def problem(self, field_: str, got: str, expected: str, remedy: str = "correct the scene file") -> None:
        self.problems.append(Problem(self.path, field_, got, expected, remedy))

    def load(self, path: Path) -> ElementTree.Element:
        if path in self.loaded:
            return self.loaded[path]
        if not path.is_file():  # a pipe would block for ever
            raise input_error(path, got="no such file", expected="a Mitsuba scene (XML)")
        if path.stat().st_size > MAX_XML_BYTES:
            raise input_error(path, got="over 256 MB", expected="a scene description")
        try:
            text = self.budget.read_file(path, "a Mitsuba scene (XML)").decode("utf-8")
        except UnicodeDecodeError:
            raise input_error(path, got="not UTF-8", expected="a Mitsuba scene (XML in UTF-8)") from None
        root = parse_xml(text, path, self.budget, "correct the file")
        if root.tag != "scene":
            raise input_error(path, "root element", f"<{root.tag}>", "<scene>", "check the path")
        self.loaded[path] = root
        return root

    # structure

    def fill(self, node: SceneNode, element: ElementTree.Element, stack: tuple[Path, ...]) -> None:
        """Read an element's content into ``node``; ``stack``: chain of including files, outermost first."""
        self.depth += 1
        self.budget.check_depth(self.depth, node.where)
        for child in element:
            tag, attributes = child.tag, {k: self.substitute(v, node) for k, v in child.attrib.items()}
            name = snake_case(attributes.get("name", ""))
            if tag == "default":
                if attributes.get("name", "") not in self.given:
                    self.variables.setdefault(attributes.get("name", ""), attributes.get("value", ""))
            elif tag == "include":
                self.include(node, attributes.get("filename", ""), stack)
            elif tag == "alias":
                self.alias(attributes)
            elif tag == "ref":
                node.children.append((name, SceneNode("ref", "ref")))
                self.references.append((node, len(node.children) - 1, attributes.get("id", "")))
            elif tag in PLUGIN_TAGS:
                node.children.append((name, self.plugin(child, tag, attributes, stack)))
            elif tag == "transform":
                node.values[name] = self.transform(child, node)
            elif tag == "path":
                self.problem(f"{node.where}: <path>", "a search path", "file names relative to the scene")
            else:
                self.value(node, tag, name, attributes)
        self.depth -= 1

    def plugin(
        self,
        element: ElementTree.Element,
        tag: str,
        attributes: dict[str, str],
        stack: tuple[Path, ...],
    ) -> SceneNode:
        number = self.counts.get(tag, 0)
        self.counts[tag] = number + 1
        identity = attributes.get("id", "")
        label = f'"{identity}"' if identity else f"number {number}"
        node = SceneNode(
            tag, attributes.get("type", ""), identity, where=f"{tag} {label} ({attributes.get('type')})"
        )
        self.fill(node, element, stack)
        if identity:
            if identity in self.by_id:
                self.problem(node.where, "a duplicate id", "unique ids")
            self.by_id[identity] = node
        return node

    def include(self, node: SceneNode, name: str, stack: tuple[Path, ...]) -> None:
        target, fault = fault_of(self.path.parent, name, self.allowed)
        if target is None:
            expected = "a file inside the scene's folder"
            self.problem("include", f"{name!r} ({fault})", expected, "copy the file there")
        elif target in stack:
            self.problem("include", repr(name), "includes without cycles")
        else:
            self.budget.spend("references", 1, f"include {name!r}")
            if target in self.loaded:
                self.budget.spend("nodes", sum(1 for _ in self.loaded[target].iter()), f"include {name!r}")
            self.fill(node, self.load(target), (*stack, target))

    def alias(self, attributes: dict[str, str]) -> None:
        source = self.by_id.get(attributes.get("id", ""))
        if source is None:
            self.problem("alias", repr(attributes.get("id", "")), "the id of an earlier node")
        else:
            self.by_id[attributes.get("as", "")] = source

    def check_graph(self, scene: SceneNode) -> None:
        """Refuse circular references and graphs whose expanded size is too large; visit each node once."""
        sizes: dict[int, int] = {}
        depths: dict[int, int] = {}
        for start in (scene, *self.by_id.values()):
            if id(start) in sizes:
                continue
            path, above = [start], {id(start)}  # path from the start to the current node
            rest = [iter(start.children)]
            while path:
                node = path[-1]
                child = next((c for _, c in rest[-1] if id(c) not in sizes), None)
                if child is None:
                    sizes[id(node)] = 1 + sum(sizes[id(c)] for _, c in node.children)
                    depths[id(node)] = 1 + max((depths[id(c)] for _, c in node.children), default=0)
                    above.remove(id(path.pop()))
                    rest.pop()
                elif id(child) in above:
                    raise input_error(
                        self.path, child.where, "a reference to itself", "references without cycles"
                    )
                else:
                    path.append(child)
                    above.add(id(child))
                    rest.append(iter(child.children))
        # nodes that are only targets of references are not expanded
        used = [
            (sizes[id(node)], node.where)
            for _, node in scene.children
            if node.tag not in _DEFINITIONS and node.type != "shapegroup"
        ]
        deepest = max(scene.children, key=lambda entry: depths[id(entry[1])], default=("", scene))[1]
        self.budget.check_depth(depths[id(scene)] - 1, deepest.where)
        self.budget.spend("nodes", sum(size for size, _ in used), max(used, default=(0, ""))[1])

    # values

    def substitute(self, text: str, node: SceneNode) -> str:
        def value(match: re.Match[str]) -> str:
            name = match.group(1)
            if name not in self.variables:
                self.problem(
                    f"{node.where}: ${name}", "undefined", "a <default> or a value given to the importer"
                )
                return ""
            self.budget.spend("bytes", len(self.variables[name]), f"{node.where}: ${name}")
            return self.variables[name]

        return re.sub(r"\$([A-Za-z_][A-Za-z0-9_]*)", value, text) if "$" in text else text

    def numbers(self, node: SceneNode, name: str, text: str, counts: tuple[int, ...]) -> list[float]:
        parts = re.split(r"[\s,]+", text.strip(), maxsplit=max(counts))  # bounded: texts may have any length
        try:
            numbers = [float(part) for part in parts if part]
        except ValueError:
            numbers = []
        if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
            wanted = " or ".join(map(str, counts))
            self.problem(f"{node.where}: {name}", repr(text[:60]), f"{wanted} finite numbers")
            return [0.0] * counts[-1]
        return numbers

    def value(self, node: SceneNode, tag: str, name: str, attributes: dict[str, str]) -> None:
        text = attributes.get("value", "")
        if tag == "float":
            node.values[name] = self.numbers(node, name, text, (1,))[0]
        elif tag == "integer":
            node.values[name] = int(self.numbers(node, name, text, (1,))[0])
        elif tag == "boolean":
            if text.lower() not in ("true", "false"):
                self.problem(f"{node.where}: {name}", repr(text), "true or false")
            node.values[name] = text.lower() == "true"
        elif tag == "string":
            node.values[name] = text
        elif tag == "rgb":
            node.values[name] = self.color(node, name, text)
        elif tag == "spectrum":
            if ":" in text or "filename" in attributes:
                expected = "RGB or one number"
                self.problem(f"{node.where}: {name}", "a spectrum", expected, "replace it by an <rgb>")
            else:
                node.values[name] = tuple(self.numbers(node, name, text, (1,)) * 3)
        elif tag in ("point", "vector"):
            node.values[name] = tuple(self.axes(node, name, attributes, 0.0))
        else:
            self.problem(f"{node.where}: <{tag}>", repr(name), "a tag of Mitsuba 3")

    def color(self, node: SceneNode, name: str, text: str) -> tuple[float, ...]:
        if text.startswith("#"):
            digits = text[1:]
            if re.fullmatch(r"[0-9a-fA-F]{6}", digits) is None:
                self.problem(f"{node.where}: {name}", repr(text), "a colour such as #ff8000")
                return (0.0, 0.0, 0.0)
            from datagen.foundation.color import linear_from_srgb

            encoded = np.array([int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)])
            return tuple(float(x) for x in linear_from_srgb(encoded))
        numbers = self.numbers(node, name, text, (1, 3))
        return tuple(numbers * 3 if len(numbers) == 1 else numbers)

    def axes(self, node: SceneNode, name: str, attributes: dict[str, str], default: float) -> list[float]:
        if "value" in attributes:
            numbers = self.numbers(node, name, attributes["value"], (1, 3))
            return numbers * 3 if len(numbers) == 1 else numbers
        return [self.numbers(node, name, attributes.get(a, str(default)), (1,))[0] for a in "xyz"]

    def transform(self, element: ElementTree.Element, node: SceneNode) -> NDArray[np.float64]:
        """Return the (4, 4) matrix of a ``<transform>``, whose operations apply in the order of the file."""
        matrix = np.eye(4)
        for child in element:
            attributes = {k: self.substitute(v, node) for k, v in child.attrib.items()}
            step = np.eye(4)
            if child.tag == "matrix":
                numbers = self.numbers(node, "matrix", attributes.get("value", ""), (9, 16))
                side = 3 if len(numbers) == 9 else 4
                step[:side, :side] = np.reshape(numbers, (side, side))
            elif child.tag == "translate":
                step[:3, 3] = self.axes(node, "translate", attributes, 0.0)
            elif child.tag == "scale":
                step[:3, :3] = np.diag(self.axes(node, "scale", attributes, 1.0))
            elif child.tag == "rotate":
                angle = self.numbers(node, "rotate angle", attributes.get("angle", "0"), (1,))[0]
                step[:3, :3] = _rotation(self.axes(node, "rotate", attributes, 0.0), math.radians(angle))
            elif child.tag in ("lookat", "lookAt"):
                vectors = [
                    self.numbers(node, k, attributes.get(k, d), (3,))
                    for k, d in (("origin", ""), ("target", ""), ("up", "0 0 1"))
                ]
                step = _look_at(*map(np.array, vectors))
            else:
                expected = "matrix, translate, scale, rotate, lookat"
                self.problem(f"{node.where}: <{child.tag}>", "in a transform", expected)
            matrix = step @ matrix
        return matrix


def _rotation(axis: list[float], angle_rad: float) -> NDArray[np.float64]:
    length = np.linalg.norm(axis)
    x, y, z = np.asarray(axis) / length if length > 0 else (0.0, 0.0, 1.0)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: NDArray[np.float64] = (
        np.eye(3) + math.sin(angle_rad) * cross + (1 - math.cos(angle_rad)) * cross @ cross
    )
    return rotation


def _look_at(origin: NDArray[Any], target: NDArray[Any], up: NDArray[Any]) -> NDArray[np.float64]:
    """Return the (4, 4) matrix of Mitsuba's ``lookat``: z towards the target, x = up x z (left), y up."""
    forward = unit_vector(target - origin)
    left = unit_vector(np.cross(up, forward))
    return affine(np.stack([left, np.cross(forward, left), forward], axis=1), origin)
