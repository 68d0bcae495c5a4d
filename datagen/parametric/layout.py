# SPDX-License-Identifier: MIT
"""Places furniture in a shell by rules: at walls, side by side, at tables, in the middle, on surfaces.

In a valid position, an item is inside the room and clear of other furniture, swinging doors, windows and the
floor in front of cupboards, and walking paths remain open. A required item without a valid position raises
:class:`Unfit`; the room is then generated again from another seed. A *host* is an item relative to which
another is placed.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from datagen.foundation.axes import rotation
from datagen.foundation.random import Draws
from datagen.parametric.checks import front_zone, meets, overlap, reaches, walkable
from datagen.parametric.items import Item, Placed, Style, hull_of
from datagen.parametric.shapes import Floats, Point
from datagen.parametric.shell import CASING_M, WALLS, Shell, Wall, Window, swing

OFF_WALL_M = 0.03  # gap behind furniture, which leaves space for the skirting
_MARGIN_M = 0.02
_TRIES = 14
Side = Literal["front", "back", "left", "right"]
LEFT_RIGHT: tuple[Literal["left", "right"], ...] = ("left", "right")
SIDES: tuple[Side, ...] = ("front", "back", "left", "right")
_TURN: dict[Side, float] = {"back": 0.0, "left": 0.5 * math.pi, "front": math.pi, "right": -0.5 * math.pi}


class Unfit(Exception):
    """Raised if a required item has no valid position in the room."""


@dataclass
class Furnisher:
    """A room being furnished; ``zones`` are the names and boxes (2, 3) of spaces that must remain free."""

    shell: Shell
    style: Style
    draws: Draws
    placed: list[Placed] = field(default_factory=list)
    zones: list[tuple[str, Floats]] = field(default_factory=list)
    _boxes: list[Floats] = field(default_factory=list)
    _names: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        for k, door in enumerate(self.shell.doors):
            sector = swing(self.shell, door)
            low, high = sector.min(axis=0), sector.max(axis=0)
            self.zones.append((f"door {k}", np.array([[*low, 0.0], [*high, door.height]])))
            half, levels = door.width / 2 + CASING_M, (0.0, door.height + CASING_M)
            self._keep_clear(f"door {k} frame", door.wall, door.s, half, 0.045, levels)
        for k, window in enumerate(self.shell.windows):
            low_m = (window.sill - 0.035, window.sill + 0.02)
            self._keep_clear(f"window {k} sill", window.wall, window.s, window.width / 2 + 0.07, 0.08, low_m)
            high_m = (window.sill + 0.05, window.sill + window.height)
            self._keep_clear(f"window {k}", window.wall, window.s, window.width / 2, 0.35, high_m)

    def _keep_clear(
        self, name: str, wall: Wall, s: float, half: float, depth: float, levels: tuple[float, float]
    ) -> None:
        a, b = self.shell.point(wall, s - half, 0.0), self.shell.point(wall, s + half, depth)
        low, high = np.minimum(a, b), np.maximum(a, b)
        self.zones.append((name, np.array([[*low, levels[0]], [*high, levels[1]]])))

    def blank_walls(self) -> list[Wall]:
        """Return the walls without windows, in random order."""
        return self.draws.shuffled([w for w in WALLS if not any(x.wall == w for x in self.shell.windows)])

    def new_name(self, name: str) -> str:
        """Return a new numbered name for an item, or for the slot of a lamp (``glow``) or print (``art``)."""
        self._names[name] += 1
        return f"{name}_{self._names[name] - 1}"

    def take(self, item: Item, at: Point, yaw: float, stands_on: str = "") -> Placed:
        """Place an item without checking its position, unlike :meth:`offer`."""
        rounded = (round(at[0], 6), round(at[1], 6), round(at[2], 6))
        placed = Placed(item, self.new_name(item.name), rounded, round(yaw, 6), stands_on)
        self.placed.append(placed)
        self._boxes.append(placed.boxes())
        if item.front_m > 0 and item.hold == "floor":
            zone = front_zone(placed, item.front_m)
            self.zones.append((placed.name, np.array([[*zone[0], 0.05], [*zone[1], 1.8]])))
        return placed

    def offer(
        self,
        item: Item,
        at: Point,
        yaw: float,
        *,
        near: Sequence[Placed] = (),
        ignores: Sequence[str] = (),
        stands_on: str = "",
    ) -> Placed | None:
        """Place an item if its position is valid; otherwise, return None.

        The item may be inside the bounds of the items ``near`` without touching their shapes (a chair under a
        table), and inside the zones named in ``ignores``. Zones do not apply on another item (``stands_on``).
        """
        trial = Placed(item, "trial", at, yaw, stands_on)
        boxes = trial.boxes()
        bounds = hull_of(boxes)
        margin = 0.004 if item.hold == "floor" else -1e-4
        limit = np.array([self.shell.width / 2 - margin, self.shell.depth / 2 - margin])
        if (bounds[0, :2] < -limit).any() or (bounds[1, :2] > limit).any():
            return None
        if bounds[1, 2] > self.shell.height + 1e-4:
            return None
        for other, of_other in zip(self.placed, self._boxes, strict=True):
            b = hull_of(of_other)
            if other.name == stands_on:
                if other.item.name == "rug" and not _lies_in(bounds, b):
                    return None
                continue
            is_near = any(other is n for n in near)
            is_beside = is_near or (other.item.name == "curtains" and item.hold == "floor")
            if not meets(bounds, b, 0.0 if is_beside else _MARGIN_M):
                continue
            if not is_beside or overlap(boxes, of_other) > -0.004:
                return None
        for name, zone in self.zones:
            if name not in ignores and not stands_on and item.name != "rug" and meets(bounds, zone):
                return None
        if item.name == "rug" and any(n.startswith("door") and meets(bounds, z) for n, z in self.zones):
            return None
        if item.front_m > 0 and not self._front_is_free(trial):
            return None
        if item.hold == "floor" and not stands_on and item.name != "rug":
            reached, why = walkable(self.shell, np.concatenate([*self._boxes, boxes]))
            fronts = [p for p in (*self.placed, trial) if p.item.front_m > 0 and p.item.hold == "floor"]
            if why or not all(reaches(self.shell, reached, p) for p in fronts):
                return None
        return self.take(item, at, yaw, stands_on)

    def _front_is_free(self, trial: Placed) -> bool:
        zone = front_zone(trial, trial.item.front_m)
        half = np.array([self.shell.width / 2, self.shell.depth / 2])
        if (zone[0] < -half - 1e-6).any() or (zone[1] > half + 1e-6).any():
            return False
        box = np.array([[*zone[0], 0.06], [*zone[1], 1.8]])
        return not any(
            ((b[:, 0] < box[1]) & (b[:, 1] > box[0])).all(axis=1).any()
            for b, p in zip(self._boxes, self.placed, strict=True)
            if p.item.hold in ("floor", "wall") and p.item.name != "rug"
        )

    def at_wall(
        self,
        item: Item,
        walls: Sequence[Wall] | None = None,
        where: Literal["any", "corner", "middle"] = "any",
        needed: bool = False,
        gap: float = OFF_WALL_M,
    ) -> Placed | None:
        """Place an item with its back ``gap`` metres from one of ``walls`` (or any), preferably at ``where``.

        Without space, returns None or, if ``needed``, raises :class:`Unfit`.
        """
        b = item.bounds
        order = list(walls) if walls is not None else self.draws.shuffled(WALLS)
        for wall in order:
            length = self.shell.length(wall)
            low, high = -length / 2 - b[0, 0] + OFF_WALL_M, length / 2 - b[1, 0] - OFF_WALL_M
            if low > high:
                continue
            middle = min(max(0.0, low), high)
            random = [low + u * (high - low) for u in self.draws.units(_TRIES).tolist()]
            corners = self.draws.shuffled([low, high])
            tries = {"any": random, "corner": [*corners, *random[:6]], "middle": [middle, *random]}[where]
            for place in tries:
                found = self.offer(item, (*self.shell.point(wall, place, gap), 0.0), self.shell.yaw(wall))
                if found is not None:
                    return found
        if needed:
            raise Unfit(f"no wall has space for {item.name}")
        return None

    def in_middle(self, item: Item, needed: bool = False, spread: float = 1.0) -> Placed | None:
        """Place an item in the middle of the room or, if it does not fit there, at a random position.

        Random positions are in the central share ``spread`` of it. Without space, returns None or, if
        ``needed``, raises :class:`Unfit`.
        """
        b = item.bounds
        size = b[1] - b[0]
        for k in range(_TRIES):
            quarter = 0 if (self.shell.width >= self.shell.depth) == (size[0] >= size[1]) else 1
            if k % 3 == 2:
                quarter += 1
            if self.draws.chance(0.5):
                quarter += 2
            yaw = 0.5 * math.pi * (quarter % 4)
            u = (self.draws.units(2) - 0.5) * (0.0 if k == 0 else spread)
            reach = size[[1, 0]] if quarter % 2 else size[:2]
            x, y = u * np.maximum(np.array([self.shell.width, self.shell.depth]) - reach - 0.2, 0.0)
            middle = rotation("z", yaw)[:2, :2] @ b.mean(axis=0)[:2]
            found = self.offer(item, (float(x - middle[0]), float(y - middle[1]), 0.0), yaw)
            if found is not None:
                return found
        if needed:
            raise Unfit(f"the middle has no space for {item.name}")
        return None

    def beside(
        self, item: Item, host: Placed, side: Literal["left", "right"], gap: float = 0.04
    ) -> Placed | None:
        """Place an item ``gap`` metres to a host's left or right, seen from the front, at the same wall."""
        h, b = host.item.bounds, item.bounds
        x = h[0, 0] - gap - b[1, 0] if side == "left" else h[1, 0] + gap - b[0, 0]
        return self.offer(item, host.point(x, 0.0), host.yaw_rad)

    def before(self, item: Item, host: Placed, gap: float, turned: bool = False) -> Placed | None:
        """Place an item ``gap`` metres in front of a host; if ``turned``, it faces the host."""
        h, b = host.item.bounds, item.bounds
        y = h[0, 1] - gap - (b[1, 1] if not turned else -b[0, 1])
        yaw = host.yaw_rad + (math.pi if turned else 0.0)
        return self.offer(item, host.point(0.5 * (h[0, 0] + h[1, 0]), y), yaw, ignores=(host.name,))

    def seat(self, chair: Item, table: Placed, side: Side, offset: float, tuck: float) -> Placed | None:
        """Place a chair at a table's side, about ``offset`` m off its middle, ``tuck`` m under the top."""
        b, depth = table.item.bounds, -float(chair.bounds[0, 1])
        middle = b.mean(axis=0)[:2]
        half = 0.5 * (b[1] - b[0])[:2]
        angle = _TURN[side]
        outward = rotation("z", angle)[:2, :2] @ np.array([0.0, 1.0])
        along = rotation("z", angle)[:2, :2] @ np.array([1.0, 0.0])
        edge = half[0] if side in ("left", "right") else half[1]
        shift = offset + self.draws.uniform(-0.02, 0.02)
        tuck = tuck + self.draws.uniform(-0.06, 0.03)
        place = middle + outward * (edge + depth - tuck) + along * shift
        x, y, _ = table.point(*place)
        turn = math.radians(self.draws.uniform(-7, 7))
        return self.offer(
            chair, (x, y, table.at[2]), table.yaw_rad + angle + turn,
            near=(table,), ignores=(table.name,), stands_on=table.stands_on,
        )  # fmt: skip

    def on(self, item: Item, host: Placed, x: float, y: float) -> Placed | None:
        """Place an item on a host's first support, ``x`` m right of its middle, ``y`` m off the rear edge."""
        support = host.item.supports[0]
        back = support.middle[1] + support.size[1] / 2 - y
        at = host.point(support.middle[0] + x, back, support.z)
        return self.offer(item, at, host.yaw_rad, near=(host,), stands_on=host.name)

    def hang(
        self,
        item: Item,
        z: float,
        walls: Sequence[Wall] | None = None,
        s: float | None = None,
        free: float = 0.12,
        is_slim: bool = False,
    ) -> Placed | None:
        """Place an item on a wall with its z = 0 at height ``z``, ``free`` metres clear of doors and windows.

        ``s`` is the position along the wall, random by default. If ``is_slim``, the item may be behind
        furniture and in the space kept free in front of furniture.
        """
        b = item.bounds
        near = tuple(self.placed) if is_slim else ()
        for wall in list(walls) if walls is not None else self.draws.shuffled(WALLS):
            length = self.shell.length(wall)
            low, high = -length / 2 - b[0, 0] + 0.05, length / 2 - b[1, 0] - 0.05
            if low > high:
                continue
            tries = [s] if s is not None else [low + u * (high - low) for u in self.draws.units(8).tolist()]
            for place in tries:
                spans = self.shell.spans(wall)
                if any(
                    a - free < place + b[1, 0]
                    and place + b[0, 0] < e + free
                    and c - free < z + b[1, 2]
                    and z + b[0, 2] < f + free
                    for a, e, c, f in spans
                ):
                    continue
                at = (*self.shell.point(wall, place), z)
                passed = [
                    n for n, _ in self.zones if n.startswith("window") or (is_slim and n[:5] != "door ")
                ]
                found = self.offer(item, at, self.shell.yaw(wall), near=near, ignores=passed)
                if found is not None:
                    return found
        return None

    def before_window(
        self, item: Item, window: Window, z: float, near: Sequence[Placed] = ()
    ) -> Placed | None:
        """Place an item on the wall at a window, centred in width, with its z = 0 at height ``z``."""
        passed = [name for name, _ in self.zones if name.startswith("window")]
        at = (*self.shell.point(window.wall, window.s), z)
        return self.offer(item, at, self.shell.yaw(window.wall), near=near, ignores=passed)

    def over(self, item: Item, host: Placed, z: float) -> Placed | None:
        """Hang an item centred above a host that stands at a wall, with its z = 0 at height ``z``."""
        wall = self.wall_of(host)
        if wall is None:
            return None
        middle = host.point(float(host.item.bounds[:, 0].mean()), 0.0)
        along = rotation("z", self.shell.yaw(wall))[:, 0]
        return self.hang(item, z, [wall], float(np.array(middle) @ along), 0.02)

    def wall_of(self, host: Placed) -> Wall | None:
        """Return the wall at an item's back; None for a free-standing item."""
        for wall in WALLS:
            if abs(math.remainder(host.yaw_rad - self.shell.yaw(wall), 2 * math.pi)) < 1e-4:
                inward = rotation("z", self.shell.yaw(wall))[:2, 1]
                foot = np.array(self.shell.point(wall, 0.0))
                return wall if abs(float((foot - np.array(host.at[:2])) @ inward)) < 0.1 else None
        return None

    def hang_from_ceiling(self, item: Item, x: float, y: float) -> Placed | None:
        """Hang an item from the ceiling at (x, y)."""
        return self.offer(item, (x, y, self.shell.height), 0.0)

    def lay(self, rug: Item, x: float, y: float, yaw: float = 0.0) -> Placed | None:
        """Place a rug with its middle at (x, y), rotated by ``yaw`` radians, if no item stands there."""
        b = rug.bounds
        middle = rotation("z", yaw)[:2, :2] @ b.mean(axis=0)[:2]
        return self.offer(rug, (x - float(middle[0]), y - float(middle[1]), 0.0), yaw)


def _lies_in(inner: Floats, outer: Floats) -> bool:
    return bool((inner[0, :2] >= outer[0, :2]).all() and (inner[1, :2] <= outer[1, :2]).all())
